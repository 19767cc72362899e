//! A view fitted to points from a starting view, and the precision of what was fitted.

use nalgebra::DMatrix;
use rayon::prelude::*;

use super::batch::{FlatView, LANES};
use super::collinearity::Collinearity;
use super::levenberg::{Limits, Outcome, minimise};
use super::loss::Loss;
use super::observations::Observations;
use super::parameters::FreeSet;
use super::priors::Priors;
use crate::error::{Error, Result};
use crate::geometry::View;

/// The trace of the inverse of the scaled normal matrix up to which its digits suffice; beyond, the design matrix itself
/// is factorised.
const WELL_CONDITIONED: f64 = 1e6;

/// The smallest singular value of the design matrix with columns of length 1 that still determines its parameters.
const SINGULAR: f64 = 1e-11;

/// Fits by least squares, plain or robust. `None` where a point is not visible from the start.
pub(super) fn fit(
    observations: &Observations,
    free: &FreeSet,
    priors: &Priors,
    loss: (Loss, f64),
    start: &View,
    limits: &Limits,
) -> Option<Outcome<View>> {
    let problem = Collinearity { free, observations, priors, loss: loss.0, scale: loss.1 };
    minimise(&problem, *start, limits)
}

/// Fits the pose, and what else is free, without priors or loss.
pub(super) fn fit_plainly(
    observations: &Observations,
    free: &FreeSet,
    start: &View,
    limits: &Limits,
) -> Option<Outcome<View>> {
    fit(observations, free, &Priors::default(), (Loss::Squares, 1.0), start, limits)
}

/// (JᵀJ)⁻¹ at a view: the covariance where the sigmas given are the true ones.
pub(super) fn cofactor(problem: &Collinearity<'_>, at: &Outcome<View>) -> Result<DMatrix<f64>> {
    let u = problem.free.len();
    let n = &at.normal;
    let scale: Vec<f64> = (0..u).map(|i| 1.0 / n.at(i, i).sqrt()).collect();
    if let Some(i) = scale.iter().position(|s| !s.is_finite()) {
        return Err(undetermined(&[problem.free.names()[i]], 0.0));
    }
    let scaled = DMatrix::from_fn(u, u, |i, j| n.at(i, j) * scale[i] * scale[j]);
    let inverse = match scaled.cholesky().map(|c| c.inverse()) {
        Some(inverse) if inverse.trace() < WELL_CONDITIONED => inverse,
        _ => inverse_by_rows(problem, &at.state, &scale)?,
    };
    Ok(DMatrix::from_fn(u, u, |i, j| inverse[(i, j)] * scale[i] * scale[j]))
}

/// The same from the triangular factor of the design matrix, which keeps twice the digits.
fn inverse_by_rows(problem: &Collinearity<'_>, view: &View, scale: &[f64]) -> Result<DMatrix<f64>> {
    const ROWS: usize = 512;
    let u = scale.len();
    let rows = problem.all_rows(view).ok_or_else(|| Error::Internal("a fitted point is not visible".into()))?;
    let mut r = DMatrix::<f64>::zeros(u, u);
    for chunk in rows.chunks(ROWS) {
        let stacked =
            DMatrix::from_fn(u + chunk.len(), u, |i, j| if i < u { r[(i, j)] } else { chunk[i - u].0[j] * scale[j] });
        let factor = stacked.qr().unpack_r();
        r = factor.rows(0, u).into_owned();
    }
    let svd = r.svd(false, true);
    let (Some(v_t), Some(&smallest)) = (svd.v_t, svd.singular_values.iter().min_by(|a, b| a.total_cmp(b))) else {
        return Err(Error::Internal("no singular values".into()));
    };
    if smallest < SINGULAR || smallest.is_nan() {
        let row = svd.singular_values.iter().position(|&s| s == smallest).unwrap_or(0);
        let names = problem.free.names();
        let largest = (0..u).map(|j| v_t[(row, j)].abs()).fold(0.0, f64::max);
        let involved: Vec<&str> = (0..u).filter(|&j| v_t[(row, j)].abs() > 0.3 * largest).map(|j| names[j]).collect();
        return Err(undetermined(&involved, smallest));
    }
    Ok(DMatrix::from_fn(u, u, |i, j| (0..u).map(|k| v_t[(k, i)] * v_t[(k, j)] / svd.singular_values[k].powi(2)).sum()))
}

fn undetermined(names: &[&str], value: f64) -> Error {
    Error::Degenerate {
        what: format!("the points do not determine {}", names.join(", ")),
        quantity: "the smallest singular value of the scaled design matrix",
        value,
        limit: SINGULAR,
        remedy: "free fewer parameters, give them priors, or add points elsewhere in depth and in the photo",
    }
}

/// Residuals projected − measured of all points, pixels; NaN where a point is not visible.
pub(super) fn residuals(observations: &Observations, view: &View) -> Vec<[f64; 2]> {
    if let Some(flat) = FlatView::new(view) {
        let mut all = vec![[0.0; 2]; observations.len()];
        let chunks = all.par_chunks_mut(LANES).zip(observations.batches()).with_min_len(4096 / LANES);
        chunks.for_each(|(out, batch)| {
            let [dx, dy] = flat.differences(batch);
            out.iter_mut().enumerate().for_each(|(i, v)| *v = [dx[i], dy[i]]);
        });
        return all;
    }
    let one =
        |p: &[f64; 3], q: &[f64; 2]| view.project(p).map_or([f64::NAN; 2], |(xy, _)| [xy[0] - q[0], xy[1] - q[1]]);
    observations.xyz.par_iter().zip(&observations.xy).with_min_len(4096).map(|(p, q)| one(p, q)).collect()
}
