//! Data snooping: blunders are found one at a time, and everything is adjusted again after each.
//!
//! The point with the largest statistic is left out while that exceeds the critical value of one test at level α, until
//! none does. Source: W. Baarda 1968 (known variance factor); A. J. Pope 1976 (estimated).

use super::gauss_helmert::{Conditions, Observed, Solution, adjust};
use super::reliability::{PointTest, TestLevels, mean_shift, statistic};
use crate::error::Result;

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
        let Some(test) = PointTest::new(C, solution.dof, levels)? else { break };
        let (mut worst, mut largest) = (None, 0.0);
        for (i, point) in solution.points.iter().enumerate() {
            let Some((t, _)) = mean_shift(point, &solution.cofactor) else { continue };
            let value = statistic(t, C, solution.omega, solution.dof, levels);
            if value > largest {
                (worst, largest) = (Some(i), value);
            }
        }
        let Some(i) = worst.filter(|_| largest > test.critical) else { break };
        rejected.push(Rejection { point: used[i], statistic: largest, critical: test.critical });
        used.remove(i);
        left.remove(i);
        solution = adjust(conditions, &solution.state, &left)?;
    }
    Ok(Snooped { solution, used, rejected })
}
