//! Visibility and colours.

use numpy::{PyArray1, PyArray2, PyUntypedArray, PyUntypedArrayMethods, dtype};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

use super::arrays::{Input, Output, owned, owned_rows, points3};
use super::geometry::PyView;
use crate::colour::{Blend, Colourist, Colours, Exposure, Interpolation, Photo, Pixels, VisibilityMap};
use crate::error::Error;
use crate::memory::zeros;
use crate::render::LocalPlanes;

#[pyclass(frozen, name = "VisibilityMap", module = "colourreg_rs._core")]
pub(super) struct PyVisibilityMap(pub VisibilityMap);

#[pymethods]
impl PyVisibilityMap {
    #[getter]
    fn view(&self) -> PyView {
        PyView(*self.0.view())
    }

    fn visible<'py>(&self, py: Python<'py>, xyz: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyArray1<bool>>> {
        let input = points3(xyz, "xyz")?;
        let points = input.rows::<3>()?;
        Ok(PyArray1::from_vec(py, py.detach(|| self.0.visible(points))))
    }

    fn planes(&self, py: Python<'_>) -> PyLocalPlanes {
        PyLocalPlanes(py.detach(|| self.0.planes()))
    }

    fn depth<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f32>>> {
        self.image(py, VisibilityMap::depth)
    }

    fn limit<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f32>>> {
        self.image(py, VisibilityMap::limit)
    }
}

#[pyclass(frozen, name = "LocalPlanes", module = "colourreg_rs._core")]
pub(super) struct PyLocalPlanes(pub LocalPlanes);

#[pymethods]
impl PyLocalPlanes {
    #[getter]
    fn depth_noise(&self) -> f32 {
        self.0.depth_noise()
    }

    fn normals<'py>(&self, py: Python<'py>, xyz: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let input = points3(xyz, "xyz")?;
        let points = input.rows::<3>()?;
        owned_rows(py, py.detach(|| self.0.normals(points)))
    }
}

impl PyVisibilityMap {
    fn image<'py>(
        &self,
        py: Python<'py>,
        make: impl Fn(&VisibilityMap) -> Vec<f32> + Send + Sync,
    ) -> PyResult<Bound<'py, PyArray2<f32>>> {
        let camera = &self.0.view().camera;
        owned(py, py.detach(|| make(&self.0)), [camera.height as usize, camera.width as usize])
    }
}

/// Photos borrowed from Python.
enum PhotoInput<'py> {
    U8(Input<'py, u8>),
    U16(Input<'py, u16>),
}

impl<'py> PhotoInput<'py> {
    fn new(array: &Bound<'py, PyAny>, name: &str) -> PyResult<Self> {
        let shape = [None, None, Some(3)];
        let wide = array
            .cast::<PyUntypedArray>()
            .is_ok_and(|array| numpy::PyArrayDescrMethods::is_equiv_to(&array.dtype(), &dtype::<u16>(array.py())));
        if wide {
            Ok(Self::U16(Input::new(array, name, &shape)?))
        } else {
            Ok(Self::U8(Input::new(array, name, &shape)?))
        }
    }

    fn photo(&self, wraps: bool) -> PyResult<Photo<'_>> {
        let (pixels, shape) = match self {
            Self::U8(input) => (Pixels::U8(input.rows::<3>()?), input.shape()),
            Self::U16(input) => (Pixels::U16(input.rows::<3>()?), input.shape()),
        };
        Ok(Photo::new(pixels, shape[1], shape[0], wraps)?)
    }
}

fn photo_inputs<'py>(photos: &[Bound<'py, PyAny>]) -> PyResult<Vec<PhotoInput<'py>>> {
    photos.iter().enumerate().map(|(i, photo)| PhotoInput::new(photo, &format!("photos[{i}]"))).collect()
}

fn borrowed<'a>(
    maps: &'a [PyRef<'_, PyVisibilityMap>],
    photos: &'a [PhotoInput<'_>],
) -> PyResult<(Vec<&'a VisibilityMap>, Vec<Photo<'a>>)> {
    if maps.len() != photos.len() {
        return Err(
            Error::invalid(format!("{} maps and {} photos do not belong together", maps.len(), photos.len())).into()
        );
    }
    let maps: Vec<&VisibilityMap> = maps.iter().map(|map| &map.0).collect();
    let photos = maps.iter().zip(photos).map(|(map, photo)| photo.photo(map.wraps())).collect::<PyResult<_>>()?;
    Ok((maps, photos))
}

#[pyfunction]
#[pyo3(signature = (maps, photos, xyz, *, sampling="bilinear", blend="best", gains=None, normals=None, out_rgb=None, out_source=None))]
#[allow(clippy::too_many_arguments, reason = "keywords in Python")]
fn colour_points<'py>(
    py: Python<'py>,
    maps: Vec<PyRef<'py, PyVisibilityMap>>,
    photos: Vec<Bound<'py, PyAny>>,
    xyz: &Bound<'py, PyAny>,
    sampling: &str,
    blend: &str,
    gains: Option<&Bound<'py, PyAny>>,
    normals: Option<&Bound<'py, PyAny>>,
    out_rgb: Option<Bound<'py, PyAny>>,
    out_source: Option<Bound<'py, PyAny>>,
) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyAny>)> {
    let interpolation = Interpolation::from_name(sampling)?;
    let blend = Blend::from_name(blend)?;
    let input = points3(xyz, "xyz")?;
    let points = input.rows::<3>()?;
    let normals = normals.map(|n| Input::<f64>::new(n, "normals", &[Some(points.len()), Some(3)])).transpose()?;
    let normals = normals.as_ref().map(Input::rows::<3>).transpose()?;
    let gains = gains.map(|g| Input::<f64>::new(g, "gains", &[Some(maps.len()), Some(3)])).transpose()?;
    let gains = gains.as_ref().map(Input::rows::<3>).transpose()?;
    let inputs = photo_inputs(&photos)?;
    let (maps, photos) = borrowed(&maps, &inputs)?;
    let colourist = Colourist::new(maps, photos, gains, interpolation, blend)?;
    match (out_rgb, out_source) {
        (Some(rgb), Some(source)) => {
            let mut rgb_out = Output::<u16>::new(&rgb, "out_rgb", &[Some(points.len()), Some(3)])?;
            let mut source_out = Output::<u16>::new(&source, "out_source", &[Some(points.len())])?;
            let colours = Colours { rgb: rgb_out.rows::<3>()?, source: source_out.values()? };
            py.detach(|| colourist.colour(points, normals, colours))?;
            Ok((rgb, source))
        }
        (None, None) => {
            let (rgb, source) = py.detach(|| {
                let n = points.len();
                let (mut rgb, mut source) = (zeros(n, "colours")?, zeros(n, "the sources of colours")?);
                colourist.colour(points, normals, Colours { rgb: &mut rgb, source: &mut source })?;
                Ok::<_, Error>((rgb, source))
            })?;
            Ok((owned_rows(py, rgb)?.into_any(), PyArray1::from_vec(py, source).into_any()))
        }
        _ => Err(PyValueError::new_err("out_rgb and out_source are given together or not at all")),
    }
}

#[pyclass(frozen, name = "Exposure", module = "colourreg_rs._core")]
struct PyExposure(Exposure);

#[pymethods]
impl PyExposure {
    #[new]
    fn new(views: usize) -> Self {
        Self(Exposure::new(views))
    }

    fn add<'py>(
        &self,
        py: Python<'py>,
        maps: Vec<PyRef<'py, PyVisibilityMap>>,
        photos: Vec<Bound<'py, PyAny>>,
        xyz: &Bound<'py, PyAny>,
    ) -> PyResult<()> {
        let input = points3(xyz, "xyz")?;
        let points = input.rows::<3>()?;
        let inputs = photo_inputs(&photos)?;
        let (maps, photos) = borrowed(&maps, &inputs)?;
        Ok(py.detach(|| self.0.add(&maps, &photos, points))?)
    }

    fn gains<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        owned_rows(py, py.detach(|| self.0.gains())?)
    }
}

pub(super) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_class::<PyVisibilityMap>()?;
    m.add_class::<PyLocalPlanes>()?;
    m.add_class::<PyExposure>()?;
    m.add_function(wrap_pyfunction!(colour_points, m)?)
}
