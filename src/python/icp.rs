//! Iterative closest point in the plane.

use nalgebra::{DMatrix, Matrix3};
use numpy::{PyArray1, PyArray2, PyArray3};
use pyo3::prelude::*;

use super::arrays::{Input, matrix, owned, owned_rows, points2};
use crate::error::Error;
use crate::icp::{Metric, Motion, Options, Report, Sets, run};

#[pyclass(frozen, name = "IcpResult", module = "colourreg_rs._core")]
pub(super) struct PyIcpResult(Report);

fn square<'py>(py: Python<'py>, m: &DMatrix<f64>) -> PyResult<Bound<'py, PyArray2<f64>>> {
    owned(py, m.transpose().as_slice().to_vec(), [m.nrows(), m.ncols()])
}

#[pymethods]
impl PyIcpResult {
    #[getter]
    fn transform<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let h = &self.0.transform;
        owned_rows(py, (0..3).map(|i| [h[(i, 0)], h[(i, 1)], h[(i, 2)]]).collect())
    }

    #[getter]
    fn names(&self) -> Vec<&'static str> {
        self.0.motion.names().to_vec()
    }

    #[getter]
    fn parameters<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        PyArray1::from_slice(py, &self.0.parameters)
    }

    #[getter]
    fn covariance<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        square(py, &self.0.covariance)
    }

    #[getter]
    fn pairs<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<i64>>> {
        owned_rows(py, self.0.pairs.iter().map(|p| p.map(i64::from)).collect())
    }

    #[getter]
    fn residuals<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        owned_rows(py, self.0.residuals.clone())
    }

    #[getter]
    fn rms(&self) -> f64 {
        self.0.rms
    }

    #[getter]
    fn rmse(&self) -> f64 {
        self.0.rmse
    }

    #[getter]
    fn sigma0(&self) -> f64 {
        self.0.sigma0
    }

    #[getter]
    fn distinctness(&self) -> f64 {
        self.0.distinctness
    }

    #[getter]
    fn history(&self) -> Vec<(f64, usize, f64, f64)> {
        self.0.history.iter().map(|s| (s.threshold, s.pairs, s.rms, s.change)).collect()
    }

    #[getter]
    fn reason(&self) -> &'static str {
        self.0.reason.name()
    }

    #[getter]
    fn accepted(&self) -> bool {
        self.0.accepted()
    }

    #[getter]
    fn findings(&self) -> Vec<(&'static str, String, f64, f64)> {
        self.0.findings.iter().map(|f| (f.kind.name(), f.to_string(), f.value, f.limit)).collect()
    }

    fn covariance_at<'py>(&self, py: Python<'py>, source: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyArray3<f64>>> {
        let input = points2(source, "source")?;
        let rows = input.rows::<2>()?;
        let all = py.detach(|| self.0.covariance_at(rows));
        let n = all.len();
        owned(py, all.into_flattened().into_flattened(), [n, 2, 2])
    }
}

/// (N, 2, 2) float64, if given.
fn covariances<'py>(array: Option<&Bound<'py, PyAny>>, name: &str) -> PyResult<Option<Input<'py, f64>>> {
    array.map(|a| Input::new(a, name, &[None, Some(2), Some(2)])).transpose()
}

fn as_matrices<'a>(input: Option<&'a Input<'_, f64>>) -> PyResult<Option<&'a [[[f64; 2]; 2]]>> {
    input.map(|i| Ok(i.rows::<2>()?.as_chunks::<2>().0)).transpose()
}

#[pyfunction]
#[pyo3(signature = (
    source, target, *, motion="similarity", metric="point", initial=None, threshold=None, final_threshold=None,
    reduction=0.8, mutual=false, keep=1.0, source_covariance=None, target_covariance=None, gate_probability=0.99,
    neighbours=16, max_iterations=100, change_tolerance=1e-4, residual_limit=1.0, min_pairs=10, scale_limit=1.5,
    min_share=0.25
))]
#[allow(clippy::too_many_arguments, reason = "Python's keywords are Rust's options")]
fn icp<'py>(
    py: Python<'py>,
    source: &Bound<'py, PyAny>,
    target: &Bound<'py, PyAny>,
    motion: &str,
    metric: &str,
    initial: Option<&Bound<'py, PyAny>>,
    threshold: Option<f64>,
    final_threshold: Option<f64>,
    reduction: f64,
    mutual: bool,
    keep: f64,
    source_covariance: Option<&Bound<'py, PyAny>>,
    target_covariance: Option<&Bound<'py, PyAny>>,
    gate_probability: f64,
    neighbours: usize,
    max_iterations: usize,
    change_tolerance: f64,
    residual_limit: f64,
    min_pairs: usize,
    scale_limit: f64,
    min_share: f64,
) -> PyResult<PyIcpResult> {
    let metric = match metric {
        "point" => Metric::PointToPoint,
        "line" => Metric::PointToLine,
        _ => return Err(Error::invalid(format!("there is no metric {metric:?}; there are point and line")).into()),
    };
    let initial = match initial {
        None => Matrix3::identity(),
        Some(array) => {
            let rows = matrix::<3, 3>(array, "initial")?;
            Matrix3::from_fn(|i, j| rows[i][j])
        }
    };
    let options = Options {
        motion: Motion::from_name(motion)?,
        metric,
        initial,
        threshold,
        final_threshold,
        reduction,
        mutual,
        keep,
        gate_probability,
        neighbours,
        max_iterations,
        change_tolerance,
        residual_limit,
        min_pairs,
        scale_limit,
        min_share,
    };
    let (source, target) = (points2(source, "source")?, points2(target, "target")?);
    let source_covariance = covariances(source_covariance, "source_covariance")?;
    let target_covariance = covariances(target_covariance, "target_covariance")?;
    let sets = Sets {
        source: source.rows::<2>()?,
        target: target.rows::<2>()?,
        source_covariance: as_matrices(source_covariance.as_ref())?,
        target_covariance: as_matrices(target_covariance.as_ref())?,
    };
    Ok(PyIcpResult(py.detach(|| run(&sets, &options))?))
}

pub(super) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_class::<PyIcpResult>()?;
    m.add_function(wrap_pyfunction!(icp, m)?)
}
