//! Scale and covariance of an estimate by a robust loss, whose residuals are not all normal.

use nalgebra::DMatrix;

use super::blunders::median;
use super::collinearity::Collinearity;
use super::levenberg::Outcome;
use super::observations::Observations;
use crate::error::{Error, Result};
use crate::geometry::View;

/// The scale of residuals from their median: right for normal errors, untouched by blunders.
pub(super) fn robust_scale(o: &Observations, view: &View, free: usize) -> f64 {
    let mut squares = o.squares(view);
    squares.retain(|s| s.is_finite());
    let n = 2.0 * squares.len() as f64;
    let lost = if n > free as f64 { n / (n - free as f64) } else { 1.0 };
    (median(&mut squares) / (2.0 * std::f64::consts::LN_2) * lost).sqrt().max(1e-9)
}

/// A⁻¹ B A⁻¹ with A = Σ w JᵀJ and B = Σ w² Jᵀv vᵀJ of the points: the covariance of an estimate whose residuals are
/// not normal. Source: Huber and Ronchetti, Robust Statistics, 2nd ed., 7.6.
pub(super) fn sandwich(
    problem: &Collinearity<'_>,
    at: &Outcome<View>,
    a_inverse: &DMatrix<f64>,
) -> Result<DMatrix<f64>> {
    let u = problem.free.len();
    let rows = problem.all_rows(&at.state).ok_or_else(|| Error::Internal("a fitted point is not visible".into()))?;
    let n = problem.observations.len();
    let mut b = DMatrix::<f64>::zeros(u, u);
    for i in 0..n {
        let (p, q) = (&rows[2 * i], &rows[2 * i + 1]);
        let (_, weight) = problem.loss.at((p.1 * p.1 + q.1 * q.1) / (problem.scale * problem.scale));
        let pull: Vec<f64> = (0..u).map(|k| weight * (p.0[k] * p.1 + q.0[k] * q.1)).collect();
        for k in 0..u {
            for l in 0..u {
                b[(k, l)] += pull[k] * pull[l];
            }
        }
    }
    for (row, _) in &rows[2 * n..] {
        for k in 0..u {
            for l in 0..u {
                b[(k, l)] += row[k] * row[l];
            }
        }
    }
    let n2 = 2.0 * n as f64;
    let lost = n2 / (n2 - u as f64).max(1.0);
    Ok(a_inverse * b * a_inverse * lost)
}
