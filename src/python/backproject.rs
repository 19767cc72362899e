//! From pixels back to points.

use numpy::{PyArray1, PyArray2};
use pyo3::prelude::*;
use rayon::prelude::*;

use super::arrays::{Input, holds, matrix, owned_rows, points2};
use super::geometry::PyView;
use crate::backproject::{
    self as core, BackprojectOptions, Backprojected, DepthImage, Depths, invert_dlt_by_pseudo_inverse,
};

/// The images of a [`DepthImage`], borrowed.
struct Images<'py> {
    depth: Depth<'py>,
    measured: Input<'py, bool>,
    subpixel: Option<Input<'py, f32>>,
}

enum Depth<'py> {
    Single(Input<'py, f32>),
    Double(Input<'py, f64>),
}

impl<'py> Images<'py> {
    fn new(
        view: &PyView,
        depth: &Bound<'py, PyAny>,
        measured: &Bound<'py, PyAny>,
        subpixel: Option<&Bound<'py, PyAny>>,
    ) -> PyResult<Self> {
        let (h, w) = (Some(view.0.camera.height as usize), Some(view.0.camera.width as usize));
        Ok(Self {
            depth: if holds::<f64>(depth) {
                Depth::Double(Input::new(depth, "depth", &[h, w])?)
            } else {
                Depth::Single(Input::new(depth, "depth", &[h, w])?)
            },
            measured: Input::new(measured, "measured", &[h, w])?,
            subpixel: subpixel.map(|s| Input::new(s, "subpixel", &[h, w, Some(2)])).transpose()?,
        })
    }

    fn image(&self) -> PyResult<DepthImage<'_>> {
        Ok(DepthImage {
            depth: match &self.depth {
                Depth::Single(d) => Depths::Single(d.values()?),
                Depth::Double(d) => Depths::Double(d.values()?),
            },
            measured: self.measured.values()?,
            subpixel: self.subpixel.as_ref().map(|s| s.rows::<2>()).transpose()?,
        })
    }
}

type Columns<'py> =
    (Bound<'py, PyArray2<f64>>, Bound<'py, PyArray1<f64>>, Bound<'py, PyArray1<u8>>, Bound<'py, PyArray2<f64>>);

fn columns<'py>(py: Python<'py>, found: &[Backprojected]) -> PyResult<Columns<'py>> {
    let (xyz, depth, origin, sigma) = py.detach(|| {
        (
            found.par_iter().map(|f| f.xyz).collect(),
            found.par_iter().map(|f| f.depth).collect(),
            found.par_iter().map(|f| f.origin as u8).collect(),
            found.par_iter().map(|f| [f.sigma_along, f.sigma_across]).collect(),
        )
    });
    Ok((owned_rows(py, xyz)?, PyArray1::from_vec(py, depth), PyArray1::from_vec(py, origin), owned_rows(py, sigma)?))
}

#[pyfunction]
fn backproject<'py>(
    py: Python<'py>,
    view: &PyView,
    xy: &Bound<'py, PyAny>,
    depth: &Bound<'py, PyAny>,
) -> PyResult<Bound<'py, PyArray2<f64>>> {
    let (xy, depth) = (points2(xy, "xy")?, Input::<f64>::new(depth, "depth", &[None])?);
    let (rows, depths) = (xy.rows::<2>()?, depth.values()?);
    owned_rows(py, py.detach(|| core::backproject(&view.0, rows, depths))?)
}

#[pyfunction]
#[pyo3(signature = (p, xy, depth, *, pseudo_inverse=false))]
fn invert_dlt<'py>(
    py: Python<'py>,
    p: &Bound<'py, PyAny>,
    xy: &Bound<'py, PyAny>,
    depth: &Bound<'py, PyAny>,
    pseudo_inverse: bool,
) -> PyResult<Bound<'py, PyArray2<f64>>> {
    let p = matrix::<3, 4>(p, "P")?;
    let (xy, depth) = (points2(xy, "xy")?, Input::<f64>::new(depth, "depth", &[None])?);
    let (rows, depths) = (xy.rows::<2>()?, depth.values()?);
    let invert = if pseudo_inverse { invert_dlt_by_pseudo_inverse } else { core::invert_dlt };
    owned_rows(py, py.detach(|| invert(&p, rows, depths))?)
}

#[pyfunction]
#[pyo3(signature = (
    view, depth, measured, xy=None, *, subpixel=None, radius=4.0, extension=0.0, max_incidence=1.4835298641951802,
    depth_sigma=0.003, pixel_sigma=0.5, placement_sigma=0.2886751345948129
))]
#[allow(clippy::too_many_arguments, reason = "Python's keywords are Rust's options")]
fn backproject_pixels<'py>(
    py: Python<'py>,
    view: &PyView,
    depth: &Bound<'py, PyAny>,
    measured: &Bound<'py, PyAny>,
    xy: Option<&Bound<'py, PyAny>>,
    subpixel: Option<&Bound<'py, PyAny>>,
    radius: f64,
    extension: f64,
    max_incidence: f64,
    depth_sigma: f64,
    pixel_sigma: f64,
    placement_sigma: f64,
) -> PyResult<Bound<'py, PyAny>> {
    let options = BackprojectOptions { radius, extension, max_incidence, depth_sigma, pixel_sigma, placement_sigma };
    let images = Images::new(view, depth, measured, subpixel)?;
    let image = images.image()?;
    match xy {
        Some(xy) => {
            let xy = points2(xy, "xy")?;
            let rows = xy.rows::<2>()?;
            let found = py.detach(|| core::backproject_pixels(&view.0, &image, rows, &options))?;
            Ok(columns(py, &found)?.into_pyobject(py)?.into_any())
        }
        None => {
            let (pixel, found) = py.detach(|| core::backproject_image(&view.0, &image, &options))?;
            let pixel = PyArray1::from_vec(py, pixel.into_iter().map(i64::from).collect());
            let (xyz, depth, origin, sigma) = columns(py, &found)?;
            Ok((pixel, xyz, depth, origin, sigma).into_pyobject(py)?.into_any())
        }
    }
}

pub(super) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_function(wrap_pyfunction!(backproject, m)?)?;
    m.add_function(wrap_pyfunction!(invert_dlt, m)?)?;
    m.add_function(wrap_pyfunction!(backproject_pixels, m)?)
}
