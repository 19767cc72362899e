//! The synthetic camera image, step by step; `sci.py` puts the steps together.

use numpy::{PyArray1, PyArray2};
use pyo3::prelude::*;

use super::arrays::{Input, Output, owned, points3, vector};
use super::geometry::PyView;
use super::render::PyIndexBuffer;
use crate::render::filling::{Filling, Samples, filled};
use crate::render::intensity::{self, Exponents};
use crate::render::resampling::{Scattered, resampled};
use crate::render::sci::{self, Gathered, Hiding, Points};
use crate::render::{Footprint, Splat, picture};

type Picture<'py> = (Bound<'py, PyArray2<f32>>, Bound<'py, PyArray2<f32>>);
type Front<'py> = (Bound<'py, PyArray2<i64>>, Bound<'py, PyArray2<f32>>, Bound<'py, PyArray2<f32>>);

#[pyfunction]
#[pyo3(signature = (buffer, *, hide=true, splat=None, tolerance=None, max_gap=None))]
fn sci_front<'py>(
    py: Python<'py>,
    buffer: &PyIndexBuffer,
    hide: bool,
    splat: Option<usize>,
    tolerance: Option<f64>,
    max_gap: Option<f64>,
) -> PyResult<Front<'py>> {
    let footprint = Footprint::new(tolerance, max_gap)?;
    let hiding = match (hide, splat) {
        (true, Some(size)) => Hiding::Splats(Splat::new(size)?),
        (true, None) => Hiding::Surfaces(&footprint),
        (false, _) => Hiding::Nothing,
    };
    let front = py.detach(|| sci::front(&buffer.0, hiding))?;
    let shape = [front.height, front.width];
    Ok((owned(py, front.index, shape)?, owned(py, front.inverse_depth, shape)?, owned(py, front.limit, shape)?))
}

#[pyfunction]
#[pyo3(signature = (view, index, station, xyz, *, first=0, intensity=None, normals=None, offset, value, range, cosine))]
#[allow(clippy::too_many_arguments, reason = "keywords of the Python function")]
fn sci_gather(
    py: Python<'_>,
    view: &PyView,
    index: &Bound<'_, PyAny>,
    station: &Bound<'_, PyAny>,
    xyz: &Bound<'_, PyAny>,
    first: i64,
    intensity: Option<&Bound<'_, PyAny>>,
    normals: Option<&Bound<'_, PyAny>>,
    offset: &Bound<'_, PyAny>,
    value: &Bound<'_, PyAny>,
    range: &Bound<'_, PyAny>,
    cosine: &Bound<'_, PyAny>,
) -> PyResult<()> {
    let shape = [Some(view.0.camera.height as usize), Some(view.0.camera.width as usize)];
    let index = Input::<i64>::new(index, "index", &shape)?;
    let station = vector::<3>(station, "station")?;
    let xyz = points3(xyz, "xyz")?;
    let intensity = intensity.map(|a| Input::<f32>::new(a, "intensity", &[None])).transpose()?;
    let normals = normals.map(|a| points3(a, "normals")).transpose()?;
    let mut offset = Output::<f32>::new(offset, "offset", &[shape[0], shape[1], Some(2)])?;
    let mut value = Output::<f32>::new(value, "value", &shape)?;
    let mut range = Output::<f32>::new(range, "range", &shape)?;
    let mut cosine = Output::<f32>::new(cosine, "cosine", &shape)?;
    let points = Points {
        first,
        xyz: xyz.rows::<3>()?,
        intensity: intensity.as_ref().map(Input::values).transpose()?.unwrap_or_default(),
        normals: normals.as_ref().map(Input::rows::<3>).transpose()?.unwrap_or_default(),
    };
    let index = index.values()?;
    let out = Gathered {
        offset: offset.rows::<2>()?,
        intensity: value.values()?,
        range: range.values()?,
        cosine: cosine.values()?,
    };
    Ok(py.detach(|| sci::gather(&view.0, index, &station, &points, out))?)
}

#[pyfunction]
fn sci_picture<'py>(
    py: Python<'py>,
    view: &PyView,
    xyz: &Bound<'py, PyAny>,
    values: &Bound<'py, PyAny>,
) -> PyResult<Picture<'py>> {
    let xyz = points3(xyz, "xyz")?;
    let values = Input::<f32>::new(values, "values", &[None])?;
    let (points, values) = (xyz.rows::<3>()?, values.values()?);
    let (depth, value) = py.detach(|| picture(&view.0, points, values))?;
    let shape = [view.0.camera.height as usize, view.0.camera.width as usize];
    Ok((owned(py, depth, shape)?, owned(py, value, shape)?))
}

#[pyfunction]
#[pyo3(signature = (inverse_depth, limit, *, width=8, tolerance=0.006, wraps=false))]
fn sci_fill<'py>(
    py: Python<'py>,
    inverse_depth: &Bound<'py, PyAny>,
    limit: &Bound<'py, PyAny>,
    width: usize,
    tolerance: f32,
    wraps: bool,
) -> PyResult<Bound<'py, PyArray2<f32>>> {
    let inverse_depth = Input::<f32>::new(inverse_depth, "inverse_depth", &[None, None])?;
    let shape = [inverse_depth.shape()[0], inverse_depth.shape()[1]];
    let limit = Input::<f32>::new(limit, "limit", &[Some(shape[0]), Some(shape[1])])?;
    let samples = Samples {
        width: shape[1],
        height: shape[0],
        inverse_depth: inverse_depth.values()?,
        limit: limit.values()?,
        wraps,
    };
    let out = py.detach(|| filled(&samples, &Filling { width, tolerance }));
    owned(py, out, shape)
}

#[pyfunction]
#[pyo3(signature = (values, offset, inverse_depth, *, sigma=0.7, widest=4.0, gaps=false))]
fn sci_resample<'py>(
    py: Python<'py>,
    values: &Bound<'py, PyAny>,
    offset: &Bound<'py, PyAny>,
    inverse_depth: &Bound<'py, PyAny>,
    sigma: f32,
    widest: f32,
    gaps: bool,
) -> PyResult<Bound<'py, PyArray2<f32>>> {
    let values = Input::<f32>::new(values, "values", &[None, None])?;
    let (height, width) = (values.shape()[0], values.shape()[1]);
    let offset = Input::<f32>::new(offset, "offset", &[Some(height), Some(width), Some(2)])?;
    let inverse_depth = Input::<f32>::new(inverse_depth, "inverse_depth", &[Some(height), Some(width)])?;
    let image = Scattered {
        width,
        height,
        values: values.values()?,
        offsets: offset.rows::<2>()?,
        inverse_depth: inverse_depth.values()?,
    };
    let out = py.detach(|| resampled(&image, sigma, widest, gaps));
    owned(py, out, [height, width])
}

#[pyfunction]
#[pyo3(signature = (intensity, range, cosine=None))]
fn fit_exponents(
    py: Python<'_>,
    intensity: &Bound<'_, PyAny>,
    range: &Bound<'_, PyAny>,
    cosine: Option<&Bound<'_, PyAny>>,
) -> PyResult<(f64, f64)> {
    let intensity = Input::<f32>::new(intensity, "intensity", &[None])?;
    let range = Input::<f32>::new(range, "range", &[None])?;
    let cosine = cosine.map(|a| Input::<f32>::new(a, "cosine", &[None])).transpose()?;
    let (values, ranges) = (intensity.values()?, range.values()?);
    let cosines = cosine.as_ref().map(Input::values).transpose()?.unwrap_or_default();
    let found = py.detach(|| intensity::fit_exponents(values, ranges, cosines))?;
    Ok((found.range, found.incidence))
}

#[pyfunction]
#[pyo3(signature = (intensity, range, cosine, range_exponent, incidence_exponent))]
fn correct_intensity<'py>(
    py: Python<'py>,
    intensity: &Bound<'py, PyAny>,
    range: &Bound<'py, PyAny>,
    cosine: Option<&Bound<'py, PyAny>>,
    range_exponent: f64,
    incidence_exponent: f64,
) -> PyResult<Bound<'py, PyArray1<f32>>> {
    let intensity = Input::<f32>::new(intensity, "intensity", &[None])?;
    let range = Input::<f32>::new(range, "range", &[None])?;
    let cosine = cosine.map(|a| Input::<f32>::new(a, "cosine", &[None])).transpose()?;
    let (values, ranges) = (intensity.values()?, range.values()?);
    let cosines = cosine.as_ref().map(Input::values).transpose()?.unwrap_or_default();
    let exponents = Exponents { range: range_exponent, incidence: incidence_exponent };
    let out = py.detach(|| intensity::corrected(values, ranges, cosines, &exponents))?;
    Ok(PyArray1::from_vec(py, out))
}

#[pyfunction]
fn stretch_by_rank<'py>(py: Python<'py>, values: &Bound<'py, PyAny>, top: u16) -> PyResult<Bound<'py, PyArray1<u16>>> {
    let input = Input::<f32>::new(values, "values", &[None])?;
    let values = input.values()?;
    Ok(PyArray1::from_vec(py, py.detach(|| intensity::stretched_by_rank(values, top))))
}

pub(super) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_function(wrap_pyfunction!(sci_front, m)?)?;
    m.add_function(wrap_pyfunction!(sci_picture, m)?)?;
    m.add_function(wrap_pyfunction!(sci_gather, m)?)?;
    m.add_function(wrap_pyfunction!(sci_fill, m)?)?;
    m.add_function(wrap_pyfunction!(sci_resample, m)?)?;
    m.add_function(wrap_pyfunction!(fit_exponents, m)?)?;
    m.add_function(wrap_pyfunction!(correct_intensity, m)?)?;
    m.add_function(wrap_pyfunction!(stretch_by_rank, m)?)
}
