//! A single-channel image, and the few filters that matching needs.

use rayon::prelude::*;

use crate::error::{Error, Result};

/// Rows per task.
const ROWS: usize = 16;

/// A single-channel image, row by row. Pixel (0, 0) is the centre of the first.
#[derive(Debug, Clone, PartialEq)]
pub struct Plane {
    /// Pixels in a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// `width * height` values.
    pub values: Vec<f32>,
}

impl Plane {
    /// A plane around values that are already there.
    pub fn new(width: usize, height: usize, values: Vec<f32>) -> Result<Self> {
        if width == 0 || height == 0 || values.len() != width * height {
            return Err(Error::invalid(format!("{} values are no image of {width} × {height} pixels", values.len())));
        }
        Ok(Self { width, height, values })
    }

    /// A plane of one value.
    pub fn filled(width: usize, height: usize, value: f32) -> Self {
        Self { width, height, values: vec![value; width * height] }
    }

    /// One row.
    #[inline]
    pub fn row(&self, y: usize) -> &[f32] {
        &self.values[y * self.width..(y + 1) * self.width]
    }

    /// One value.
    #[inline]
    pub fn at(&self, x: usize, y: usize) -> f32 {
        self.values[y * self.width + x]
    }

    /// Whether another plane has the same size.
    pub fn same_size(&self, other: &Self) -> bool {
        self.width == other.width && self.height == other.height
    }

    /// A new plane from a function of (row, output row), in parallel.
    pub fn by_rows(width: usize, height: usize, fill: impl Fn(usize, &mut [f32]) + Sync) -> Self {
        let mut values = vec![0.0; width * height];
        values.par_chunks_mut(width * ROWS).enumerate().for_each(|(block, rows)| {
            for (i, row) in rows.chunks_mut(width).enumerate() {
                fill(block * ROWS + i, row);
            }
        });
        Self { width, height, values }
    }

    /// Value by value.
    pub fn map(&self, f: impl Fn(f32) -> f32 + Sync) -> Self {
        Self::by_rows(self.width, self.height, |y, out| {
            for (o, v) in out.iter_mut().zip(self.row(y)) {
                *o = f(*v);
            }
        })
    }

    /// Value by value with another plane of the same size.
    pub fn zip(&self, other: &Self, f: impl Fn(f32, f32) -> f32 + Sync) -> Self {
        debug_assert!(self.same_size(other));
        Self::by_rows(self.width, self.height, |y, out| {
            for ((o, a), b) in out.iter_mut().zip(self.row(y)).zip(other.row(y)) {
                *o = f(*a, *b);
            }
        })
    }

    /// Convolution with a symmetric kernel along x and y; beyond the border the border's value is repeated.
    pub fn convolved(&self, half_kernel: &[f32]) -> Self {
        let radius = half_kernel.len() - 1;
        let horizontal = Self::by_rows(self.width, self.height, |y, out| {
            let row = self.row(y);
            let mut padded = Vec::with_capacity(self.width + 2 * radius);
            padded.resize(radius, row[0]);
            padded.extend_from_slice(row);
            padded.resize(self.width + 2 * radius, row[self.width - 1]);
            for (o, v) in out.iter_mut().zip(&padded[radius..]) {
                *o = half_kernel[0] * v;
            }
            for (j, k) in half_kernel.iter().enumerate().skip(1) {
                let (before, after) = (&padded[radius - j..], &padded[radius + j..]);
                for ((o, a), b) in out.iter_mut().zip(before).zip(after) {
                    *o += k * (a + b);
                }
            }
        });
        Self::by_rows(self.width, self.height, |y, out| {
            for (o, v) in out.iter_mut().zip(horizontal.row(y)) {
                *o = half_kernel[0] * v;
            }
            for (j, k) in half_kernel.iter().enumerate().skip(1) {
                let before = horizontal.row(y.saturating_sub(j));
                let after = horizontal.row((y + j).min(self.height - 1));
                for ((o, a), b) in out.iter_mut().zip(before).zip(after) {
                    *o += k * (a + b);
                }
            }
        })
    }

    /// Gaussian blur, sigma in pixels.
    pub fn blurred(&self, sigma: f32) -> Self {
        if sigma <= 0.0 { self.clone() } else { self.convolved(&gaussian(sigma)) }
    }

    /// Resampled to another size over the same field: pixel borders, not centres, fall on each other. Reduction is
    /// anti-aliased by widening the kernel (Mitchell and Netravali's cubic, 1988, which neither rings nor shifts).
    pub fn resized(&self, width: usize, height: usize) -> Self {
        if width == self.width && height == self.height {
            return self.clone();
        }
        let columns = taps(self.width, width);
        let narrow = Self::by_rows(width, self.height, |y, out| {
            let row = self.row(y);
            for (o, tap) in out.iter_mut().zip(&columns) {
                *o = tap.weights.iter().zip(&row[tap.first..]).map(|(w, v)| w * v).sum();
            }
        });
        let lines = taps(self.height, height);
        Self::by_rows(width, height, |y, out| {
            let tap = &lines[y];
            for (i, w) in tap.weights.iter().enumerate() {
                for (o, v) in out.iter_mut().zip(narrow.row(tap.first + i)) {
                    *o += w * v;
                }
            }
        })
    }
}

/// The centre and right half of a normalised Gaussian.
pub fn gaussian(sigma: f32) -> Vec<f32> {
    let radius = (3.5 * sigma).ceil() as usize;
    let half: Vec<f64> = (0..=radius).map(|i| (-0.5 * (i as f64 / f64::from(sigma)).powi(2)).exp()).collect();
    let sum = half[0] + 2.0 * half[1..].iter().sum::<f64>();
    half.iter().map(|v| (v / sum) as f32).collect()
}

struct Tap {
    first: usize,
    weights: Vec<f32>,
}

fn taps(from: usize, to: usize) -> Vec<Tap> {
    let step = from as f64 / to as f64;
    let stretch = step.max(1.0);
    (0..to)
        .map(|i| {
            let centre = (i as f64 + 0.5) * step - 0.5;
            let first = (centre - 2.0 * stretch).ceil().max(0.0) as usize;
            let last = ((centre + 2.0 * stretch).floor() as usize).min(from - 1);
            let weights: Vec<f64> = (first..=last).map(|j| mitchell((j as f64 - centre) / stretch)).collect();
            let sum: f64 = weights.iter().sum();
            Tap { first, weights: weights.iter().map(|w| (w / sum) as f32).collect() }
        })
        .collect()
}

/// Mitchell and Netravali's cubic with B = C = 1/3.
fn mitchell(t: f64) -> f64 {
    let t = t.abs();
    if t < 1.0 {
        (7.0 * t * t * t - 12.0 * t * t + 16.0 / 3.0) / 6.0
    } else if t < 2.0 {
        (-7.0 / 3.0 * t * t * t + 12.0 * t * t - 20.0 * t + 32.0 / 3.0) / 6.0
    } else {
        0.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn resizing_moves_nothing() {
        // A ramp keeps its values at the same places: 0.01 px of the new size would show.
        let ramp = Plane::by_rows(400, 320, |y, row| {
            for (x, v) in row.iter_mut().enumerate() {
                *v = (x as f32 + 0.5) + 2.0 * (y as f32 + 0.5);
            }
        });
        for (w, h) in [(100, 80), (130, 70), (57, 43), (640, 500)] {
            let resized = ramp.resized(w, h);
            let (sx, sy) = (400.0 / w as f32, 320.0 / h as f32);
            for y in 4..h - 4 {
                for x in 4..w - 4 {
                    let expected = (x as f32 + 0.5) * sx + 2.0 * (y as f32 + 0.5) * sy;
                    assert!((resized.at(x, y) - expected).abs() < 0.01 * (sx + 2.0 * sy), "{w} {x} {y}");
                }
            }
        }
    }

    #[test]
    fn a_blur_keeps_sums_and_constants() {
        let constant = Plane::filled(30, 20, 4.0).blurred(2.3);
        assert!(constant.values.iter().all(|v| (v - 4.0).abs() < 1e-5));
        let mut point = Plane::filled(41, 41, 0.0);
        point.values[20 * 41 + 20] = 1.0;
        let blurred = point.blurred(2.0);
        assert!((blurred.values.iter().sum::<f32>() - 1.0).abs() < 1e-5);
        let variance: f32 = (0..41).map(|x| (x as f32 - 20.0).powi(2) * blurred.row(20)[x]).sum::<f32>()
            / blurred.row(20).iter().sum::<f32>();
        assert!((variance - 4.0).abs() < 0.05, "{variance}");
    }
}
