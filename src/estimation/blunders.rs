//! Which points are blunders: from a rough set of supporters to the set that every test agrees with.
//!
//! Each point is tested against the fit of the *others*: a supporter by its deleted residual, a rejected point by its
//! prediction error, which is the same statistic,
//!
//! ```text
//! F = vᵀ (Σ + J Q Jᵀ)⁻¹ v / 2 σ̂²   with 2 and r degrees of freedom
//! ```
//! where v is the misclosure to the fit without the point, Q that fit's cofactor matrix and r its redundancy (σ̂ = 1 and
//! r = ∞ where the sigmas are known). The worst supporter that fails leaves, rejected points that pass come back, and the
//! view is fitted again, until nothing changes. The level α holds for the whole set: each of n tests has α/n.
//!
//! Sources: W. Baarda 1968 (data snooping); R. D. Cook and S. Weisberg, Residuals and Influence in Regression, 1982.

use nalgebra::{DMatrix, Matrix2, Vector2};

use super::collinearity::Collinearity;
use super::fit::{cofactor, fit};
use super::levenberg::{Limits, Outcome};
use super::loss::Loss;
use super::observations::Observations;
use super::parameters::{FreeSet, MAX_FREE};
use super::priors::Priors;
use crate::error::{Error, Result};
use crate::geometry::View;

/// Points up to which every test takes the leverage of its point into account and blunders leave one at a time.
const CAREFUL: usize = 400;
/// Rounds of fit and test.
const ROUNDS: usize = 200;

/// What tells a blunder.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Criterion {
    /// A fixed radius, pixels.
    Threshold(f64),
    /// The test, with the sigmas as they were given.
    KnownSigma,
    /// The test, with the variance factor of the supporters.
    EstimatedSigma,
}

impl Criterion {
    /// A given threshold decides, else given sigmas, else the residuals themselves.
    pub fn of(threshold: Option<f64>, sigma_is_known: bool, significance: f64) -> Result<Self> {
        if !(significance > 0.0 && significance < 0.5) {
            return Err(Error::invalid(format!("significance = {significance}: it lies between 0 and 0.5")));
        }
        match threshold {
            Some(t) if t > 0.0 && t.is_finite() => Ok(Self::Threshold(t)),
            Some(t) => Err(Error::invalid(format!("threshold = {t}: it is positive, in pixels"))),
            None if sigma_is_known => Ok(Self::KnownSigma),
            None => Ok(Self::EstimatedSigma),
        }
    }
}

/// The points that support a view, and the view that they give.
#[derive(Debug, Clone)]
pub(super) struct Selection {
    pub used: Vec<usize>,
    pub outcome: Outcome<View>,
    /// The test statistic of each point over its critical value: above 1 is a blunder.
    pub ratios: Vec<f64>,
}

/// The upper α quantile of F with 2 and r degrees of freedom, in closed form; r = ∞ is χ²/2.
pub(super) fn critical_f2(alpha: f64, r: f64) -> f64 {
    if r > 1e6 { -alpha.ln() } else { 0.5 * r * (alpha.powf(-2.0 / r) - 1.0) }
}

struct Selector<'a> {
    o: &'a Observations,
    free: &'a FreeSet,
    priors: &'a Priors,
    criterion: Criterion,
    significance: f64,
}

/// From the supporters of a rough view to the final set.
pub(super) fn select(
    o: &Observations,
    (free, priors): (&FreeSet, &Priors),
    (start, radius): (&View, f64),
    criterion: Criterion,
    significance: f64,
) -> Result<Selection> {
    let selector = Selector { o, free, priors, criterion, significance };
    let squares = o.squares(start);
    let sigma = o.precision.typical_sigma();
    let limit = (radius / sigma).powi(2);
    let mut used: Vec<usize> = (0..o.len()).filter(|&i| squares[i] <= limit).collect();
    let mut view = *start;
    let mut seen: Vec<Vec<usize>> = Vec::new();
    for round in 1..=ROUNDS {
        let outcome = selector.fit(&used, &view)?;
        view = outcome.state;
        let (next, ratios) = selector.retest(&used, &outcome, round)?;
        if next == used || seen.contains(&next) {
            return Ok(Selection { used, outcome, ratios });
        }
        seen.push(std::mem::replace(&mut used, next));
    }
    Err(Error::NotConverged {
        what: "the selection of blunders",
        iterations: ROUNDS,
        detail: format!("{} of {} points were in use at the end", used.len(), o.len()),
    })
}

impl Selector<'_> {
    /// Fits what the supporters can carry: everything that is free, or the pose until there are enough of them.
    fn fit(&self, used: &[usize], start: &View) -> Result<Outcome<View>> {
        let pose = FreeSet::pose(self.free.model());
        let equations = 2 * used.len() + self.priors.terms.len();
        let enough = equations >= self.free.len() + 4;
        let (free, none) = (if enough { self.free } else { &pose }, Priors::default());
        let priors = if enough { self.priors } else { &none };
        if 2 * used.len() < 6 {
            return Err(Error::Degenerate {
                what: "the points do not agree on a view".into(),
                quantity: "the number of points that support the best one",
                value: used.len() as f64,
                limit: 3.0,
                remedy: "check the pairing of the points, the camera and the threshold",
            });
        }
        fit(&self.o.select(used), free, priors, (Loss::Squares, 1.0), start, &Limits::default())
            .filter(|outcome| outcome.stop.converged())
            .ok_or_else(|| Error::NotConverged {
                what: "the fit to the points that support the view",
                iterations: Limits::default().iterations,
                detail: format!("{} points", used.len()),
            })
    }

    fn retest(&self, used: &[usize], at: &Outcome<View>, round: usize) -> Result<(Vec<usize>, Vec<f64>)> {
        match self.criterion {
            Criterion::Threshold(t) => {
                let limit = (t / self.o.precision.typical_sigma()).powi(2);
                let ratios: Vec<f64> = self.o.squares(&at.state).iter().map(|s| s / limit).collect();
                Ok(((0..ratios.len()).filter(|&i| ratios[i] <= 1.0).collect(), ratios))
            }
            _ if self.o.len() > CAREFUL => Ok(self.retest_many(used, at, round)),
            _ => self.retest_few(used, at),
        }
    }

    /// Many points: one more or less moves the fit by nothing that matters.
    fn retest_many(&self, used: &[usize], at: &Outcome<View>, round: usize) -> (Vec<usize>, Vec<f64>) {
        let squares = self.o.squares(&at.state);
        let dof = (2 * used.len() + self.priors.terms.len()) as f64 - at.normal.len as f64;
        let variance = match self.criterion {
            Criterion::KnownSigma => 1.0,
            // At first the supporters may hold blunders, or only the best points: their median is safe.
            _ if round <= 2 => {
                let mut s: Vec<f64> = used.iter().map(|&i| squares[i]).collect();
                median(&mut s) / (2.0 * std::f64::consts::LN_2)
            }
            _ => at.normal.cost / dof.max(1.0),
        };
        let r = if self.criterion == Criterion::KnownSigma { f64::INFINITY } else { dof };
        let limit = 2.0 * critical_f2(self.significance / self.o.len() as f64, r) * variance;
        // Noise-free points differ by rounding alone.
        let limit = limit.max(self.rounding());
        let ratios: Vec<f64> = squares.iter().map(|s| s / limit).collect();
        ((0..ratios.len()).filter(|&i| ratios[i] <= 1.0).collect(), ratios)
    }

    /// Few points: every one has its leverage.
    fn retest_few(&self, used: &[usize], at: &Outcome<View>) -> Result<(Vec<usize>, Vec<f64>)> {
        let u = at.normal.len;
        let pose = FreeSet::pose(self.free.model());
        let none = Priors::default();
        // As in the fit: everything that is free, or the pose alone.
        let whole = u == self.free.len();
        let (free, priors) = if whole { (self.free, self.priors) } else { (&pose, &none) };
        let supporters = self.o.select(used);
        let problem = Collinearity { free, observations: &supporters, priors, loss: Loss::Squares, scale: 1.0 };
        let q = cofactor(&problem, at)?;
        let dof = (2 * used.len() + self.priors.terms.len()) as f64 - u as f64;
        let known = self.criterion == Criterion::KnownSigma;
        let alpha = self.significance / self.o.len() as f64;
        let rounding = self.rounding();
        let mut ratios = vec![f64::INFINITY; self.o.len()];
        for i in 0..self.o.len() {
            let Some((v, jqj)) = self.misclosure(free, &q, &at.state, i) else { continue };
            let inside = used.binary_search(&i).is_ok();
            // Inside, Σ − J Q Jᵀ is the covariance of the residual; outside, Σ + J Q Jᵀ that of the prediction.
            let spread = if inside { Matrix2::identity() - jqj } else { Matrix2::identity() + jqj };
            let untestable = inside && spread.determinant() < 1e-9;
            let Some(inverse) = spread.try_inverse().filter(|_| !untestable) else {
                ratios[i] = 0.0;
                continue;
            };
            let square = v.dot(&(inverse * v)).max(0.0);
            let (rest, r) =
                if inside { ((at.normal.cost - square).max(0.0), dof - 2.0) } else { (at.normal.cost, dof) };
            ratios[i] = if known {
                square / (2.0 * critical_f2(alpha, f64::INFINITY)).max(rounding)
            } else if r < 1.0 {
                // Nothing is left to judge by.
                if inside { 0.0 } else { f64::INFINITY }
            } else {
                square / (2.0 * critical_f2(alpha, r) * rest / r).max(rounding)
            };
        }
        let worst = used.iter().copied().max_by(|&a, &b| ratios[a].total_cmp(&ratios[b]));
        let next = match worst {
            Some(worst) if ratios[worst] > 1.0 => used.iter().copied().filter(|&i| i != worst).collect(),
            _ => (0..self.o.len()).filter(|i| ratios[*i] <= 1.0).collect(),
        };
        Ok((next, ratios))
    }

    /// The weighted misclosure of a point and J Q Jᵀ; `None` where it is not visible.
    fn misclosure(
        &self,
        free: &FreeSet,
        q: &DMatrix<f64>,
        view: &View,
        i: usize,
    ) -> Option<(Vector2<f64>, Matrix2<f64>)> {
        let j = view.project_with_jacobian(&self.o.xyz[i])?;
        let mut rows = [[0.0; MAX_FREE]; 2];
        free.columns(view, &j, &mut rows);
        let precision = &self.o.precision;
        let v = precision.whiten(i, [j.xy[0] - self.o.xy[i][0], j.xy[1] - self.o.xy[i][1]]);
        for k in 0..free.len() {
            [rows[0][k], rows[1][k]] = precision.whiten(i, [rows[0][k], rows[1][k]]);
        }
        let product = |a: usize, b: usize| -> f64 {
            (0..free.len()).map(|k| rows[a][k] * (0..free.len()).map(|l| q[(k, l)] * rows[b][l]).sum::<f64>()).sum()
        };
        Some((Vector2::new(v[0], v[1]), Matrix2::new(product(0, 0), product(0, 1), product(1, 0), product(1, 1))))
    }

    /// The square of a misclosure, in sigmas, that rounding alone may leave.
    fn rounding(&self) -> f64 {
        let size = self.o.xy.iter().flatten().fold(100.0_f64, |m, v| m.max(v.abs()));
        (1e-9 * size / self.o.precision.typical_sigma()).powi(2)
    }
}

/// The (upper) median; zero of nothing.
pub(super) fn median(values: &mut [f64]) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, |a, b| a.total_cmp(b)).1
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn critical_values_are_those_of_the_tables() {
        // F(2, 10) at 5 % and 1 %, χ²(2)/2 at 0.1 %.
        assert!((critical_f2(0.05, 10.0) - 4.1028).abs() < 1e-4);
        assert!((critical_f2(0.01, 10.0) - 7.5594).abs() < 1e-4);
        assert!((2.0 * critical_f2(0.001, f64::INFINITY) - 13.8155).abs() < 1e-4);
        assert!((critical_f2(0.001, 9e5) / critical_f2(0.001, 1.1e6) - 1.0).abs() < 1e-4);
    }
}
