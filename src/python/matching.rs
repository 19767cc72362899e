//! Interest points, templates, and the information distance.

use numpy::{PyArray1, PyArray2};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use super::arrays::{Input, owned, owned_rows, points2, points3};
use super::geometry::PyView;
use crate::error::Error;
use crate::matching::channels::{ChannelOptions, Tuning};
use crate::matching::{
    self, Features, InformationPhoto, InterestOptions, Measure, Outcome, Plane, RegressionOptions, RegressionPhoto,
    TemplateOptions,
};

fn plane(array: &Bound<'_, PyAny>, name: &str) -> PyResult<Plane> {
    let input = Input::<f32>::new(array, name, &[None, None])?;
    // Copied: planes own their values, and an image is small beside what is computed from it.
    Ok(Plane::new(input.shape()[1], input.shape()[0], input.values()?.to_vec())?)
}

fn mask(array: Option<&Bound<'_, PyAny>>) -> PyResult<Option<Plane>> {
    let Some(array) = array else { return Ok(None) };
    let input = Input::<bool>::new(array, "known", &[None, None])?;
    let values = input.values()?.iter().map(|k| f32::from(u8::from(*k))).collect();
    Ok(Some(Plane::new(input.shape()[1], input.shape()[0], values)?))
}

/// A negative place lies outside, as does one beyond the picture: both come back as unknown.
fn places(points: &[[i64; 2]]) -> Vec<[usize; 2]> {
    points.iter().map(|p| p.map(|v| usize::try_from(v).unwrap_or(usize::MAX / 4))).collect()
}

#[pyfunction]
fn resize<'py>(
    py: Python<'py>,
    image: &Bound<'py, PyAny>,
    width: usize,
    height: usize,
) -> PyResult<Bound<'py, PyArray2<f32>>> {
    let image = plane(image, "image")?;
    if width == 0 || height == 0 {
        return Err(Error::invalid(format!("an image cannot be made {width} × {height} pixels large")).into());
    }
    let out = py.detach(|| image.resized(width, height));
    owned(py, out.values, [height, width])
}

#[pyfunction]
#[pyo3(signature = (image, known, sigma))]
fn masked_blur<'py>(
    py: Python<'py>,
    image: &Bound<'py, PyAny>,
    known: Option<&Bound<'py, PyAny>>,
    sigma: f32,
) -> PyResult<Bound<'py, PyArray2<f32>>> {
    let (image, known) = (plane(image, "image")?, mask(known)?);
    if let Some(known) = &known
        && !known.same_size(&image)
    {
        return Err(Error::invalid("the mask has not the size of its image").into());
    }
    let out = py.detach(|| matching::channels::masked_blur(&image, known.as_ref(), sigma));
    owned(py, out.values, [image.height, image.width])
}

#[pyclass(frozen, name = "Features", module = "colourreg_rs._core")]
pub(super) struct PyFeatures(Features);

#[pymethods]
impl PyFeatures {
    #[staticmethod]
    #[pyo3(signature = (image, known=None, *, sigma_gradient=0.8, sigma_channel=1.0, saturation=3.0, tuning="cosine4"))]
    fn channels(
        py: Python<'_>,
        image: &Bound<'_, PyAny>,
        known: Option<&Bound<'_, PyAny>>,
        sigma_gradient: f32,
        sigma_channel: f32,
        saturation: f32,
        tuning: &str,
    ) -> PyResult<Self> {
        let tuning = match tuning {
            "cfog" => Tuning::Cfog,
            "cosine2" => Tuning::Cosine2,
            "cosine4" => Tuning::Cosine4,
            _ => return Err(Error::invalid(format!("tuning {tuning:?} is not one of cfog, cosine2, cosine4")).into()),
        };
        let options = ChannelOptions { sigma_gradient, sigma_channel, saturation, tuning };
        Self::make(py, image, known, Measure::Channels(options))
    }

    #[staticmethod]
    #[pyo3(signature = (image, known=None, *, sigma=0.8))]
    fn grey(py: Python<'_>, image: &Bound<'_, PyAny>, known: Option<&Bound<'_, PyAny>>, sigma: f32) -> PyResult<Self> {
        Self::make(py, image, known, Measure::Grey(sigma))
    }

    #[staticmethod]
    #[pyo3(signature = (image, known=None, *, bins=16))]
    fn mutual_information(
        py: Python<'_>,
        image: &Bound<'_, PyAny>,
        known: Option<&Bound<'_, PyAny>>,
        bins: usize,
    ) -> PyResult<Self> {
        Self::make(py, image, known, Measure::MutualInformation(bins))
    }

    #[getter]
    fn width(&self) -> usize {
        self.0.size().0
    }

    #[getter]
    fn height(&self) -> usize {
        self.0.size().1
    }
}

impl PyFeatures {
    fn make(
        py: Python<'_>,
        image: &Bound<'_, PyAny>,
        known: Option<&Bound<'_, PyAny>>,
        measure: Measure,
    ) -> PyResult<Self> {
        let (image, known) = (plane(image, "image")?, mask(known)?);
        Ok(Self(py.detach(|| measure.features(&image, known.as_ref()))?))
    }
}

type Points<'py> = (Bound<'py, PyArray2<i64>>, Bound<'py, PyArray1<f32>>);

#[pyfunction]
#[pyo3(signature = (image, known=None, *, cell=32, per_cell=2, border=8, sigma_gradient=0.8, sigma_window=4.0, floor=0.5))]
#[allow(clippy::too_many_arguments, reason = "keywords of the Python function")]
fn interest_points<'py>(
    py: Python<'py>,
    image: &Bound<'py, PyAny>,
    known: Option<&Bound<'py, PyAny>>,
    cell: usize,
    per_cell: usize,
    border: usize,
    sigma_gradient: f32,
    sigma_window: f32,
    floor: f32,
) -> PyResult<Points<'py>> {
    let (image, known) = (plane(image, "image")?, mask(known)?);
    let options = InterestOptions { cell, per_cell, border, sigma_gradient, sigma_window, floor };
    let found = py.detach(|| matching::interest_points(&image, known.as_ref(), &options))?;
    Ok((
        owned_rows(py, found.iter().map(|p| [p.x as i64, p.y as i64]).collect())?,
        PyArray1::from_iter(py, found.iter().map(|p| p.strength)),
    ))
}

#[pyfunction]
#[pyo3(signature = (
    sci, photo, points, *, half=24, radius=12, least_known=0.5, least_score=0.2, largest_second=0.85, apart=3, hypotheses=1
))]
#[allow(clippy::too_many_arguments, reason = "keywords of the Python function")]
fn match_templates<'py>(
    py: Python<'py>,
    sci: &PyFeatures,
    photo: &PyFeatures,
    points: &Bound<'py, PyAny>,
    half: usize,
    radius: usize,
    least_known: f32,
    least_score: f32,
    largest_second: f32,
    apart: usize,
    hypotheses: usize,
) -> PyResult<Bound<'py, PyDict>> {
    let input = Input::<i64>::new(points, "points", &[None, Some(2)])?;
    let places = places(input.rows::<2>()?);
    let options = TemplateOptions { half, radius, least_known, least_score, largest_second, apart, hypotheses };
    let found = py.detach(|| matching::match_templates(&sci.0, &photo.0, &places, &options))?;
    let out = PyDict::new(py);
    out.set_item("template", PyArray1::from_iter(py, found.iter().map(|m| m.template as i64)))?;
    out.set_item("shift", owned_rows(py, found.iter().map(|m| m.shift).collect())?)?;
    out.set_item("covariance", owned_rows(py, found.iter().map(|m| m.covariance).collect())?)?;
    out.set_item("score", PyArray1::from_iter(py, found.iter().map(|m| m.score)))?;
    out.set_item("second", PyArray1::from_iter(py, found.iter().map(|m| m.second)))?;
    out.set_item("here", PyArray1::from_iter(py, found.iter().map(|m| m.here)))?;
    let code = |o: Outcome| Outcome::ALL.iter().position(|x| *x == o).unwrap_or(usize::MAX) as u8;
    out.set_item("outcome", PyArray1::from_iter(py, found.iter().map(|m| code(m.outcome))))?;
    Ok(out)
}

type Surfaces<'py> = (Bound<'py, PyArray1<f32>>, Bound<'py, PyArray1<f64>>);

#[pyfunction]
#[pyo3(signature = (sci, photo, points, *, half=12, radius=4, least_known=0.5))]
fn score_templates<'py>(
    py: Python<'py>,
    sci: &PyFeatures,
    photo: &PyFeatures,
    points: &Bound<'py, PyAny>,
    half: usize,
    radius: usize,
    least_known: f32,
) -> PyResult<Surfaces<'py>> {
    let input = Input::<i64>::new(points, "points", &[None, Some(2)])?;
    let places = places(input.rows::<2>()?);
    let options = TemplateOptions { half, radius, least_known, ..TemplateOptions::default() };
    let found = py.detach(|| matching::score_templates(&sci.0, &photo.0, &places, &options))?;
    let samples = PyArray1::from_iter(py, found.iter().map(|s| s.samples));
    Ok((PyArray1::from_iter(py, found.iter().flat_map(|s| s.scores.iter().copied())), samples))
}

#[pyfunction]
fn relief<'py>(
    py: Python<'py>,
    inverse_depth: &Bound<'py, PyAny>,
    points: &Bound<'py, PyAny>,
    half: usize,
) -> PyResult<Bound<'py, PyArray1<f64>>> {
    let image = Input::<f32>::new(inverse_depth, "inverse_depth", &[None, None])?;
    let (height, width) = (image.shape()[0], image.shape()[1]);
    let points = Input::<i64>::new(points, "points", &[None, Some(2)])?;
    let (values, places) = (image.values()?, places(points.rows::<2>()?));
    let found = py.detach(|| matching::relief(width, height, values, &places, half))?;
    Ok(PyArray1::from_vec(py, found))
}

#[pyclass(frozen, name = "InformationPhoto", module = "colourreg_rs._core")]
pub(super) struct PyInformationPhoto(InformationPhoto);

#[pymethods]
impl PyInformationPhoto {
    #[new]
    #[pyo3(signature = (image, *, bins=16))]
    fn new(py: Python<'_>, image: &Bound<'_, PyAny>, bins: usize) -> PyResult<Self> {
        let image = plane(image, "image")?;
        Ok(Self(py.detach(|| InformationPhoto::new(&image, bins))?))
    }
}

#[pyfunction]
fn information_distance<'py>(
    py: Python<'py>,
    view: &PyView,
    xyz: &Bound<'py, PyAny>,
    intensity: &Bound<'py, PyAny>,
    photo: &PyInformationPhoto,
) -> PyResult<(f64, Bound<'py, PyArray1<f64>>, usize)> {
    let (xyz, intensity) = (points3(xyz, "xyz")?, Input::<f32>::new(intensity, "intensity", &[None])?);
    let (points, values) = (xyz.rows::<3>()?, intensity.values()?);
    let found = py.detach(|| matching::information_distance(&view.0, points, values, &photo.0))?;
    Ok((found.distance, PyArray1::from_slice(py, &found.gradient), found.points))
}

#[pyclass(frozen, name = "RegressionPhoto", module = "colourreg_rs._core")]
pub(super) struct PyRegressionPhoto(RegressionPhoto);

#[pymethods]
impl PyRegressionPhoto {
    #[new]
    fn new(py: Python<'_>, channels: &Bound<'_, PyAny>) -> PyResult<Self> {
        let input = Input::<f32>::new(channels, "channels", &[None, None, None])?;
        let (height, width) = (input.shape()[1], input.shape()[2]);
        let values = input.values()?;
        let made = py.detach(|| {
            let size = (width * height).max(1);
            let planes = values.chunks_exact(size).map(|c| Plane::new(width, height, c.to_vec()));
            RegressionPhoto::new(&planes.collect::<Result<Vec<_>, _>>()?)
        });
        Ok(Self(made?))
    }
}

#[pyfunction]
#[pyo3(signature = (photo, xy, design, values, members, ends, *, least_points=40, cut=f64::INFINITY, order=2, ridge=1e-3))]
#[allow(clippy::too_many_arguments, reason = "keywords of the Python function")]
fn regress_patches<'py>(
    py: Python<'py>,
    photo: &PyRegressionPhoto,
    xy: &Bound<'py, PyAny>,
    design: &Bound<'py, PyAny>,
    values: &Bound<'py, PyAny>,
    members: &Bound<'py, PyAny>,
    ends: &Bound<'py, PyAny>,
    least_points: usize,
    cut: f64,
    order: usize,
    ridge: f64,
) -> PyResult<Bound<'py, PyDict>> {
    let (xy, values) = (points2(xy, "xy")?, Input::<f32>::new(values, "values", &[None])?);
    let design = Input::<f64>::new(design, "design", &[None, Some(2), None])?;
    let (members, ends) = (Input::<i64>::new(members, "members", &[None])?, Input::<i64>::new(ends, "ends", &[None])?);
    let parameters = design.shape()[2];
    let (points, design, values, members) = (xy.rows::<2>()?, design.values()?, values.values()?, members.values()?);
    let (mut start, mut patches) = (0, Vec::with_capacity(ends.values()?.len()));
    for end in ends.values()? {
        let end = usize::try_from(*end).unwrap_or(usize::MAX);
        let Some(patch) = members.get(start..end) else {
            return Err(Error::invalid("ends must rise and not go beyond the members").into());
        };
        patches.push(patch);
        start = end;
    }
    let options = RegressionOptions { least_points, cut, order, ridge };
    let found = py.detach(|| matching::regress_patches(&photo.0, points, design, values, &patches, &options))?;
    let n = found.len();
    let out = PyDict::new(py);
    let gradients = found.iter().flat_map(|p| p.gradient.iter().copied()).collect();
    let information = found.iter().flat_map(|p| p.information.iter().copied()).collect();
    out.set_item("gradient", owned(py, gradients, [n, parameters])?)?;
    out.set_item("information", owned(py, information, [n, parameters, parameters])?)?;
    out.set_item("value", PyArray1::from_iter(py, found.iter().map(|p| p.value)))?;
    out.set_item("explained", PyArray1::from_iter(py, found.iter().map(|p| p.explained)))?;
    out.set_item("points", PyArray1::from_iter(py, found.iter().map(|p| p.points)))?;
    Ok(out)
}

#[pyfunction]
fn rank<'py>(py: Python<'py>, values: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyArray1<f32>>> {
    let input = Input::<f32>::new(values, "values", &[None])?;
    let values = input.values()?;
    Ok(PyArray1::from_vec(py, py.detach(|| matching::information::ranks(values))))
}

pub(super) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_class::<PyFeatures>()?;
    m.add_class::<PyInformationPhoto>()?;
    m.add_class::<PyRegressionPhoto>()?;
    m.add("MATCH_OUTCOMES", Outcome::ALL.map(Outcome::name).to_vec())?;
    m.add_function(wrap_pyfunction!(resize, m)?)?;
    m.add_function(wrap_pyfunction!(interest_points, m)?)?;
    m.add_function(wrap_pyfunction!(match_templates, m)?)?;
    m.add_function(wrap_pyfunction!(masked_blur, m)?)?;
    m.add_function(wrap_pyfunction!(score_templates, m)?)?;
    m.add_function(wrap_pyfunction!(relief, m)?)?;
    m.add_function(wrap_pyfunction!(information_distance, m)?)?;
    m.add_function(wrap_pyfunction!(regress_patches, m)?)?;
    m.add_function(wrap_pyfunction!(rank, m)?)
}
