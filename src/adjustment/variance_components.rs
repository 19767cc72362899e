//! Variance components: how far the sigmas of the photo's and of the object's coordinates are from the truth.
//!
//! W = σ_p² W_p + σ_o² W_o, where W_p comes from the predicted observations (photo) and W_o from the given ones (object).
//! With P̃ = W⁻¹ − W⁻¹ A Q Aᵀ W⁻¹ the estimate solves `S σ² = h`, `h_g = wᵀ W⁻¹ W_g W⁻¹ w`, `S_gh = tr(P̃ W_g P̃ W_h)`, and
//! is iterated with the adjustment; the components' covariance is 2 S⁻¹. The double sum over pairs of points in S
//! collapses to matrices of the parameters' size.
//!
//! Sources: F. R. Helmert 1907; W. Förstner, Ein Verfahren zur Schätzung von Varianz- und Kovarianzkomponenten, 1979;
//! K.-R. Koch, Parameter Estimation and Hypothesis Testing in Linear Models, 1999, ch. 3.6.

use nalgebra::{DMatrix, Matrix2, SMatrix, Vector2};

use super::gauss_helmert::{Conditions, Observed, PointFit, Solution, adjust};
use crate::error::{Error, Result};

const MAX_ITERATIONS: usize = 50;
/// Above this correlation the two components explain each other.
const INSEPARABLE: f64 = 0.995;

/// The two factors by which the given variances have to be multiplied.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VarianceComponents {
    /// For the predicted observations (photo, or target frame) and for the given ones (object, or source frame).
    pub factors: [f64; 2],
    /// Their standard deviations.
    pub sigmas: [f64; 2],
    /// Their correlation.
    pub correlation: f64,
    /// Steps taken.
    pub iterations: usize,
}

/// Covariances with the two groups multiplied by their factors; observations of different groups keep their correlation.
pub fn rescaled<const C: usize, const M: usize>(observed: &[Observed<M>], factors: &[f64; 2]) -> Vec<Observed<M>> {
    let root = |i: usize| factors[usize::from(i >= C)].sqrt();
    observed
        .iter()
        .map(|o| Observed {
            value: o.value,
            covariance: SMatrix::from_fn(|i, j| o.covariance[(i, j)] * root(i) * root(j)),
        })
        .collect()
}

/// Estimates the components; `start` is an adjusted state.
pub fn variance_components<Q, const C: usize, const M: usize>(
    conditions: &Q,
    start: &Q::State,
    observed: &[Observed<M>],
) -> Result<(VarianceComponents, Solution<Q::State, C, M>)>
where
    Q: Conditions<C, M>,
{
    let mut factors = [1.0; 2];
    let mut state = start.clone();
    for iterations in 1..=MAX_ITERATIONS {
        let scaled = rescaled::<C, M>(observed, &factors);
        let solution = adjust(conditions, &state, &scaled)?;
        let (s, h) = helmert_system(&solution, &scaled);
        // In units of the present factors both unknowns are near one.
        let correlation = correlation_of(&s)?;
        let updates = s.try_inverse().ok_or_else(inseparable(1.0))? * h;
        let change = updates.iter().map(|x| (x - 1.0).abs()).fold(0.0, f64::max);
        if change < 1e-6 {
            let covariance = s.try_inverse().ok_or_else(inseparable(1.0))? * 2.0;
            let sigmas = [0, 1].map(|g| factors[g] * covariance[(g, g)].max(0.0).sqrt());
            return Ok((VarianceComponents { factors, sigmas, correlation, iterations }, solution));
        }
        for (factor, update) in factors.iter_mut().zip(updates.iter()) {
            // A component that wants to be negative is brought down in steps; one that vanishes is an answer too.
            *factor *= update.clamp(0.1, 10.0);
        }
        if let Some(g) = factors.iter().position(|f| *f < 1e-8) {
            return Err(Error::Degenerate {
                what: format!("the variance of the {} coordinates cannot be estimated", ["photo's", "object's"][g]),
                quantity: "its factor",
                value: factors[g],
                limit: 1e-8,
                remedy: "the other group explains all residuals: keep the sigmas as given",
            });
        }
        state = solution.state;
    }
    Err(Error::NotConverged {
        what: "the estimation of variance components",
        iterations: MAX_ITERATIONS,
        detail: format!("the factors are {:.3e} and {:.3e}", factors[0], factors[1]),
    })
}

fn inseparable(correlation: f64) -> impl Fn() -> Error {
    move || Error::Degenerate {
        what: "the variances of photo and object coordinates cannot be told apart".into(),
        quantity: "their correlation",
        value: correlation,
        limit: INSEPARABLE,
        remedy: "both act alike on these points: points at different depths, or keep the sigmas as given",
    }
}

fn correlation_of(s: &Matrix2<f64>) -> Result<f64> {
    let product = s[(0, 0)] * s[(1, 1)];
    if product <= 0.0 || product.is_nan() {
        return Err(Error::Degenerate {
            what: "a variance component has no observations".into(),
            quantity: "its redundancy",
            value: s[(0, 0)].min(s[(1, 1)]),
            limit: 0.0,
            remedy: "give sigmas for photo and object coordinates",
        });
    }
    let correlation = -s[(0, 1)] / product.sqrt();
    if correlation.abs() > INSEPARABLE { Err(inseparable(correlation.abs())()) } else { Ok(correlation) }
}

/// S and h, in units of the components that `observed` has.
fn helmert_system<S, const C: usize, const M: usize>(
    solution: &Solution<S, C, M>,
    observed: &[Observed<M>],
) -> (Matrix2<f64>, Vector2<f64>) {
    let u = solution.cofactor.nrows();
    let q = &solution.cofactor;
    let mut s = Matrix2::zeros();
    let mut h = Vector2::zeros();
    let mut inner = [DMatrix::zeros(u, u), DMatrix::zeros(u, u)];
    for (point, o) in solution.points.iter().zip(observed) {
        let parts = parts_of(point, &o.covariance);
        let a = point.design_matrix(u);
        let aq = &a * q;
        let weighted = point.weight * point.misclosure;
        let wg: [SMatrix<f64, C, C>; 2] = [0, 1].map(|g| point.weight * parts[g]);
        for g in 0..2 {
            h[g] += weighted.dot(&(parts[g] * weighted));
            let small = wg[g] * point.weight;
            let dynamic = DMatrix::from_fn(C, C, |i, j| small[(i, j)]);
            inner[g] += a.transpose() * dynamic * &a;
            for k in 0..2 {
                let both = wg[g] * wg[k];
                let sandwich = both * point.weight;
                let dynamic = DMatrix::from_fn(C, C, |i, j| sandwich[(i, j)]);
                // 2 tr(Q Aᵀ W⁻¹ W_g W⁻¹ W_k W⁻¹ A)
                s[(g, k)] += both.trace() - 2.0 * (&aq * a.transpose() * dynamic).trace();
            }
        }
    }
    for g in 0..2 {
        for k in 0..2 {
            s[(g, k)] += (q * &inner[g] * q * &inner[k]).trace();
        }
    }
    s[(0, 1)] = 0.5 * (s[(0, 1)] + s[(1, 0)]);
    s[(1, 0)] = s[(0, 1)];
    (s, h)
}

/// W_p and W_o of a point; a correlation between the groups belongs half to each.
fn parts_of<const C: usize, const M: usize>(
    point: &PointFit<C, M>,
    covariance: &SMatrix<f64, M, M>,
) -> [SMatrix<f64, C, C>; 2] {
    [0, 1].map(|g| {
        let part = SMatrix::<f64, M, M>::from_fn(|i, j| {
            let share = 0.5 * f64::from(u8::from((i >= C) == (g == 1)) + u8::from((j >= C) == (g == 1)));
            share * covariance[(i, j)]
        });
        point.by_observations * part * point.by_observations.transpose()
    })
}
