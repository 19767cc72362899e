//! The threshold from iteration to iteration.

use super::Options;
use super::matching::Residuals;
use crate::error::{Error, Result};

pub(super) struct Schedule {
    pub threshold: f64,
    /// How far the transformation may still be off, one sigma of a coordinate: it widens the test of the Mahalanobis
    /// distance as long as the threshold is above its end, or the first iterations would refuse the true pairs.
    pub slack: f64,
    end: Option<f64>,
    reduction: f64,
    /// What stays possible in the end: what rounding leaves of residuals, or what covariances allow.
    least: f64,
}

impl Schedule {
    pub fn new(options: &Options, extent: f64, reach: f64, first_distances: impl FnOnce() -> Vec<f64>) -> Result<Self> {
        let threshold = match options.threshold {
            Some(threshold) => threshold,
            None => {
                let mut distances = first_distances();
                let place = (distances.len() - 1) * 9 / 10;
                let (_, ninth, _) = distances.select_nth_unstable_by(place, f64::total_cmp);
                // Sets that lie on each other already still need a reach.
                (2.0 * *ninth).max(1e-6 * extent)
            }
        };
        if options.final_threshold.is_some_and(|end| end > threshold) {
            return Err(Error::invalid(format!(
                "the final threshold is {}, above the first one of {threshold}; give it below",
                options.final_threshold.unwrap_or_default()
            )));
        }
        Ok(Self {
            threshold,
            slack: threshold / 3.0,
            end: options.final_threshold,
            reduction: options.reduction,
            least: reach.max(1e-10 * extent),
        })
    }

    /// Where the reduction stops: as given, or three sigmas of what the residuals are.
    fn end(&self, residuals: &Residuals) -> f64 {
        self.end.unwrap_or((3.0 * residuals.robust_sigma()).max(self.least))
    }

    /// Whether a smaller threshold would change nothing.
    pub fn has_ended(&self, residuals: &Residuals) -> bool {
        self.reduction == 1.0 || self.threshold <= self.end(residuals)
    }

    pub fn reduce(&mut self, residuals: &Residuals) {
        if self.reduction == 1.0 {
            self.slack = 0.0;
            return;
        }
        let end = self.end(residuals);
        // No pair is lost by a threshold above all residuals; residuals that grow do not widen it again, or it could
        // swing for ever.
        let next = if residuals.largest <= end { end } else { (self.threshold * self.reduction).max(end) };
        self.threshold = self.threshold.min(next);
        self.slack = (self.threshold * self.threshold - end * end).max(0.0).sqrt() / 3.0;
    }
}
