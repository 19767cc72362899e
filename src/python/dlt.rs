//! Direct Linear Transformation.

use numpy::PyArray2;
use pyo3::prelude::*;

use super::arrays::{Input, owned_rows, points2, points3};
use super::estimation::{PyVerdict, precision, square};
use super::geometry::PyView;
use crate::error::Error;
use crate::estimation::{self, Dlt, DltMethod, DltOptions};

#[pyclass(frozen, name = "DltResult", module = "colourreg_rs._core")]
pub(super) struct PyDlt(Dlt);

#[pymethods]
impl PyDlt {
    #[getter]
    fn view(&self) -> PyView {
        PyView(self.0.view)
    }

    #[getter]
    fn matrix<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        owned_rows(py, self.0.matrix.to_vec())
    }

    #[getter]
    fn parameters(&self) -> Vec<String> {
        self.0.names.clone()
    }

    #[getter]
    fn covariance<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        square(py, &self.0.covariance)
    }

    #[getter]
    fn part_parameters(&self) -> Vec<&'static str> {
        self.0.part_names.clone()
    }

    #[getter]
    fn part_covariance<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        square(py, &self.0.part_covariance)
    }

    #[getter]
    fn sigma0(&self) -> f64 {
        self.0.sigma0
    }

    #[getter]
    fn dof(&self) -> f64 {
        self.0.dof
    }

    #[getter]
    fn residuals<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        owned_rows(py, self.0.residuals.clone())
    }

    #[getter]
    fn status(&self) -> Vec<&'static str> {
        self.0.status.iter().map(|s| s.name()).collect()
    }

    #[getter]
    fn rms(&self) -> f64 {
        self.0.rms.rms
    }

    #[getter]
    fn rms_x(&self) -> f64 {
        self.0.rms.rms_x
    }

    #[getter]
    fn rms_y(&self) -> f64 {
        self.0.rms.rms_y
    }

    #[getter]
    fn rmse(&self) -> f64 {
        self.0.rms.rmse
    }

    #[getter]
    fn check_rms(&self) -> f64 {
        self.0.rms_check.rms
    }

    #[getter]
    fn check_rmse(&self) -> f64 {
        self.0.rms_check.rmse
    }

    #[getter]
    fn iterations(&self) -> usize {
        self.0.iterations
    }

    #[getter]
    fn stop(&self) -> Option<&'static str> {
        self.0.stop.map(|s| s.name())
    }

    #[getter]
    fn thickness(&self) -> f64 {
        self.0.thickness
    }

    #[getter]
    fn gap(&self) -> f64 {
        self.0.gap
    }

    #[getter]
    fn border_error(&self) -> f64 {
        self.0.predicted_errors.0
    }

    #[getter]
    fn centre_error(&self) -> f64 {
        self.0.predicted_errors.1
    }

    #[getter]
    fn verdict(&self) -> PyVerdict {
        PyVerdict(self.0.verdict.clone())
    }
}

#[pyfunction]
#[pyo3(signature = (xyz, xy, width, height, *, method=11, distortion=Vec::new(), sigma_xy=None, check=None))]
#[allow(clippy::too_many_arguments, reason = "keyword arguments of Python")]
fn estimate_dlt(
    py: Python<'_>,
    xyz: &Bound<'_, PyAny>,
    xy: &Bound<'_, PyAny>,
    width: u32,
    height: u32,
    method: u32,
    distortion: Vec<String>,
    sigma_xy: Option<&Bound<'_, PyAny>>,
    check: Option<&Bound<'_, PyAny>>,
) -> PyResult<PyDlt> {
    let method = match method {
        11 => DltMethod::Eleven,
        12 => DltMethod::Twelve,
        _ => return Err(Error::invalid(format!("a DLT has 11 or 12 parameters, not {method}")).into()),
    };
    let (xyz, xy) = (points3(xyz, "xyz")?, points2(xy, "xy")?);
    let (world, pixels) = (xyz.rows::<3>()?, xy.rows::<2>()?);
    let check = match check {
        Some(array) => Input::<bool>::new(array, "check", &[None])?.values()?.to_vec(),
        None => Vec::new(),
    };
    let options = DltOptions { method, distortion, precision: precision(sigma_xy)?, check, size: (width, height) };
    Ok(PyDlt(py.detach(|| estimation::estimate_dlt(world, pixels, &options))?))
}

pub(super) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_class::<PyDlt>()?;
    m.add_function(wrap_pyfunction!(estimate_dlt, m)?)
}
