//! How well a view explains points of which some are blunders.
//!
//! With a threshold the score is MSAC's truncated sum of squares. Without one it is the number of false alarms of the
//! a-contrario method, minimised over thresholds: the expected number of samples among random points that would gather as
//! many inliers as closely. Its logarithm tells a find from chance without knowing the noise.
//!
//! Sources: P. H. S. Torr and A. Zisserman, MLESAC, 2000 (MSAC); L. Moisan and B. Stival, A probabilistic criterion to
//! detect rigid point matches, 2004.

use super::batch::LANES;
use super::observations::Observations;
use crate::geometry::View;

/// Points between two looks at whether a hypothesis is still worth its time.
const BLOCK: usize = 8 * LANES;
/// Thresholds of the a-contrario score: radii from 1/8 px, each √2 of the one before.
const LEVELS: usize = 24;
const FIRST_SQUARE: f64 = 1.0 / 64.0;

/// What a hypothesis is worth.
#[derive(Debug, Clone, Copy)]
pub(super) struct Score {
    /// Smaller is better.
    pub value: f64,
    /// Points within the threshold.
    pub inliers: usize,
    /// The threshold's square, px².
    pub threshold2: f64,
    /// Of the MSAC cost at that threshold, per point: what blocks of rivals are compared with.
    pub pace: f64,
}

/// Scores views on points in random order.
pub(super) struct Scorer<'a> {
    observations: &'a Observations,
    /// Given threshold's square, px².
    threshold2: Option<f64>,
    sample: usize,
    /// log10 of k!.
    factorials: Vec<f64>,
    area: f64,
    sigma: f64,
}

impl<'a> Scorer<'a> {
    pub fn new(observations: &'a Observations, threshold: Option<f64>, sample: usize, area: f64) -> Self {
        let mut factorials = vec![0.0];
        for k in 1..=observations.len() {
            factorials.push(factorials[k - 1] + (k as f64).log10());
        }
        let sigma = observations.precision.typical_sigma();
        Self { observations, threshold2: threshold.map(|t| t * t), sample, factorials, area, sigma }
    }

    /// The misclosure's square as if all points were of the typical precision, px²; infinite where not visible.
    #[inline]
    pub fn square(&self, view: &View, i: usize) -> f64 {
        self.observations.square(view, i) * self.sigma * self.sigma
    }

    /// The points whose misclosure's square is within a limit, `count` at most.
    pub fn within(&self, view: &View, limit: f64, count: usize) -> Vec<usize> {
        let limit = limit / (self.sigma * self.sigma);
        let squares = self.observations.squares(view);
        squares.iter().enumerate().filter(|(_, s)| **s <= limit).map(|(i, _)| i).take(count).collect()
    }

    /// Calls `each` with the squares, px², of block after block until it says to stop; whether it went to the end.
    #[inline]
    fn blocks(&self, view: &View, mut each: impl FnMut(&[f64]) -> bool) -> bool {
        let n = self.observations.len();
        let mut squares = [0.0; BLOCK];
        let flat = self.observations.flat(view);
        let packed = if flat.is_some() { self.observations.batches() } else { &[] };
        for first in (0..n).step_by(BLOCK) {
            let count = BLOCK.min(n - first);
            match &flat {
                Some((flat, _)) => {
                    let batches = &packed[first / LANES..(first + count).div_ceil(LANES)];
                    for (out, batch) in squares.chunks_mut(LANES).zip(batches) {
                        out.copy_from_slice(&flat.squares(batch));
                    }
                }
                None => (0..count).for_each(|i| squares[i] = self.square(view, first + i)),
            }
            if !each(&squares[..count]) {
                return false;
            }
        }
        true
    }

    /// The score, or `None` as soon as it is clear that it will not beat `best`.
    pub fn score(&self, view: &View, best: Option<&Score>) -> Option<Score> {
        match self.threshold2 {
            Some(t2) => self.msac(view, t2, best),
            None => self.a_contrario(view, best),
        }
    }

    /// Whether the first points cost so much more than the best view's that chance does not explain it (4 sigmas of a
    /// truncated cost, whose variance is at most ¼ per point).
    #[inline]
    fn hopeless(cost: f64, points: usize, best: Option<&Score>) -> bool {
        best.is_some_and(|b| cost > b.pace * points as f64 + 2.0 * (points as f64).sqrt())
    }

    fn msac(&self, view: &View, t2: f64, best: Option<&Score>) -> Option<Score> {
        let (mut cost, mut inliers, mut seen) = (0.0, 0, 0);
        let per_t2 = 1.0 / t2;
        let whole = self.blocks(view, |squares| {
            for s in squares {
                inliers += usize::from(*s <= t2);
                cost += (s * per_t2).min(1.0);
            }
            seen += squares.len();
            !Self::hopeless(cost, seen, best) && best.is_none_or(|b| cost < b.value)
        });
        whole.then(|| Score { value: cost, inliers, threshold2: t2, pace: cost / self.observations.len() as f64 })
    }

    fn a_contrario(&self, view: &View, best: Option<&Score>) -> Option<Score> {
        let mut counts = [0usize; LEVELS + 1];
        let (mut cost, mut seen) = (0.0, 0);
        let per_t2 = best.map_or(0.0, |b| 1.0 / b.threshold2);
        let whole = self.blocks(view, |squares| {
            for s in squares {
                cost += (s * per_t2).min(1.0);
                counts[level(*s)] += 1;
            }
            seen += squares.len();
            !Self::hopeless(cost, seen, best)
        });
        if !whole {
            return None;
        }
        let score = self.fewest_false_alarms(&counts);
        let better = best.is_none_or(|b| score.value < b.value);
        // The pace at the new threshold: inliers cost something, take them as half where it is not known.
        let share = score.inliers as f64 / self.observations.len() as f64;
        better.then_some(Score { pace: 1.0 - 0.5 * share, ..score })
    }

    fn fewest_false_alarms(&self, counts: &[usize; LEVELS + 1]) -> Score {
        let mut best = Score { value: f64::INFINITY, inliers: 0, threshold2: FIRST_SQUARE, pace: 1.0 };
        let (mut k, mut t2) = (0, FIRST_SQUARE);
        for count in &counts[..LEVELS] {
            k += count;
            let value = self.log10_false_alarms(k, t2);
            if k > self.sample && value < best.value {
                best = Score { value, inliers: k, threshold2: t2, pace: 1.0 };
            }
            t2 *= 2.0;
        }
        best
    }

    /// log10 of the expected number of samples among points thrown at random over the photo that have `k` of them
    /// within the radius.
    pub fn log10_false_alarms(&self, k: usize, t2: f64) -> f64 {
        let (n, m) = (self.observations.len(), self.sample);
        if k <= m {
            return (n as f64).log10();
        }
        let choose = |n: usize, k: usize| self.factorials[n] - self.factorials[k] - self.factorials[n - k];
        let chance = (std::f64::consts::PI * t2 / self.area).min(1.0);
        ((n - m) as f64).log10()
            + (LEVELS as f64).log10()
            + choose(n, k)
            + choose(k, m)
            + (k - m) as f64 * chance.log10()
    }
}

/// The smallest level whose threshold takes in a square; `LEVELS` where none does.
#[inline(always)]
fn level(s: f64) -> usize {
    // Thresholds double: the exponent of s / FIRST_SQUARE, rounded up.
    let ratio = s / FIRST_SQUARE;
    if ratio <= 1.0 {
        return 0;
    }
    let bits = ratio.to_bits();
    let exponent = (bits >> 52) as usize - 1023;
    let fraction = usize::from(bits & ((1 << 52) - 1) != 0);
    (exponent + fraction).min(LEVELS)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn levels_are_half_open_octaves() {
        assert_eq!(level(0.0), 0);
        assert_eq!(level(FIRST_SQUARE), 0);
        assert_eq!(level(FIRST_SQUARE * 1.001), 1);
        assert_eq!(level(FIRST_SQUARE * 2.0), 1);
        assert_eq!(level(FIRST_SQUARE * 2.001), 2);
        assert_eq!(level(1e30), LEVELS);
        assert_eq!(level(f64::INFINITY), LEVELS);
    }

    #[test]
    fn chance_is_told_from_a_find() {
        let o = Observations::new(&[[0.0; 3]; 20], &[[0.0; 2]; 20], None).unwrap();
        let scorer = Scorer::new(&o, None, 3, 2000.0 * 1500.0);
        // Four of twenty within 50 px say nothing, eight within 4 px cannot be chance.
        assert!(scorer.log10_false_alarms(4, 2500.0) > 0.0);
        assert!(scorer.log10_false_alarms(8, 16.0) < -10.0);
        assert!(scorer.log10_false_alarms(3, 1.0) > 0.0);
    }
}
