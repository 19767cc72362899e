//! The least-squares plane of all samples of a window, and how many lie on it: eight samples at a time, from the buffer as it
//! lies. What [`super::plane_fit::Plane::fitted`] gives for a list of them, to single precision.
#![cfg(target_arch = "x86_64")]

use std::arch::x86_64::*;

use nalgebra::{Matrix2, Vector2};

use super::plane_fit::{Fit, Moments, Noise, Plane, SIGMAS};
use super::sample::Sample;

/// A window's part of a buffer.
pub(super) struct Part<'a> {
    /// From the first sample on.
    pub samples: &'a [Sample],
    pub stride: usize,
    /// Columns and rows.
    pub size: [usize; 2],
    /// The first pixel, from the window's middle.
    pub first: [f64; 2],
    /// Of the window, pixels.
    pub radius: f64,
    /// The window's middle, (X, Y)/Z.
    pub middle: [f64; 2],
    /// From pixels to (X, Y)/Z.
    pub from_pixels: Matrix2<f64>,
}

/// Samples at once.
const LANES: usize = 8;

/// Samples side by side: places in pixels from the window's middle, inverse depths less the reference, and all bits set where
/// there is one.
struct Eight {
    x: __m256,
    y: __m256,
    w: __m256,
    there: __m256,
}

/// What does not change from row to row, of eight columns.
struct Columns {
    first: usize,
    x: __m256,
    inside: __m256i,
}

impl Part<'_> {
    /// `None` at the end of the buffer. `RANGE` for cameras whose depths are ranges.
    #[target_feature(enable = "avx2")]
    pub fn fit<const RANGE: bool>(&self, noise: &Noise) -> Option<Fit> {
        let Some(reference) = self.reference() else { return Some(Fit { plane: None, count: 0, near: 0 }) };
        let sums = self.sums::<RANGE>(reference)?.map(|lanes| sum(lanes));
        let [n, x, y, w, xx, xy, yy, xw, yw] = sums;
        let mean = Vector2::new(x / n, y / n);
        let spread = Matrix2::new(xx - x * mean.x, xy - x * mean.y, xy - x * mean.y, yy - y * mean.y);
        let rise = Vector2::new(xw - x * (w / n), yw - y * (w / n));
        // From pixels to the unit of spots.
        let m = self.from_pixels / (self.radius * self.from_pixels.determinant().abs().sqrt());
        let (at, spread, rise) = (m * mean, m * spread * m.transpose(), m * rise);
        let mean = [at.x, at.y, f64::from(reference) + w / n];
        let moments = Moments { mean, spread: [spread[(0, 0)], spread[(0, 1)], spread[(1, 1)]], rise: rise.into() };
        let count = n as usize;
        let Some((plane, gradient)) = Plane::of(&moments).filter(|_| count >= 3) else {
            return Some(Fit { plane: None, count, near: 0 });
        };
        let slope = m.transpose() * Vector2::from(gradient);
        let middle = mean[2] - gradient[0] * mean[0] - gradient[1] * mean[1] - f64::from(reference);
        let local = [middle, slope.x, slope.y].map(|x| x as f32);
        let allowed = [SIGMAS * noise.place * plane.slope(), SIGMAS * noise.rounding, SIGMAS * noise.depth];
        let (near, squares) = self.near::<RANGE>(reference, local, allowed)?;
        Some(Fit { plane: Some(plane.leaving(squares, n)), count, near })
    }

    /// The inverse depth of some sample: differences to it keep their digits.
    fn reference(&self) -> Option<f32> {
        let [columns, rows] = self.size;
        let of_row = |y: usize| self.samples.get(y * self.stride..)?.get(..columns)?.iter().find(|s| s.found());
        (rows / 2..rows).chain(0..rows / 2).find_map(of_row).map(|s| s.inverse_depth())
    }

    #[target_feature(enable = "avx2")]
    fn columns(&self, first: usize) -> Columns {
        let lanes = _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7);
        let left = _mm256_set1_ps((self.first[0] + first as f64) as f32);
        let rest = _mm256_set1_epi32((self.size[0] - first) as i32);
        Columns { first, x: _mm256_add_ps(left, _mm256_cvtepi32_ps(lanes)), inside: _mm256_cmpgt_epi32(rest, lanes) }
    }

    /// The samples of a row in these columns.
    #[inline]
    #[target_feature(enable = "avx2")]
    fn eight<const RANGE: bool>(&self, columns: &Columns, row: usize, reference: __m256) -> Option<Eight> {
        let samples: &[Sample; LANES] = self.samples.get(row * self.stride + columns.first..)?.first_chunk()?;
        // SAFETY: a sample is 32 bits.
        let samples = unsafe { _mm256_loadu_si256(samples.as_ptr().cast()) };
        let there = _mm256_andnot_si256(_mm256_cmpeq_epi32(samples, _mm256_setzero_si256()), columns.inside);
        let [right, down] = Sample::places(samples);
        let (x, y) =
            (_mm256_add_ps(columns.x, right), _mm256_add_ps(_mm256_set1_ps(self.first[1] as f32 + row as f32), down));
        let mut w = _mm256_castsi256_ps(Sample::inverse_depth_bits(samples));
        if RANGE {
            let at = |k: usize| {
                let [a, b] = [0, 1].map(|i| _mm256_set1_ps(self.from_pixels[(k, i)] as f32));
                let along = _mm256_add_ps(_mm256_mul_ps(a, x), _mm256_mul_ps(b, y));
                _mm256_add_ps(_mm256_set1_ps(self.middle[k] as f32), along)
            };
            let (u, v) = (at(0), at(1));
            let square = _mm256_add_ps(_mm256_mul_ps(u, u), _mm256_mul_ps(v, v));
            w = _mm256_mul_ps(w, _mm256_sqrt_ps(_mm256_add_ps(square, _mm256_set1_ps(1.0))));
        }
        Some(Eight { x, y, w: _mm256_sub_ps(w, reference), there: _mm256_castsi256_ps(there) })
    }

    /// Lanes of the sums of 1 x y w xx xy yy xw yw.
    #[target_feature(enable = "avx2")]
    fn sums<const RANGE: bool>(&self, reference: f32) -> Option<[__m256; 9]> {
        let reference = _mm256_set1_ps(reference);
        let mut sums = [_mm256_setzero_ps(); 9];
        for first in (0..self.size[0]).step_by(LANES) {
            let columns = self.columns(first);
            for row in 0..self.size[1] {
                let Eight { x, y, w, there } = self.eight::<RANGE>(&columns, row, reference)?;
                let one = _mm256_and_ps(_mm256_set1_ps(1.0), there);
                let (nx, ny, nw) = (_mm256_and_ps(x, there), _mm256_and_ps(y, there), _mm256_and_ps(w, there));
                let (xx, xy, yy) = (_mm256_mul_ps(nx, x), _mm256_mul_ps(nx, y), _mm256_mul_ps(ny, y));
                let (xw, yw) = (_mm256_mul_ps(nx, w), _mm256_mul_ps(ny, w));
                let values = [one, nx, ny, nw, xx, xy, yy, xw, yw];
                for k in 0..9 {
                    sums[k] = _mm256_add_ps(sums[k], values[k]);
                }
            }
        }
        Some(sums)
    }

    /// How many samples lie on the plane `middle + x·gx + y·gy` above the reference, by the powers of the inverse depth of what
    /// is allowed, and the sum of the squares of what all leave over.
    #[target_feature(enable = "avx2")]
    fn near<const RANGE: bool>(&self, reference: f32, plane: [f32; 3], allowed: [f32; 3]) -> Option<(usize, f64)> {
        let reference = _mm256_set1_ps(reference);
        let [middle, gx, gy] = plane.map(|v| _mm256_set1_ps(v));
        let [constant, linear, square] = allowed.map(|v| _mm256_set1_ps(v));
        let (mut near, mut squares) = (_mm256_setzero_ps(), _mm256_setzero_ps());
        for first in (0..self.size[0]).step_by(LANES) {
            let columns = self.columns(first);
            for row in 0..self.size[1] {
                let Eight { x, y, w, there } = self.eight::<RANGE>(&columns, row, reference)?;
                let rise = _mm256_add_ps(_mm256_mul_ps(gx, x), _mm256_mul_ps(gy, y));
                let off = _mm256_and_ps(_mm256_sub_ps(_mm256_sub_ps(w, middle), rise), there);
                let inverse = _mm256_add_ps(w, reference);
                let slope = _mm256_add_ps(_mm256_mul_ps(square, inverse), linear);
                let most = _mm256_add_ps(_mm256_mul_ps(slope, inverse), constant);
                let size = _mm256_andnot_ps(_mm256_set1_ps(-0.0), off);
                let on = _mm256_and_ps(_mm256_cmp_ps::<_CMP_LE_OQ>(size, most), there);
                near = _mm256_add_ps(near, _mm256_and_ps(on, _mm256_set1_ps(1.0)));
                squares = _mm256_add_ps(squares, _mm256_mul_ps(off, off));
            }
        }
        Some((sum(near) as usize, sum(squares)))
    }
}

#[inline]
#[target_feature(enable = "avx2")]
fn sum(lanes: __m256) -> f64 {
    let mut values = [0.0_f32; LANES];
    // SAFETY: there is room for eight numbers.
    unsafe { _mm256_storeu_ps(values.as_mut_ptr(), lanes) };
    values.iter().map(|&v| f64::from(v)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::plane_fit::Spot;

    const NOISE: Noise = Noise { depth: 0.002, rounding: 1e-5, place: 0.005 };
    const STRIDE: usize = 48;

    /// Samples of a slanted wall at 10 m, some of a bolt before it, and gaps.
    fn samples() -> Vec<Sample> {
        let mut state = 5_u32;
        let mut random = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) as f32 / (1 << 24) as f32
        };
        let mut samples = vec![Sample::default(); STRIDE * STRIDE];
        for (k, sample) in samples.iter_mut().enumerate() {
            let (x, y, place) = ((k % STRIDE) as f32, (k / STRIDE) as f32, [random(), random()]);
            let wall = 0.1 + 2e-4 * (x + place[0]) - 1e-4 * (y + place[1]) + 2e-5 * (random() - 0.5);
            if random() < 0.6 {
                *sample = Sample::new(if random() < 0.03 { wall + 0.01 } else { wall }, place);
            }
        }
        samples
    }

    #[test]
    fn gives_what_a_list_of_the_samples_gives() {
        if !std::arch::is_x86_feature_detected!("avx2") {
            return;
        }
        let samples = samples();
        let from_pixels = Matrix2::new(1e-3, 1e-4, -5e-5, 1.1e-3);
        for (size, range) in [([13, 13], false), ([25, 24], false), ([8, 3], true), ([13, 14], true), ([2, 9], false)] {
            let (left, top, radius) = (5, 7, 6.0);
            let part = Part {
                samples: &samples[top * STRIDE + left..],
                stride: STRIDE,
                size,
                first: [-6.3, -5.8],
                radius,
                middle: [0.2, -0.4],
                from_pixels,
            };
            // SAFETY: the processor has the feature.
            let fit = unsafe { if range { part.fit::<true>(&NOISE) } else { part.fit::<false>(&NOISE) } }.unwrap();
            let unit = radius * from_pixels.determinant().sqrt();
            let mut spots = Vec::new();
            for row in 0..size[1] {
                for column in 0..size[0] {
                    let sample = part.samples[row * STRIDE + column];
                    if sample.found() {
                        let [right, down] = sample.place().map(f64::from);
                        let d = Vector2::new(part.first[0] + column as f64 + right, part.first[1] + row as f64 + down);
                        let at = from_pixels * d;
                        let (u, v) = (part.middle[0] + at.x, part.middle[1] + at.y);
                        let scale = if range { (u * u + v * v + 1.0).sqrt() } else { 1.0 };
                        let w = (f64::from(sample.inverse_depth()) * scale) as f32;
                        spots.push(Spot { a: (at.x / unit) as f32, b: (at.y / unit) as f32, w });
                    }
                }
            }
            let wanted = Plane::fitted(spots.iter()).unwrap();
            let plane = fit.plane.unwrap();
            assert_eq!(fit.count, spots.len());
            let near = spots.iter().filter(|spot| wanted.holds(spot, &NOISE)).count();
            assert!(near > 0 && fit.near.abs_diff(near) <= 1, "{} {near}", fit.near);
            for (found, wanted, allowed) in [
                (plane.c, wanted.c, 1e-6),
                (plane.ga, wanted.ga, 1e-6),
                (plane.gb, wanted.gb, 1e-6),
                (plane.rms, wanted.rms, 1e-3 * wanted.rms),
                (plane.weakness, wanted.weakness, 1e-4 * wanted.weakness),
            ] {
                assert!((found - wanted).abs() <= allowed, "{found} {wanted}");
            }
        }
    }

    #[test]
    fn nothing_is_seen_of_an_empty_window_and_nothing_beyond_the_buffer() {
        if !std::arch::is_x86_feature_detected!("avx2") {
            return;
        }
        let part = |samples| Part {
            samples,
            stride: 16,
            size: [13, 13],
            first: [-6.0; 2],
            radius: 6.0,
            middle: [0.0; 2],
            from_pixels: Matrix2::identity(),
        };
        let (empty, short) = (vec![Sample::default(); 256], vec![Sample::new(0.1, [0.5; 2]); 16 * 13 - 8]);
        // SAFETY: the processor has the feature.
        let [empty, short] = [&empty[..], &short[..]].map(|samples| unsafe { part(samples).fit::<false>(&NOISE) });
        assert!(empty.is_some_and(|fit| fit.plane.is_none() && fit.count == 0) && short.is_none());
    }
}
