//! Data snooping: blunders are found one at a time, and everything is adjusted again after each.
//!
//! The point with the largest statistic is left out while that exceeds the critical value of one test at level α, until
//! none does. Source: W. Baarda 1968 (known variance factor); A. J. Pope 1976 (estimated).
//!
//! Leaving a point out moves the estimate by δ = Q Aᵀ Q_w⁻¹ w, its cofactor matrix by Q Aᵀ Q_w⁻¹ A Q and the objective by
//! −T, exactly as long as the conditions are linear: of many points one moves the estimate by so little that they are. What
//! is iterated anew, with all conditions linearised again, is the adjustment after moves that add up to something that a
//! point's misclosure would notice; and the last one, whose points are tested once more.

use nalgebra::{DMatrix, DVector, SVector};

use super::gauss_helmert::{Conditions, Observed, Solution, adjust};
use super::reliability::{PointTest, TestLevels, mean_shift, statistic};
use crate::error::Result;

/// By how many of its sigmas a misclosure may have moved before everything is linearised again. The second-order part of
/// such a move is smaller by the ratio of the noise to the size of the picture.
const DRIFT: f64 = 0.3;

/// One rejected point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rejection {
    /// Its number among the points given.
    pub point: usize,
    /// The statistic that it was rejected with.
    pub statistic: f64,
    /// The critical value at that time.
    pub critical: f64,
}

/// An adjustment and what was left out of it.
pub struct Snooped<S, const C: usize, const M: usize> {
    /// The adjustment of the points that are left.
    pub solution: Solution<S, C, M>,
    /// Their numbers among the points given.
    pub used: Vec<usize>,
    /// The others, in the order of their rejection.
    pub rejected: Vec<Rejection>,
}

/// Adjusts, and, where `levels` are given, rejects point by point.
pub fn adjust_and_snoop<Q, const C: usize, const M: usize>(
    conditions: &Q,
    start: &Q::State,
    observed: &[Observed<M>],
    levels: Option<&TestLevels>,
) -> Result<Snooped<Q::State, C, M>>
where
    Q: Conditions<C, M>,
{
    let mut used: Vec<usize> = (0..observed.len()).collect();
    let mut left: Vec<Observed<M>> = observed.to_vec();
    let mut rejected = Vec::new();
    let mut solution = adjust(conditions, start, &left)?;
    while let Some(levels) = levels {
        let mut linear = Linear::of(&solution);
        while let Some((i, statistic, critical)) = linear.worst(levels)? {
            rejected.push(Rejection { point: used[i], statistic, critical });
            if linear.leave_out(i) > DRIFT {
                break;
            }
        }
        if linear.left.iter().all(|left| *left) {
            break;
        }
        let mut keep = linear.left.iter();
        used.retain(|_| keep.next() == Some(&true));
        let mut keep = linear.left.iter();
        left.retain(|_| keep.next() == Some(&true));
        let moved = conditions.apply(&solution.state, linear.moved.as_slice());
        solution = moved
            .and_then(|state| adjust(conditions, &state, &left))
            .or_else(|_| adjust(conditions, &solution.state, &left))?;
    }
    Ok(Snooped { solution, used, rejected })
}

/// An adjustment from which points are left out, its conditions linear.
struct Linear<'a, S, const C: usize, const M: usize> {
    solution: &'a Solution<S, C, M>,
    left: Vec<bool>,
    misclosures: Vec<SVector<f64, C>>,
    /// Of each point the largest share of its misclosure that the other points do not control, at the start.
    shares: Vec<f64>,
    /// By how much shares have grown at most.
    growth: f64,
    cofactor: DMatrix<f64>,
    omega: f64,
    dof: usize,
    /// Of the parameters.
    moved: DVector<f64>,
}

impl<'a, S, const C: usize, const M: usize> Linear<'a, S, C, M> {
    fn of(solution: &'a Solution<S, C, M>) -> Self {
        let cofactor = solution.cofactor.clone();
        Self {
            left: vec![true; solution.points.len()],
            misclosures: solution.points.iter().map(|p| p.misclosure).collect(),
            // The trace is no smaller than the largest eigenvalue.
            shares: solution
                .points
                .iter()
                .map(|p| p.weight.component_mul(&p.prediction_cofactor(&cofactor)).sum())
                .collect(),
            growth: 1.0,
            moved: DVector::zeros(cofactor.nrows()),
            cofactor,
            omega: solution.omega,
            dof: solution.dof,
            solution,
        }
    }

    /// The point whose statistic is largest, with the statistic and the critical value, where it exceeds that.
    fn worst(&self, levels: &TestLevels) -> Result<Option<(usize, f64, f64)>> {
        let Some(test) = PointTest::new(C, self.dof, levels)? else { return Ok(None) };
        // The statistic grows with T: the smallest T that is of interest, and the bound T ≤ wᵀ W⁻¹ w / (1 − share),
        // spare nearly all points their T.
        let mut largest = self.least(test.critical, levels);
        let mut worst = None;
        for (i, point) in self.solution.points.iter().enumerate() {
            let w = &self.misclosures[i];
            let bound = 1.0 - (self.growth * self.shares[i]).min(1.0);
            if !self.left[i] || w.dot(&(point.weight * w)) < bound * largest {
                continue;
            }
            let mut point = *point;
            point.misclosure = *w;
            if let Some((t, _)) = mean_shift(&point, &self.cofactor)
                && t > largest
            {
                (worst, largest) = (Some(i), t);
            }
        }
        let value = statistic(largest, C, self.omega, self.dof, levels);
        Ok(worst.filter(|_| value > test.critical).map(|i| (i, value, test.critical)))
    }

    /// A T below which no point is rejected.
    fn least(&self, critical: f64, levels: &TestLevels) -> f64 {
        let c = C as f64;
        let t = if levels.estimated {
            // t / C = critical · (Ω − t) / (f − C)
            let rest = critical / (self.dof - C) as f64;
            rest * self.omega / (1.0 / c + rest)
        } else {
            critical * c
        };
        (1.0 - 1e-9) * t
    }

    /// Leaves a point out; gives the largest move of a misclosure since the start, in sigmas.
    fn leave_out(&mut self, i: usize) -> f64 {
        let mut point = self.solution.points[i];
        point.misclosure = self.misclosures[i];
        self.left[i] = false;
        self.dof -= C;
        let Some((t, inverse)) = mean_shift(&point, &self.cofactor) else { return f64::INFINITY };
        self.omega -= t;
        let share = point.weight.component_mul(&point.prediction_cofactor(&self.cofactor)).sum();
        self.growth /= (1.0 - share).max(1e-3);
        let u = self.cofactor.nrows();
        let reach = &self.cofactor * point.design_matrix(u).transpose();
        let by_point = DMatrix::from_fn(C, C, |i, j| inverse[(i, j)]);
        let weighted = &reach * by_point;
        let pull = &weighted * DVector::from_fn(C, |k, _| point.misclosure[k]);
        self.cofactor += &weighted * reach.transpose();
        let mut drift: f64 = 0.0;
        for (other, w) in self.solution.points.iter().zip(&mut self.misclosures) {
            for k in 0..C {
                w[k] += other.design[k][..u].iter().zip(pull.iter()).map(|(a, d)| a * d).sum::<f64>();
            }
            let moved = *w - other.misclosure;
            drift = drift.max(moved.dot(&(other.weight * moved)));
        }
        self.moved += pull;
        drift.sqrt()
    }
}
