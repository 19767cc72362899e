//! Views from control points.

use nalgebra::DMatrix;
use numpy::{PyArray1, PyArray2, PyUntypedArray, PyUntypedArrayMethods};
use pyo3::prelude::*;
use pyo3::types::PyBool;

use super::arrays::{Input, matrix, owned, owned_rows, points2, points3};
use super::geometry::PyView;
use crate::error::Error;
use crate::estimation::{
    self, Criterion, Loss, Precision, Prior, RansacOptions, Resection, ResectionOptions, Start, Verdict,
};
use crate::geometry::View;

/// A scalar, (N, 2) sigmas, or (N, 2, 2) covariances.
pub(super) fn precision(sigma_xy: Option<&Bound<'_, PyAny>>) -> PyResult<Option<Precision>> {
    let Some(given) = sigma_xy else { return Ok(None) };
    if let Ok(sigma) = given.extract::<f64>()
        && !given.is_instance_of::<PyBool>()
    {
        return Ok(Some(Precision::from_sigma(sigma)?));
    }
    let dimensions = given.cast::<PyUntypedArray>().map(|a| a.ndim()).unwrap_or(2);
    Ok(Some(if dimensions == 3 {
        let input = Input::<f64>::new(given, "sigma_xy", &[None, Some(2), Some(2)])?;
        Precision::from_covariances(input.rows::<4>()?)?
    } else {
        Precision::from_sigmas(points2(given, "sigma_xy")?.rows::<2>()?)?
    }))
}

fn start(name: &str) -> PyResult<Start> {
    Ok(match name {
        "auto" => Start::Auto,
        "given" => Start::Given,
        "search" => Start::Search,
        _ => return Err(Error::invalid(format!("there is no start {name:?}: auto, given or search")).into()),
    })
}

pub(super) fn square<'py>(py: Python<'py>, m: &DMatrix<f64>) -> PyResult<Bound<'py, PyArray2<f64>>> {
    // Symmetric: the order of the elements does not matter.
    owned(py, m.as_slice().to_vec(), [m.nrows(), m.ncols()])
}

#[pyclass(frozen, get_all, name = "Warning", module = "colourreg_rs._core")]
pub(super) struct PyWarning {
    code: &'static str,
    fatal: bool,
    message: String,
    value: f64,
    limit: f64,
}

#[pymethods]
impl PyWarning {
    fn __repr__(&self) -> String {
        format!("Warning({}{}: {})", self.code, if self.fatal { ", fatal" } else { "" }, self.message)
    }
}

#[pyclass(frozen, name = "Verdict", module = "colourreg_rs._core")]
pub(super) struct PyVerdict(pub Verdict);

#[pymethods]
impl PyVerdict {
    #[getter]
    fn ok(&self) -> bool {
        self.0.ok()
    }

    #[getter]
    fn warnings(&self) -> Vec<PyWarning> {
        let one = |w: &estimation::Warning| PyWarning {
            code: w.code,
            fatal: w.fatal,
            message: w.message.clone(),
            value: w.value,
            limit: w.limit,
        };
        self.0.warnings.iter().map(one).collect()
    }

    fn __repr__(&self) -> String {
        let codes: Vec<&str> = self.0.warnings.iter().map(|w| w.code).collect();
        format!(
            "Verdict({}{})",
            if self.0.ok() { "ok" } else { "not ok" },
            codes.iter().map(|c| format!(", {c}")).collect::<String>()
        )
    }
}

#[pyclass(frozen, name = "ResectionResult", module = "colourreg_rs._core")]
pub(super) struct PyResection(Resection);

#[pymethods]
impl PyResection {
    #[getter]
    fn view(&self) -> PyView {
        PyView(self.0.view)
    }

    #[getter]
    fn parameters(&self) -> Vec<&'static str> {
        self.0.names.clone()
    }

    #[getter]
    fn covariance<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        square(py, &self.0.covariance)
    }

    #[getter]
    fn covariance_apriori<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        square(py, &self.0.covariance_apriori)
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
    fn check_rms_x(&self) -> f64 {
        self.0.rms_check.rms_x
    }

    #[getter]
    fn check_rms_y(&self) -> f64 {
        self.0.rms_check.rms_y
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
    fn stop(&self) -> &'static str {
        self.0.stop.name()
    }

    #[getter]
    fn test_ratios<'py>(&self, py: Python<'py>) -> Option<Bound<'py, PyArray1<f64>>> {
        self.0.test_ratios.as_ref().map(|r| PyArray1::from_slice(py, r))
    }

    #[getter]
    fn threshold(&self) -> Option<f64> {
        self.0.search.map(|s| s.0)
    }

    #[getter]
    fn samples(&self) -> Option<usize> {
        self.0.search.map(|s| s.1)
    }

    #[getter]
    fn log10_false_alarms(&self) -> f64 {
        self.0.log10_false_alarms
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
    fn second_view(&self) -> Option<PyView> {
        self.0.second.map(PyView)
    }

    #[getter]
    fn verdict(&self) -> PyVerdict {
        PyVerdict(self.0.verdict.clone())
    }

    fn __repr__(&self) -> String {
        let verdict = PyVerdict(self.0.verdict.clone()).__repr__();
        format!("ResectionResult(rms={:.3} px, dof={}, {verdict})", self.0.rms.rms, self.0.dof)
    }
}

type PriorTuple = (String, f64, f64);

fn named(priors: Vec<PriorTuple>) -> Vec<Prior> {
    priors.into_iter().map(|(name, value, sigma)| Prior { name, value, sigma }).collect()
}

/// The arguments that both resections share.
fn options(
    free: Vec<String>,
    sigma_xy: Option<&Bound<'_, PyAny>>,
    priors: Vec<PriorTuple>,
    loss: &str,
    check: Option<&Bound<'_, PyAny>>,
) -> PyResult<ResectionOptions> {
    let check = match check {
        Some(array) => Input::<bool>::new(array, "check", &[None])?.values()?.to_vec(),
        None => Vec::new(),
    };
    Ok(ResectionOptions {
        free,
        priors: named(priors),
        loss: Loss::from_name(loss)?,
        precision: precision(sigma_xy)?,
        start: Start::Auto,
        check,
    })
}

#[pyfunction]
#[pyo3(signature = (view, *, free=Vec::new(), priors=Vec::new()))]
fn check_parameters(view: &PyView, free: Vec<String>, priors: Vec<PriorTuple>) -> PyResult<()> {
    Ok(estimation::check_parameters(&view.0, &free, &named(priors))?)
}

#[pyfunction]
#[pyo3(signature = (view, xyz, xy, *, free=Vec::new(), sigma_xy=None, priors=Vec::new(), loss="squares", start="auto", check=None))]
#[allow(clippy::too_many_arguments, reason = "keyword arguments of Python")]
fn resect(
    py: Python<'_>,
    view: &PyView,
    xyz: &Bound<'_, PyAny>,
    xy: &Bound<'_, PyAny>,
    free: Vec<String>,
    sigma_xy: Option<&Bound<'_, PyAny>>,
    priors: Vec<PriorTuple>,
    loss: &str,
    start: &str,
    check: Option<&Bound<'_, PyAny>>,
) -> PyResult<PyResection> {
    let (xyz, xy) = (points3(xyz, "xyz")?, points2(xy, "xy")?);
    let (world, pixels) = (xyz.rows::<3>()?, xy.rows::<2>()?);
    let options = ResectionOptions { start: self::start(start)?, ..options(free, sigma_xy, priors, loss, check)? };
    Ok(PyResection(py.detach(|| estimation::resect(&view.0, world, pixels, &options))?))
}

#[pyfunction]
#[pyo3(signature = (
    view, xyz, xy, *, free=Vec::new(), sigma_xy=None, threshold=None, priors=Vec::new(), loss="squares", check=None,
    significance=0.001, confidence=0.9999, max_iterations=100_000, seed=0, unknown_focal=false
))]
#[allow(clippy::too_many_arguments, reason = "keyword arguments of Python")]
fn resect_robust(
    py: Python<'_>,
    view: &PyView,
    xyz: &Bound<'_, PyAny>,
    xy: &Bound<'_, PyAny>,
    free: Vec<String>,
    sigma_xy: Option<&Bound<'_, PyAny>>,
    threshold: Option<f64>,
    priors: Vec<PriorTuple>,
    loss: &str,
    check: Option<&Bound<'_, PyAny>>,
    significance: f64,
    confidence: f64,
    max_iterations: usize,
    seed: u64,
    unknown_focal: bool,
) -> PyResult<PyResection> {
    let (xyz, xy) = (points3(xyz, "xyz")?, points2(xy, "xy")?);
    let (world, pixels) = (xyz.rows::<3>()?, xy.rows::<2>()?);
    let options = options(free, sigma_xy, priors, loss, check)?;
    let criterion = Criterion::of(threshold, options.precision.is_some(), significance)?;
    let search = RansacOptions::new(threshold, confidence, max_iterations, seed, unknown_focal)?;
    let run = || estimation::resect_robust(&view.0, world, pixels, &options, &search, (criterion, significance));
    Ok(PyResection(py.detach(run)?))
}

#[pyfunction]
fn p3p(view: &PyView, xyz: &Bound<'_, PyAny>, xy: &Bound<'_, PyAny>) -> PyResult<Vec<PyView>> {
    let (xyz, xy) = (matrix::<3, 3>(xyz, "xyz")?, matrix::<3, 2>(xy, "xy")?);
    let views: Vec<View> = estimation::views_of_three(&view.0.camera, &xyz, &xy)?;
    Ok(views.into_iter().map(PyView).collect())
}

pub(super) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_class::<PyWarning>()?;
    m.add_class::<PyVerdict>()?;
    m.add_class::<PyResection>()?;
    m.add_function(wrap_pyfunction!(check_parameters, m)?)?;
    m.add_function(wrap_pyfunction!(resect, m)?)?;
    m.add_function(wrap_pyfunction!(resect_robust, m)?)?;
    m.add_function(wrap_pyfunction!(p3p, m)?)
}
