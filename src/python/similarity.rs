//! Similarity transformations of the plane and of space.

use nalgebra::{SMatrix, SVector};
use numpy::{PyArray1, PyArray2};
use pyo3::prelude::*;

use super::arrays::{Input, matrix, owned, owned_rows, vector};
use crate::estimation::{self, SimilarityFit, SimilarityOptions};
use crate::geometry::Similarity;

/// Estimates of both dimensions, taken apart.
#[pyclass(frozen, name = "SimilarityFit", module = "colourreg_rs._core")]
pub(super) struct PySimilarityFit {
    dimension: usize,
    #[pyo3(get)]
    scale: f64,
    rotation: Vec<f64>,
    translation: Vec<f64>,
    from: Vec<f64>,
    to: Vec<f64>,
    residuals: Vec<f64>,
    #[pyo3(get)]
    sigma0: f64,
    #[pyo3(get)]
    dof: usize,
    covariance: Vec<f64>,
    #[pyo3(get)]
    iterations: usize,
    #[pyo3(get)]
    mirrored: bool,
}

impl<const D: usize> From<SimilarityFit<D>> for PySimilarityFit {
    fn from(fit: SimilarityFit<D>) -> Self {
        let t = fit.similarity();
        Self {
            dimension: D,
            scale: t.scale,
            rotation: t.rotation.transpose().as_slice().to_vec(),
            translation: t.translation.as_slice().to_vec(),
            from: fit.from.as_slice().to_vec(),
            to: fit.to.as_slice().to_vec(),
            residuals: fit.residuals.into_flattened(),
            sigma0: fit.sigma0,
            dof: fit.dof,
            covariance: fit.covariance.as_slice().to_vec(),
            iterations: fit.iterations,
            mirrored: fit.mirrored,
        }
    }
}

#[pymethods]
impl PySimilarityFit {
    #[getter]
    fn rotation<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        owned(py, self.rotation.clone(), [self.dimension, self.dimension])
    }

    #[getter]
    fn translation<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        PyArray1::from_slice(py, &self.translation)
    }

    #[getter]
    fn centre_source<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        PyArray1::from_slice(py, &self.from)
    }

    #[getter]
    fn centre_target<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        PyArray1::from_slice(py, &self.to)
    }

    #[getter]
    fn residuals<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        owned(py, self.residuals.clone(), [self.residuals.len() / self.dimension, self.dimension])
    }

    #[getter]
    fn covariance<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let n = self.covariance.len().isqrt();
        owned(py, self.covariance.clone(), [n, n])
    }

    fn apply<'py>(&self, py: Python<'py>, points: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        if self.dimension == 2 { self.apply_in::<2>(py, points) } else { self.apply_in::<3>(py, points) }
    }
}

impl PySimilarityFit {
    fn apply_in<'py, const D: usize>(
        &self,
        py: Python<'py>,
        points: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let rotation = SMatrix::<f64, D, D>::from_row_slice(&self.rotation);
        let (from, to) = (SVector::<f64, D>::from_row_slice(&self.from), SVector::from_row_slice(&self.to));
        let apply = |p: &[f64; D]| (to + rotation * (SVector::from(*p) - from) * self.scale).into();
        let input = Input::<f64>::new(points, "points", &[None, Some(D)])?;
        owned_rows(py, input.rows::<D>()?.iter().map(apply).collect())
    }
}

fn estimate<const D: usize>(
    py: Python<'_>,
    source: &Bound<'_, PyAny>,
    target: &Bound<'_, PyAny>,
    weights: Option<&[f64]>,
    fixed_scale: bool,
    initial: Option<Similarity<D>>,
) -> PyResult<PySimilarityFit> {
    let source = Input::<f64>::new(source, "source", &[None, Some(D)])?;
    let target = Input::<f64>::new(target, "target", &[None, Some(D)])?;
    let (source, target) = (source.rows::<D>()?, target.rows::<D>()?);
    let options = SimilarityOptions { weights, fixed_scale };
    let fit = py.detach(|| match initial {
        None => estimation::fit_similarity(source, target, &options),
        Some(initial) => estimation::iterate_similarity(source, target, &initial, &options),
    })?;
    Ok(fit.into())
}

fn initial<const D: usize>(
    parts: Option<(f64, Bound<'_, PyAny>, Bound<'_, PyAny>)>,
) -> PyResult<Option<Similarity<D>>> {
    let Some((scale, rotation, translation)) = parts else { return Ok(None) };
    let rotation = matrix::<D, D>(&rotation, "initial rotation")?;
    let translation = vector::<D>(&translation, "initial translation")?;
    let rotation = SMatrix::from_fn(|i, j| rotation[i][j]);
    Ok(Some(Similarity::new(scale, rotation, SVector::from(translation))?))
}

#[pyfunction]
#[pyo3(signature = (source, target, *, weights=None, fixed_scale=false, initial=None))]
fn fit_similarity<'py>(
    py: Python<'py>,
    source: &Bound<'py, PyAny>,
    target: &Bound<'py, PyAny>,
    weights: Option<&Bound<'py, PyAny>>,
    fixed_scale: bool,
    initial: Option<(f64, Bound<'py, PyAny>, Bound<'py, PyAny>)>,
) -> PyResult<PySimilarityFit> {
    let weights = weights.map(|w| Input::<f64>::new(w, "weights", &[None])).transpose()?;
    let weights = weights.as_ref().map(|w| w.values()).transpose()?;
    let plane = source.getattr("shape").is_ok_and(|s| s.extract::<(usize, usize)>().is_ok_and(|s| s.1 == 2));
    if plane {
        let initial = self::initial::<2>(initial)?;
        return estimate::<2>(py, source, target, weights, fixed_scale, initial);
    }
    let initial = self::initial::<3>(initial)?;
    estimate::<3>(py, source, target, weights, fixed_scale, initial)
}

pub(super) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_class::<PySimilarityFit>()?;
    m.add_function(wrap_pyfunction!(fit_similarity, m)?)
}
