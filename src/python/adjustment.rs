//! Adjustments and their statistics.

use nalgebra::{DMatrix, SMatrix};
use numpy::{PyArray1, PyArray2, PyArray3};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;

use super::arrays::{Input, owned, points2, points3};
use super::geometry::PyView;
use crate::adjustment::{
    Adjusted, ControlPoints, FullOptions, ParameterPriors, PointOutcome, Reference, ScannerModel, SimilarityAdjustment,
    TestLevels, ViewAdjustment, ViewConstraint, ViewCovariance, adjust_similarity, adjust_view,
};
use crate::error::Error;
use crate::estimation::FreeSet;

type Matrix<'py> = Bound<'py, PyArray2<f64>>;
type NamedMatrix<'py> = (Vec<&'static str>, Matrix<'py>);
/// Scale, rotation, translation.
type SimilarityParts<'py> = (f64, Matrix<'py>, Bound<'py, PyArray1<f64>>);
type Matrices<'py> = Bound<'py, PyArray3<f64>>;

/// A dynamic matrix, row by row.
pub(super) fn matrix_out<'py>(py: Python<'py>, m: &DMatrix<f64>) -> PyResult<Bound<'py, PyArray2<f64>>> {
    owned(py, m.transpose().as_slice().to_vec(), [m.nrows(), m.ncols()])
}

/// A square (K, K) matrix from Python.
pub(super) fn square(array: &Bound<'_, PyAny>, name: &str, k: usize) -> PyResult<DMatrix<f64>> {
    let input = Input::<f64>::new(array, name, &[Some(k), Some(k)])?;
    Ok(DMatrix::from_row_slice(k, k, input.values()?))
}

/// Rows of `per` values of each point.
fn columns<'py, S, const C: usize, const M: usize>(
    py: Python<'py>,
    adjusted: &Adjusted<S, C, M>,
    per: usize,
    values: impl Fn(&PointOutcome<C, M>) -> Vec<f64>,
) -> PyResult<Bound<'py, PyArray2<f64>>> {
    owned(py, adjusted.points.iter().flat_map(values).collect(), [adjusted.points.len(), per])
}

/// What all adjustments say, as a dictionary of arrays and numbers.
fn statistics<'py, S, const C: usize, const M: usize>(
    py: Python<'py>,
    adjusted: &Adjusted<S, C, M>,
) -> PyResult<Bound<'py, PyDict>> {
    let out = PyDict::new(py);
    let (n, u, solution) = (adjusted.points.len(), adjusted.names.len(), &adjusted.solution);
    let number = |f: fn(&PointOutcome<C, M>) -> f64| PyArray1::from_iter(py, adjusted.points.iter().map(f));
    out.set_item("dof", solution.dof)?;
    out.set_item("iterations", solution.iterations)?;
    out.set_item("omega", solution.omega)?;
    out.set_item("variance_factor", solution.variance_factor())?;
    out.set_item("sigma0", solution.variance_factor().map(f64::sqrt))?;
    out.set_item("scale", adjusted.scale)?;
    out.set_item("scale_dof", adjusted.scale_dof)?;
    out.set_item("smallest_eigenvalue", solution.smallest_eigenvalue)?;
    out.set_item("variance_test", adjusted.variance_test.map(|t| (t.lower, t.upper, t.p_value, t.accepted)))?;
    out.set_item("critical", adjusted.critical)?;
    out.set_item("noncentrality", adjusted.noncentrality)?;
    out.set_item("cofactor", matrix_out(py, &solution.cofactor)?)?;
    out.set_item("correlations", matrix_out(py, &adjusted.correlations())?)?;
    let named = |(i, j, r): (usize, usize, f64)| (adjusted.names[i].clone(), adjusted.names[j].clone(), r);
    out.set_item("high_correlations", adjusted.high_correlations().into_iter().map(named).collect::<Vec<_>>())?;
    out.set_item("rejected", adjusted.rejected.iter().map(|r| (r.point, r.statistic, r.critical)).collect::<Vec<_>>())?;
    let r = adjusted.redundancy;
    out.set_item("group_redundancy", (r.predicted, r.given, r.priors))?;
    let c = adjusted.components;
    out.set_item("variance_components", c.map(|c| (c.factors, c.sigmas, c.correlation)))?;
    out.set_item("used", PyArray1::from_iter(py, adjusted.points.iter().map(|p| p.used)))?;
    out.set_item("residuals", columns(py, adjusted, C, |p| p.residual.iter().copied().collect())?)?;
    out.set_item("corrections", columns(py, adjusted, M, |p| p.corrections.iter().copied().collect())?)?;
    out.set_item("redundancy", columns(py, adjusted, M, |p| p.reliability.redundancy.iter().copied().collect())?)?;
    out.set_item("statistic", number(|p| p.reliability.statistic))?;
    out.set_item("p_value", number(|p| p.reliability.p_value))?;
    out.set_item("deleted", columns(py, adjusted, C, |p| p.reliability.deleted.iter().copied().collect())?)?;
    let deleted = columns(py, adjusted, C * C, |p| p.reliability.deleted_covariance.iter().copied().collect())?;
    out.set_item("deleted_covariance", numpy::PyArrayMethods::reshape(&deleted, [n, C, C])?)?;
    out.set_item("detectable", number(|p| p.reliability.detectable))?;
    out.set_item(
        "detectable_direction",
        columns(py, adjusted, C, |p| p.reliability.direction.iter().copied().collect())?,
    )?;
    let by_observation = |p: &PointOutcome<C, M>| p.reliability.detectable_observation.iter().copied().collect();
    out.set_item("detectable_observation", columns(py, adjusted, M, by_observation)?)?;
    out.set_item("effect_on_parameters", columns(py, adjusted, u, |p| p.reliability.effect_on_parameters.clone())?)?;
    out.set_item("effect_on_places", number(|p| p.reliability.effect_on_places))?;
    Ok(out)
}

#[pyclass(frozen, name = "Adjustment", module = "colourreg_rs._core")]
struct PyAdjustment(ViewAdjustment);

#[pymethods]
impl PyAdjustment {
    #[getter]
    fn view(&self) -> PyView {
        PyView(self.0.view)
    }

    #[getter]
    fn names(&self) -> Vec<String> {
        self.0.adjusted.names.clone()
    }

    #[getter]
    fn values<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        PyArray1::from_vec(py, self.0.free.values(&self.0.view))
    }

    #[getter]
    fn covariance<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        matrix_out(py, &self.0.adjusted.covariance)
    }

    fn dlt_covariance<'py>(&self, py: Python<'py>) -> PyResult<Option<NamedMatrix<'py>>> {
        let found = self.0.covariance()?.dlt_elements(&self.0.view);
        found.map(|(names, matrix)| Ok((names, matrix_out(py, &matrix)?))).transpose()
    }

    fn statistics<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        statistics(py, &self.0.adjusted)
    }
}

/// The keywords that all adjustments take.
fn options_of(keywords: Option<&Bound<'_, PyDict>>) -> PyResult<FullOptions> {
    let mut options = FullOptions::default();
    for (key, value) in keywords.into_iter().flatten() {
        match key.extract::<String>()?.as_str() {
            "alpha" => options.levels.alpha = value.extract()?,
            "power" => options.levels.power = value.extract()?,
            "estimate_variance" => options.levels.estimated = value.extract()?,
            "alpha_variance" => options.alpha_variance = value.extract()?,
            "snoop" => options.snoop = value.extract()?,
            "variance_components" => options.components = value.extract()?,
            other => return Err(pyo3::exceptions::PyTypeError::new_err(format!("unexpected keyword {other:?}"))),
        }
    }
    let TestLevels { alpha, power, .. } = options.levels;
    if !(alpha > 0.0 && alpha < power && power < 1.0) {
        return Err(
            Error::invalid(format!("alpha = {alpha} and power = {power}: 0 < alpha < power < 1 is needed")).into()
        );
    }
    Ok(options)
}

fn priors_of(given: Option<(Vec<String>, Vec<f64>, Bound<'_, PyAny>)>) -> PyResult<Option<ParameterPriors>> {
    given
        .map(|(names, values, covariance)| {
            let covariance = square(&covariance, "priors[2]", names.len())?;
            Ok(ParameterPriors { names, values, covariance })
        })
        .transpose()
}

type LinearConstraint = (Vec<(String, f64)>, f64);

fn constraints_of(linear: Vec<LinearConstraint>, distances: Vec<([f64; 3], f64)>) -> Vec<ViewConstraint> {
    let linear = linear.into_iter().map(|(terms, value)| ViewConstraint::Linear { terms, value });
    let distances = distances.into_iter().map(|(point, distance)| ViewConstraint::CentreDistance { point, distance });
    linear.chain(distances).collect()
}

#[pyfunction]
#[pyo3(signature = (view, xyz, xy, cov_xyz, cov_xy, free, *, dlt=false, priors=None, constraints=vec![], distances=vec![], **keywords))]
#[allow(clippy::too_many_arguments, reason = "keywords in Python")]
fn adjust<'py>(
    py: Python<'py>,
    view: &PyView,
    xyz: &Bound<'py, PyAny>,
    xy: &Bound<'py, PyAny>,
    cov_xyz: &Bound<'py, PyAny>,
    cov_xy: &Bound<'py, PyAny>,
    free: Vec<String>,
    dlt: bool,
    priors: Option<(Vec<String>, Vec<f64>, Bound<'py, PyAny>)>,
    constraints: Vec<LinearConstraint>,
    distances: Vec<([f64; 3], f64)>,
    keywords: Option<&Bound<'py, PyDict>>,
) -> PyResult<PyAdjustment> {
    let (xyz, xy) = (points3(xyz, "xyz")?, points2(xy, "xy")?);
    let n = Some(xyz.shape()[0]);
    let cov_xyz = Input::<f64>::new(cov_xyz, "cov_xyz", &[n, Some(3), Some(3)])?;
    let cov_xy = Input::<f64>::new(cov_xy, "cov_xy", &[n, Some(2), Some(2)])?;
    let points = ControlPoints {
        xyz: xyz.rows::<3>()?,
        xy: xy.rows::<2>()?,
        covariance_xyz: cov_xyz.matrices::<3>()?,
        covariance_xy: cov_xy.matrices::<2>()?,
    };
    let free = if dlt { FreeSet::dlt(&free)? } else { FreeSet::parse(view.0.camera.model(), &free)? };
    let (options, priors) = (options_of(keywords)?, priors_of(priors)?);
    let constraints = constraints_of(constraints, distances);
    let found = py.detach(|| adjust_view(&view.0, &points, &free, priors.as_ref(), &constraints, &options))?;
    Ok(PyAdjustment(found))
}

enum EitherSimilarity {
    Plane(SimilarityAdjustment<2, 4>),
    Space(SimilarityAdjustment<3, 6>),
}

#[pyclass(frozen, name = "SimilarityAdjustment", module = "colourreg_rs._core")]
struct PySimilarityAdjustment(EitherSimilarity);

fn parts<'py, const D: usize>(
    py: Python<'py>,
    scale: f64,
    rotation: &SMatrix<f64, D, D>,
    translation: &[f64],
) -> PyResult<SimilarityParts<'py>> {
    let rotation = owned(py, rotation.transpose().iter().copied().collect(), [D, D])?;
    Ok((scale, rotation, PyArray1::from_slice(py, translation)))
}

#[pymethods]
impl PySimilarityAdjustment {
    /// Scale, rotation, translation.
    #[getter]
    fn similarity<'py>(&self, py: Python<'py>) -> PyResult<SimilarityParts<'py>> {
        match &self.0 {
            EitherSimilarity::Plane(a) => {
                parts(py, a.similarity.scale, &a.similarity.rotation, a.similarity.translation.as_slice())
            }
            EitherSimilarity::Space(a) => {
                parts(py, a.similarity.scale, &a.similarity.rotation, a.similarity.translation.as_slice())
            }
        }
    }

    #[getter]
    fn names(&self) -> Vec<String> {
        match &self.0 {
            EitherSimilarity::Plane(a) => a.adjusted.names.clone(),
            EitherSimilarity::Space(a) => a.adjusted.names.clone(),
        }
    }

    #[getter]
    fn covariance<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        match &self.0 {
            EitherSimilarity::Plane(a) => matrix_out(py, &a.covariance),
            EitherSimilarity::Space(a) => matrix_out(py, &a.covariance),
        }
    }

    fn statistics<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        match &self.0 {
            EitherSimilarity::Plane(a) => statistics(py, &a.adjusted),
            EitherSimilarity::Space(a) => statistics(py, &a.adjusted),
        }
    }
}

#[pyfunction]
#[pyo3(name = "adjust_similarity", signature = (source, target, cov_source, cov_target, **keywords))]
fn adjust_similarity_py<'py>(
    py: Python<'py>,
    source: &Bound<'py, PyAny>,
    target: &Bound<'py, PyAny>,
    cov_source: &Bound<'py, PyAny>,
    cov_target: &Bound<'py, PyAny>,
    keywords: Option<&Bound<'py, PyDict>>,
) -> PyResult<PySimilarityAdjustment> {
    let options = options_of(keywords)?;
    let from = Input::<f64>::new(source, "source", &[None, None])?;
    let [n, d] = [from.shape()[0], from.shape()[1]];
    let to = Input::<f64>::new(target, "target", &[Some(n), Some(d)])?;
    let shape = [Some(n), Some(d), Some(d)];
    let (cov_from, cov_to) =
        (Input::<f64>::new(cov_source, "cov_source", &shape)?, Input::<f64>::new(cov_target, "cov_target", &shape)?);
    let found = match d {
        2 => {
            let (a, b, c, e) = (from.rows::<2>()?, to.rows::<2>()?, cov_from.matrices::<2>()?, cov_to.matrices::<2>()?);
            EitherSimilarity::Plane(py.detach(|| adjust_similarity(a, b, c, e, &options))?)
        }
        3 => {
            let (a, b, c, e) = (from.rows::<3>()?, to.rows::<3>()?, cov_from.matrices::<3>()?, cov_to.matrices::<3>()?);
            EitherSimilarity::Space(py.detach(|| adjust_similarity(a, b, c, e, &options))?)
        }
        _ => {
            return Err(PyValueError::new_err(format!("source has {d} columns: a similarity is of 2 or 3 dimensions")));
        }
    };
    Ok(PySimilarityAdjustment(found))
}

#[pyfunction]
fn scanner_covariance<'py>(
    py: Python<'py>,
    xyz: &Bound<'py, PyAny>,
    station: [f64; 3],
    sigma_range: f64,
    sigma_horizontal: f64,
    sigma_vertical: f64,
) -> PyResult<Matrices<'py>> {
    let input = points3(xyz, "xyz")?;
    let points = input.rows::<3>()?;
    let scanner = ScannerModel::new(station, sigma_range, sigma_horizontal, sigma_vertical)?;
    let all: Vec<f64> = points.iter().flat_map(|p| scanner.covariance(p)).flatten().collect();
    owned(py, all, [points.len(), 3, 3])
}

#[pyfunction]
#[pyo3(signature = (probability, dimension, dof=None))]
fn region_limit(probability: f64, dimension: usize, dof: Option<usize>) -> PyResult<f64> {
    Ok(dimension as f64 * Reference::new(dimension, dof).critical_value(1.0 - probability)?)
}

#[pyfunction]
#[pyo3(signature = (value, dimension, dof=None))]
fn exceedance(value: f64, dimension: usize, dof: Option<usize>) -> f64 {
    Reference::new(dimension, dof).exceedance(value / dimension as f64)
}

/// The covariance of a view from names and matrix.
pub(super) fn view_covariance(
    view: &PyView,
    names: &[String],
    covariance: &Bound<'_, PyAny>,
) -> PyResult<ViewCovariance> {
    Ok(ViewCovariance::from_names(&view.0, names, &square(covariance, "covariance", names.len())?)?)
}

pub(super) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_class::<PyAdjustment>()?;
    m.add_class::<PySimilarityAdjustment>()?;
    m.add_function(wrap_pyfunction!(adjust, m)?)?;
    m.add_function(wrap_pyfunction!(adjust_similarity_py, m)?)?;
    m.add_function(wrap_pyfunction!(scanner_covariance, m)?)?;
    m.add_function(wrap_pyfunction!(region_limit, m)?)?;
    m.add_function(wrap_pyfunction!(exceedance, m)?)
}
