//! Iterative closest point in the plane: two sets of image points without known pairs.
//!
//! [`run`] is the algorithm on one screen; what it is made of has a file each: [`matching`](self) finds pairs, `fit`
//! the motion that brings them together, `schedule` the threshold, `report` says how good the result is.
//!
//! Sources: P. Besl and N. McKay, A method for registration of 3-D shapes, 1992 (closest points); Y. Chen and
//! G. Medioni, Object modelling by registration of multiple range images, 1992 (point to line); D. Chetverikov et al.,
//! The trimmed iterative closest point algorithm, 2002; Z. Zhang, Iterative point matching for registration of
//! free-form curves and surfaces, 1994 (thresholds that follow the residuals).

mod fit;
mod matching;
mod report;
mod schedule;
mod sorted;

use nalgebra::Matrix3;

use crate::error::{Error, Result};
pub use fit::Motion;
use matching::{Matcher, Pairs, Residuals};
pub use report::{Finding, FindingKind, Reason, Report, Step};
use schedule::Schedule;

/// What is brought together.
#[derive(Debug, Clone, Copy)]
pub struct Sets<'a> {
    /// Is moved.
    pub source: &'a [[f64; 2]],
    /// Stays.
    pub target: &'a [[f64; 2]],
    /// Of each source point, in its own image. Covariances of either set make pairs pass a test of their Mahalanobis
    /// distance, and weigh them.
    pub source_covariance: Option<&'a [[[f64; 2]; 2]]>,
    /// Of each target point.
    pub target_covariance: Option<&'a [[[f64; 2]; 2]]>,
}

/// What is minimised.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Metric {
    /// The distance of the points of a pair.
    PointToPoint,
    /// The distance from the line through the target point's neighbours; where these lie in no line, of the points.
    PointToLine,
}

/// How it is done. Lengths are in the unit of the points, which are pixels.
#[derive(Debug, Clone, Copy)]
pub struct Options {
    /// The family of the transformation.
    pub motion: Motion,
    /// What is minimised.
    pub metric: Metric,
    /// From source to target, approximate.
    pub initial: Matrix3<f64>,
    /// Pairs farther apart are left out at first; by default twice the distance that 90 % of the first pairs keep.
    pub threshold: Option<f64>,
    /// ... and in the end; by default three robust sigmas of the residuals, whatever they
    /// become, or what the largest covariance allows.
    pub final_threshold: Option<f64>,
    /// From one iteration to the next; 1 keeps the first threshold.
    pub reduction: f64,
    /// Only pairs whose points are the closest to each other, both ways.
    pub mutual: bool,
    /// Part of the pairs that is kept, the closest ones: what is expected to overlap.
    pub keep: f64,
    /// Of a true pair to pass the test of its Mahalanobis distance.
    pub gate_probability: f64,
    /// Neighbours that make a line.
    pub neighbours: usize,
    /// At most so many iterations.
    pub max_iterations: usize,
    /// The shift of the source's corners below which the transformation stands still. A cycle between states that are
    /// less than a hundred times this apart counts as well.
    pub change_tolerance: f64,
    /// The root mean square of the residuals that counts as small.
    pub residual_limit: f64,
    /// Fewer pairs are an error.
    pub min_pairs: usize,
    /// The change of scale against the initial one that is believed, either way.
    pub scale_limit: f64,
    /// The part of the source's points that should find a partner.
    pub min_share: f64,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            motion: Motion::Similarity,
            metric: Metric::PointToPoint,
            initial: Matrix3::identity(),
            threshold: None,
            final_threshold: None,
            reduction: 0.8,
            mutual: false,
            keep: 1.0,
            gate_probability: 0.99,
            neighbours: 16,
            max_iterations: 100,
            change_tolerance: 1e-4,
            residual_limit: 1.0,
            min_pairs: 10,
            scale_limit: 1.5,
            min_share: 0.25,
        }
    }
}

impl Options {
    fn check(&self) -> Result<()> {
        let refuse = |what: &str, value: f64| Err(Error::invalid(format!("{what} of {value} is not possible")));
        let positive = |v: f64| v.is_finite() && v > 0.0;
        for (what, value) in [("a threshold", self.threshold), ("a final threshold", self.final_threshold)] {
            if let Some(value) = value.filter(|v| !positive(*v)) {
                return refuse(what, value);
            }
        }
        if !(positive(self.reduction) && self.reduction <= 1.0) {
            return refuse("a reduction of the threshold", self.reduction);
        }
        if !(positive(self.keep) && self.keep <= 1.0) {
            return refuse("a part of pairs", self.keep);
        }
        if !(self.gate_probability > 0.0 && self.gate_probability < 1.0) {
            return refuse("a gate probability", self.gate_probability);
        }
        if !(self.change_tolerance >= 0.0
            && self.residual_limit >= 0.0
            && self.min_share >= 0.0
            && self.scale_limit > 1.0)
        {
            return Err(Error::invalid("tolerances must not be negative, and the scale limit must be above 1"));
        }
        if self.neighbours < 3 || self.max_iterations == 0 {
            return Err(Error::invalid("3 neighbours make a line, and 1 iteration is the least"));
        }
        let determinant = self.initial.determinant();
        if !self.initial.iter().all(|v| v.is_finite()) || !positive(determinant.abs()) || self.initial[(2, 2)] == 0.0 {
            return Err(Error::invalid(format!("the initial transformation is singular: determinant {determinant}")));
        }
        Ok(())
    }
}

/// Finds the transformation from source to target.
///
/// Closest points within a threshold → least-squares transformation → apply → smaller threshold, until the change *and*
/// the residuals are small. The report says why it ended, and what speaks against the result; too few pairs are an
/// error, for they determine nothing.
pub fn run(sets: &Sets, options: &Options) -> Result<Report> {
    options.check()?;
    let matcher = Matcher::new(sets, options)?;
    let mut transform = options.initial / options.initial[(2, 2)];
    let mut schedule =
        Schedule::new(options, matcher.extent(), matcher.reach(), || matcher.first_distances(&transform))?;
    let (mut history, mut earlier) = (Vec::new(), Vec::new());
    let (mut pairs, mut residuals) = (Pairs::default(), Residuals::default());
    loop {
        matcher.find(&mut pairs, &transform, &schedule)?;
        let least = options.min_pairs.max(options.motion.parameters());
        if pairs.len() < least {
            return Err(Error::Degenerate {
                what: format!("iteration {}: no transformation follows from so few pairs", history.len() + 1),
                quantity: "number of pairs within the threshold",
                value: pairs.len() as f64,
                limit: least as f64,
                remedy: "begin with a larger threshold or a better initial transformation",
            });
        }
        let next = fit::increment(&pairs, options.motion)? * transform;
        let next = next / next[(2, 2)];
        let change = matcher.largest_shift(&transform, &next);
        transform = next;
        residuals.take(&pairs, &transform, &matcher);
        history.push(Step { threshold: schedule.threshold, pairs: pairs.len(), rms: residuals.rms, change });
        earlier.push(transform);
        let still = change < options.change_tolerance || swings(&matcher, &earlier, &history);
        let standing = still && schedule.has_ended(&residuals);
        if standing || history.len() == options.max_iterations {
            let reason = match (standing, residuals.rms <= options.residual_limit) {
                (true, true) => Reason::Converged,
                (true, false) => Reason::ResidualsLarge,
                (false, _) => Reason::IterationLimit,
            };
            return report::assess(&matcher, &transform, &pairs, residuals, history, reason);
        }
        schedule.reduce(&residuals);
    }
}

/// Whether it has come back to where it was a few iterations ago, and went nowhere in between: single pairs that change
/// sides keep it from standing still.
fn swings(matcher: &Matcher, earlier: &[Matrix3<f64>], history: &[Step]) -> bool {
    const LONGEST: usize = 8;
    let Some((now, before)) = earlier.split_last() else { return false };
    let exact = 1e-11 * matcher.extent();
    let period = before.iter().rev().take(LONGEST).position(|h| matcher.largest_shift(h, now) <= exact);
    let small = 100.0 * matcher.options.change_tolerance;
    period.is_some_and(|p| history.iter().rev().take(p + 1).all(|step| step.change < small))
}

#[cfg(test)]
mod tests;
