//! The two sets in an order in which neighbours in the plane are neighbours in memory.

use nalgebra::Matrix3;

use super::Sets;
use super::fit::apply;
use crate::error::{Error, Result};
use crate::neighbours::{Neighbours, along_a_curve, refuse_not_finite};

/// A set and where each of its points came from.
pub(super) struct Sorted {
    pub points: Vec<[f64; 2]>,
    pub covariance: Option<Vec<[[f64; 2]; 2]>>,
    /// The index that each point had.
    pub id: Vec<u32>,
}

impl Sorted {
    fn new(points: &[[f64; 2]], covariance: Option<&[[[f64; 2]; 2]]>, id: Vec<u32>) -> Self {
        let covariance = covariance.map(|all| id.iter().map(|&i| all[i as usize]).collect());
        Self { points: id.iter().map(|&i| points[i as usize]).collect(), covariance, id }
    }
}

/// Source and target, checked, and an index of the target's sorted points; the source is sorted by where it lies under
/// the initial transformation. Both at the same time.
pub(super) fn sort(sets: &Sets, initial: &Matrix3<f64>) -> Result<(Sorted, Sorted, Neighbours<2>)> {
    for (points, which) in [(sets.source, "source"), (sets.target, "target")] {
        if points.is_empty() {
            return Err(Error::invalid(format!("there is no {which} point")));
        }
        refuse_not_finite(points, &format!("{which} point"))?;
    }
    check_covariances(sets.source_covariance, sets.source.len(), "source")?;
    check_covariances(sets.target_covariance, sets.target.len(), "target")?;
    let source = || {
        let moved: Vec<[f64; 2]> = sets.source.iter().map(|p| apply(initial, p)).collect();
        refuse_not_finite(&moved, "transformed source point")?;
        Ok(Sorted::new(sets.source, sets.source_covariance, along_a_curve(&moved)))
    };
    let target = || {
        let sorted = Sorted::new(sets.target, sets.target_covariance, along_a_curve(sets.target));
        let index = Neighbours::new(&sorted.points)?;
        Ok((sorted, index))
    };
    let (source, target) = rayon::join(source, target);
    let (target, index) = target?;
    Ok((source?, target, index))
}

fn check_covariances(covariances: Option<&[[[f64; 2]; 2]]>, n: usize, which: &str) -> Result<()> {
    let Some(covariances) = covariances else { return Ok(()) };
    if covariances.len() != n {
        return Err(Error::invalid(format!("{n} {which} points have {} covariances", covariances.len())));
    }
    let wrong = |c: &[[f64; 2]; 2]| {
        let determinant = c[0][0] * c[1][1] - c[0][1] * c[1][0];
        !(c[0][0] >= 0.0 && c[1][1] >= 0.0 && determinant >= -1e-12 * c[0][0] * c[1][1])
            || c.iter().flatten().any(|v| !v.is_finite())
            || (c[0][1] - c[1][0]).abs() > 1e-9 * (c[0][0] + c[1][1])
    };
    covariances.iter().position(wrong).map_or(Ok(()), |i| {
        Err(Error::invalid(format!("{which} point {i}: {:?} is not a covariance matrix", covariances[i])))
    })
}
