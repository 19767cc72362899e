//! Depth buffers.

use std::sync::RwLock;

use numpy::{Element, PyArray2};
use pyo3::prelude::*;

use super::arrays::{Input, owned, points3};
use super::colour::PyVisibilityMap;
use super::geometry::PyView;
use crate::colour::{Limits, VisibilityMap};
use crate::error::Error;
use crate::render::{DepthBuffer, Footprint, IndexBuffer, Splat, sci};

/// The buffer until it is finished. Adding shares the lock, finishing has it alone.
#[pyclass(frozen, name = "DepthBuffer", module = "colourreg_rs._core")]
pub(super) struct PyDepthBuffer {
    buffer: RwLock<Option<DepthBuffer>>,
    footprint: Footprint,
    limits: Limits,
}

fn finished() -> Error {
    Error::invalid("the depth buffer is finished; begin a new one to add points")
}

#[pymethods]
impl PyDepthBuffer {
    #[new]
    #[pyo3(signature = (view, *, tolerance=None, max_gap=None, max_distance=None, max_incidence=None))]
    fn new(
        view: &PyView,
        tolerance: Option<f64>,
        max_gap: Option<f64>,
        max_distance: Option<f64>,
        max_incidence: Option<f64>,
    ) -> PyResult<Self> {
        let mut limits = Limits::default();
        limits.max_distance = max_distance.unwrap_or(limits.max_distance);
        limits.max_incidence = max_incidence.unwrap_or(limits.max_incidence);
        let (footprint, limits) = (Footprint::new(tolerance, max_gap)?, limits.checked()?);
        Ok(Self { buffer: RwLock::new(Some(footprint.buffer(view.0)?)), footprint, limits })
    }

    fn add(&self, py: Python<'_>, xyz: &Bound<'_, PyAny>) -> PyResult<()> {
        let input = points3(xyz, "xyz")?;
        let points = input.rows::<3>()?;
        py.detach(|| {
            let buffer = self.buffer.read().map_err(|_| Error::Internal("a thread panicked while adding".into()))?;
            buffer.as_ref().ok_or_else(finished)?.add(points);
            Ok::<_, Error>(())
        })?;
        Ok(())
    }

    fn finish(&self, py: Python<'_>) -> PyResult<PyVisibilityMap> {
        let map = py.detach(|| {
            let taken =
                self.buffer.write().map_err(|_| Error::Internal("a thread panicked while adding".into()))?.take();
            VisibilityMap::new(taken.ok_or_else(finished)?, &self.footprint, self.limits)
        })?;
        Ok(PyVisibilityMap(map))
    }
}

#[pyclass(frozen, name = "IndexBuffer", module = "colourreg_rs._core")]
pub(super) struct PyIndexBuffer(pub IndexBuffer);

#[pymethods]
impl PyIndexBuffer {
    #[new]
    fn new(view: &PyView) -> PyResult<Self> {
        Ok(Self(IndexBuffer::new(view.0)?))
    }

    #[pyo3(signature = (xyz, first=0))]
    fn add(&self, py: Python<'_>, xyz: &Bound<'_, PyAny>, first: u64) -> PyResult<()> {
        let input = points3(xyz, "xyz")?;
        let points = input.rows::<3>()?;
        Ok(py.detach(|| self.0.add(points, first))?)
    }

    fn images<'py>(&self, py: Python<'py>) -> PyResult<(Image<'py, f32>, Image<'py, i64>)> {
        let (depth, index) = py.detach(|| sci::images(&self.0));
        Ok((self.image(py, depth)?, self.image(py, index)?))
    }

    #[pyo3(signature = (values, *, splat=1))]
    fn draw<'py>(
        &self,
        py: Python<'py>,
        values: &Bound<'py, PyAny>,
        splat: usize,
    ) -> PyResult<(Image<'py, f32>, Image<'py, f32>)> {
        let input = Input::<f32>::new(values, "values", &[None])?;
        let (values, splat) = (input.values()?, Splat::new(splat)?);
        let (depth, picture) = py.detach(|| sci::draw(&self.0, splat, values))?;
        Ok((self.image(py, depth)?, self.image(py, picture)?))
    }
}

type Image<'py, T> = Bound<'py, PyArray2<T>>;

impl PyIndexBuffer {
    fn image<'py, T: Element>(&self, py: Python<'py>, pixels: Vec<T>) -> PyResult<Image<'py, T>> {
        let grid = self.0.grid();
        owned(py, pixels, [grid.height, grid.width])
    }
}

pub(super) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_class::<PyDepthBuffer>()?;
    m.add_class::<PyIndexBuffer>()
}
