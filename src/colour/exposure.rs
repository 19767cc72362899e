//! Gains that make photos of different exposure and white balance agree on the points that several of them see.
//!
//! For each channel the gains minimise Σ N_ij ((g_i a_ij − g_j a_ji)² / σ_N² + (1 − g_i)² / σ_g²) over pairs of photos,
//! with N_ij common points and a_ij their mean in photo i. Source: Brown and Lowe, Automatic panoramic image stitching
//! using invariant features, 2007, section 6.

use std::sync::atomic::{AtomicU64, Ordering};

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

use super::sampling::{Interpolation, Photo, rounded};
use super::visibility::{Sight, VisibilityMap};
use crate::error::{Error, Result};
use crate::geometry::LANES;

/// σ_N, on the 16-bit scale. Means over the same surface points differ by less than means over overlapping areas: a
/// quarter of the authors' figure, with twice their σ_g, so that the gains are hardly drawn towards 1.
const SIGMA_NOISE: f64 = 2.5 * 256.0;
/// σ_g.
const SIGMA_GAIN: f64 = 0.2;
/// What is darker or brighter than this on the 16-bit scale is cut off by the sensor and says nothing.
const USABLE: std::ops::Range<u16> = 8 * 256..250 * 256;

/// Collects what pairs of photos show of the same points. Points may be added in any order and from several threads:
/// sums of integers do not depend on it.
pub struct Exposure {
    views: usize,
    /// For each ordered pair: the number of points, and the sums of the first photo's channels.
    sums: Vec<[AtomicU64; 4]>,
}

impl Exposure {
    /// For a number of photos.
    pub fn new(views: usize) -> Self {
        let zero = || [const { AtomicU64::new(0) }; 4];
        Self { views, sums: (0..views * views).map(|_| zero()).collect() }
    }

    /// Looks at the points in every photo that sees them.
    pub fn add(&self, maps: &[&VisibilityMap], photos: &[Photo<'_>], xyz: &[[f64; 3]]) -> Result<()> {
        if maps.len() != self.views || photos.len() != self.views {
            return Err(Error::invalid(format!(
                "levelling was begun for {} photos, not for {} maps and {} photos",
                self.views,
                maps.len(),
                photos.len()
            )));
        }
        xyz.par_chunks(LANES).for_each(|points| {
            let mut seen: Vec<Vec<(usize, [u16; 3])>> = vec![Vec::new(); points.len()];
            let mut sight = Sight::new();
            for (view, (map, photo)) in maps.iter().zip(photos).enumerate().filter(|(_, (map, _))| map.meets(points)) {
                map.look(points, &mut sight);
                for (i, seen) in seen.iter_mut().enumerate() {
                    if sight.cell(i).is_some() {
                        let colour = rounded(photo.sample(sight.xy(i), Interpolation::Bilinear));
                        if colour.iter().all(|v| USABLE.contains(v)) {
                            seen.push((view, colour));
                        }
                    }
                }
            }
            for seen in seen.iter().filter(|seen| seen.len() > 1) {
                for (a, colour) in seen {
                    for (b, _) in seen.iter().filter(|(b, _)| a != b) {
                        let sums = &self.sums[a * self.views + b];
                        sums[0].fetch_add(1, Ordering::Relaxed);
                        for (sum, value) in sums[1..].iter().zip(colour) {
                            sum.fetch_add(u64::from(*value), Ordering::Relaxed);
                        }
                    }
                }
            }
        });
        Ok(())
    }

    /// The gain of each photo and channel; 1 for photos that share no points with others.
    pub fn gains(&self) -> Result<Vec<[f64; 3]>> {
        let mut gains = vec![[1.0; 3]; self.views];
        for channel in 0..3 {
            for (gain, value) in gains.iter_mut().zip(self.gains_of(channel)?.iter()) {
                gain[channel] = *value;
            }
        }
        Ok(gains)
    }

    fn gains_of(&self, channel: usize) -> Result<DVector<f64>> {
        let n = self.views;
        let load = |a: usize, b: usize, k: usize| self.sums[a * n + b][k].load(Ordering::Relaxed) as f64;
        let (mut normal, mut right) = (DMatrix::<f64>::zeros(n, n), DVector::<f64>::zeros(n));
        for a in 0..n {
            for b in 0..n {
                let count = load(a, b, 0);
                if count > 0.0 {
                    let (own, other) = (load(a, b, channel + 1) / count, load(b, a, channel + 1) / count);
                    let data = count / (SIGMA_NOISE * SIGMA_NOISE);
                    normal[(a, a)] += 2.0 * data * own * own + count / (SIGMA_GAIN * SIGMA_GAIN);
                    normal[(a, b)] -= 2.0 * data * own * other;
                    right[a] += count / (SIGMA_GAIN * SIGMA_GAIN);
                }
            }
            if right[a] == 0.0 {
                normal[(a, a)] = 1.0;
                right[a] = 1.0;
            }
        }
        normal.lu().solve(&right).ok_or_else(|| Error::Internal("the gains have no solution".into()))
    }
}
