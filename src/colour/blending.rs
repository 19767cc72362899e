//! One colour from what several photos show of a point.

use crate::error::{Error, Result};

/// How several photos make one colour.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Blend {
    /// From the photo with the best view of the point: sharp, with seams.
    Best,
    /// The mean, weighted by how good the views are: smooth, ghosts where the registration is off.
    Mean,
    /// The weighted geometric median: what a minority of the photos shows (people walking by, reflections) has no say.
    Median,
}

/// What one photo shows of a point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Sample {
    /// The photo's place in the list.
    pub view: usize,
    /// How good its view is; positive.
    pub weight: f32,
    /// On the 16-bit scale.
    pub colour: [f32; 3],
}

impl Blend {
    /// By its name.
    pub fn from_name(name: &str) -> Result<Self> {
        match name {
            "best" => Ok(Self::Best),
            "mean" => Ok(Self::Mean),
            "median" => Ok(Self::Median),
            _ => Err(Error::invalid(format!("there is no blend {name:?}; there are best, mean and median"))),
        }
    }

    /// The colour, and the photo that gave the largest part of it (of equals the first). `None` without samples.
    pub(super) fn blend(self, samples: &[Sample]) -> Option<([f32; 3], usize)> {
        let mut best = samples.first()?;
        for sample in samples {
            if sample.weight > best.weight {
                best = sample;
            }
        }
        Some(match self {
            Self::Best => (best.colour, best.view),
            Self::Mean => (mean(samples), best.view),
            Self::Median if samples.len() < 3 => (best.colour, best.view),
            Self::Median => median(samples, best),
        })
    }
}

fn mean(samples: &[Sample]) -> [f32; 3] {
    let total: f32 = samples.iter().map(|s| s.weight).sum();
    std::array::from_fn(|k| samples.iter().map(|s| s.weight * s.colour[k]).sum::<f32>() / total)
}

fn distance(a: &[f32; 3], b: &[f32; 3]) -> f32 {
    a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum::<f32>().sqrt()
}

/// Weiszfeld's iteration, with distances kept off zero.
fn median(samples: &[Sample], best: &Sample) -> ([f32; 3], usize) {
    /// Half a grey level of 8 bit.
    const NEAR: f32 = 128.0;
    let mut colour = mean(samples);
    let pull = |sample: &Sample, colour: &[f32; 3]| sample.weight / distance(&sample.colour, colour).max(NEAR);
    for _ in 0..30 {
        let total: f32 = samples.iter().map(|s| pull(s, &colour)).sum();
        let next: [f32; 3] =
            std::array::from_fn(|k| samples.iter().map(|s| pull(s, &colour) * s.colour[k]).sum::<f32>() / total);
        let step = distance(&next, &colour);
        colour = next;
        if step < 1.0 {
            break;
        }
    }
    let mut strongest = best;
    for sample in samples {
        if pull(sample, &colour) > pull(strongest, &colour) {
            strongest = sample;
        }
    }
    (colour, strongest.view)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample(view: usize, weight: f32, grey: f32) -> Sample {
        Sample { view, weight, colour: [grey; 3] }
    }

    #[test]
    fn best_takes_the_heaviest_and_of_equals_the_first() {
        let samples = [sample(3, 1.0, 10.0), sample(5, 2.0, 20.0), sample(8, 2.0, 30.0)];
        assert_eq!(Blend::Best.blend(&samples), Some(([20.0; 3], 5)));
        assert_eq!(Blend::Best.blend(&[]), None);
    }

    #[test]
    fn mean_is_weighted() {
        let samples = [sample(0, 1.0, 0.0), sample(1, 3.0, 400.0)];
        assert_eq!(Blend::Mean.blend(&samples), Some(([300.0; 3], 1)));
    }

    #[test]
    fn median_is_not_moved_by_a_minority() {
        let mut samples = vec![sample(0, 1.5, 60000.0)];
        samples.extend((1..6).map(|i| sample(i, 1.0, 1000.0 + i as f32)));
        let (colour, view) = Blend::Median.blend(&samples).unwrap();
        assert!((colour[0] - 1003.0).abs() < 50.0 && view > 0, "{colour:?} {view}");
    }
}
