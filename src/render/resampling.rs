//! Intensity at the pixels' centres, from points that lie beside them.
//!
//! The point behind a pixel lies up to half a pixel from its centre. Drawn there, every edge is torn by that much, and
//! what is matched is shifted. Here a plane is fitted to the intensities of the measured neighbours *at their true
//! places*, weighted by a Gaussian of their distance and held flat where too few neighbours carry it; neighbours across
//! a depth edge take no part.

use rayon::prelude::*;

/// A synthetic camera image's samples.
pub struct Scattered<'a> {
    /// Pixels in a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// What is to be resampled; read where `offsets` is finite.
    pub values: &'a [f32],
    /// The true place of the point in its pixel, x and y from the centre; NaN where nothing was measured.
    pub offsets: &'a [[f32; 2]],
    /// Inverse depth of measured and filled pixels, 0 elsewhere.
    pub inverse_depth: &'a [f32],
}

/// Relative change of depth from one pixel to the next that is still one surface.
const STEP: f32 = 0.02;

/// The value at each pixel's centre; NaN where nothing was measured or filled, or no neighbour is near. `sigma` is that
/// of the Gaussian, px; pixels whose neighbours are farther away are reached by a wider one, up to `widest`. With `gaps`
/// only pixels without a point of their own are asked for; the others are NaN.
pub fn resampled(image: &Scattered, sigma: f32, widest: f32, gaps: bool) -> Vec<f32> {
    if image.width == 0 {
        return Vec::new();
    }
    let measured = Measured::of(image);
    let mut out = vec![f32::NAN; image.width * image.height];
    out.par_chunks_mut(image.width).enumerate().for_each(|(y, row)| {
        for (x, value) in row.iter_mut().enumerate() {
            let i = y * image.width + x;
            if image.inverse_depth[i] > 0.0 && !(gaps && measured.has(x, y)) {
                let mut s = sigma;
                loop {
                    if let Some(v) = fit(image, &measured, x, y, s) {
                        *value = v;
                        break;
                    }
                    s *= 2.0;
                    if s > widest {
                        break;
                    }
                }
            }
        }
    });
    out
}

/// Which pixels have a point of their own, a bit for each: in a sparse image most of a neighbourhood has none.
struct Measured {
    words: usize,
    bits: Vec<u64>,
}

impl Measured {
    fn of(image: &Scattered) -> Self {
        let words = image.width.div_ceil(64);
        let mut bits = vec![0u64; words * image.height];
        bits.par_chunks_mut(words).zip(image.offsets.par_chunks(image.width)).for_each(|(bits, row)| {
            for (word, pixels) in bits.iter_mut().zip(row.chunks(64)) {
                *word = pixels.iter().enumerate().fold(0, |w, (k, o)| w | (u64::from(!o[0].is_nan()) << k));
            }
        });
        Self { words, bits }
    }

    fn has(&self, x: usize, y: usize) -> bool {
        (self.bits[y * self.words + x / 64] >> (x % 64)) & 1 == 1
    }

    /// Calls `f` with the measured columns of row `y` from `first` to `last`, in this order.
    fn columns(&self, y: usize, first: usize, last: usize, mut f: impl FnMut(usize)) {
        let row = &self.bits[y * self.words..(y + 1) * self.words];
        for (k, &word) in row.iter().enumerate().take(last / 64 + 1).skip(first / 64) {
            let mut rest = word;
            if k == first / 64 {
                rest &= u64::MAX << (first % 64);
            }
            if k == last / 64 {
                rest &= u64::MAX >> (63 - last % 64);
            }
            while rest != 0 {
                f(64 * k + rest.trailing_zeros() as usize);
                rest &= rest - 1;
            }
        }
    }
}

fn fit(image: &Scattered, measured: &Measured, x: usize, y: usize, sigma: f32) -> Option<f32> {
    let reach = (2.2 * sigma + 0.5).ceil() as usize;
    let here = image.inverse_depth[y * image.width + x];
    let scale = -0.5 / (sigma * sigma);
    let (mut s, mut sx, mut sy, mut sxx, mut sxy, mut syy) = (0.0f32, 0.0, 0.0, 0.0, 0.0, 0.0);
    let (mut sv, mut svx, mut svy) = (0.0f32, 0.0, 0.0);
    let (left, right) = (x.saturating_sub(reach), (x + reach).min(image.width - 1));
    for v in y.saturating_sub(reach)..=(y + reach).min(image.height - 1) {
        measured.columns(v, left, right, |u| {
            let i = v * image.width + u;
            let steps = u.abs_diff(x).max(v.abs_diff(y)).max(1) as f32;
            if (image.inverse_depth[i] - here).abs() > STEP * steps * here {
                return;
            }
            let [ox, oy] = image.offsets[i];
            let (px, py) = ((u as f32 - x as f32) + ox, (v as f32 - y as f32) + oy);
            let weight = (scale * (px * px + py * py)).exp();
            let value = image.values[i];
            s += weight;
            sx += weight * px;
            sy += weight * py;
            sxx += weight * px * px;
            sxy += weight * px * py;
            syy += weight * py * py;
            sv += weight * value;
            svx += weight * px * value;
            svy += weight * py * value;
        });
    }
    // Less than a sixth of one centred neighbour says nothing.
    if s < 0.16 {
        return None;
    }
    let (mx, my, mv) = (sx / s, sy / s, sv / s);
    // Moments about the mean; the ridge is a tenth of what a full neighbourhood has.
    let ridge = 0.1 * sigma * sigma;
    let (a, b, c) = (sxx / s - mx * mx + ridge, sxy / s - mx * my, syy / s - my * my + ridge);
    let (p, q) = (svx / s - mx * mv, svy / s - my * mv);
    let determinant = a * c - b * b;
    let (gx, gy) = ((c * p - b * q) / determinant, (a * q - b * p) / determinant);
    Some(mv - gx * mx - gy * my)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn noise(i: usize) -> f32 {
        ((i as f64 * 12.9898).sin() * 43758.5453).fract().abs() as f32 - 0.5
    }

    /// A picture of value `f(place)` sampled at random places in a share of the pixels.
    fn scattered(f: impl Fn(f32, f32) -> f32, share: f32) -> (Vec<f32>, Vec<[f32; 2]>) {
        (0..50 * 40)
            .map(|i| {
                let (x, y) = ((i % 50) as f32, (i / 50) as f32);
                let offset = [noise(i), noise(i + 5000)];
                if noise(i + 9000) + 0.5 < share {
                    (f(x + offset[0], y + offset[1]), offset)
                } else {
                    (f32::NAN, [f32::NAN; 2])
                }
            })
            .unzip()
    }

    #[test]
    fn values_stand_at_the_centres_and_not_where_the_points_lie() {
        let wave = |x: f32, y: f32| (0.4 * x).sin() + (0.3 * y + 0.2 * x).cos();
        for (share, limit) in [(1.0, 0.06), (0.5, 0.09)] {
            let (values, offsets) = scattered(wave, share);
            let inverse_depth = vec![0.1; 2000];
            let image =
                Scattered { width: 50, height: 40, values: &values, offsets: &offsets, inverse_depth: &inverse_depth };
            let out = resampled(&image, 0.7, 3.0, false);
            let (mut torn, mut mended, mut n) = (0.0, 0.0, 0.0);
            for y in 4..36 {
                for x in 4..46 {
                    let i = y * 50 + x;
                    let truth = wave(x as f32, y as f32);
                    mended += (out[i] - truth).powi(2);
                    if values[i].is_finite() {
                        torn += (values[i] - truth).powi(2);
                        n += 1.0;
                    }
                }
            }
            // Asked for the gaps alone, these are the same.
            for (i, v) in resampled(&image, 0.7, 3.0, true).iter().enumerate() {
                let expected = if values[i].is_nan() { out[i] } else { f32::NAN };
                assert!(v.to_bits() == expected.to_bits() || v.is_nan() && expected.is_nan());
            }
            let (torn, mended) = ((torn / n as f32).sqrt(), (mended / (32.0 * 42.0f32)).sqrt());
            assert!(mended < limit && mended < 0.6 * torn, "share {share}: torn {torn}, mended {mended}");
        }
    }

    #[test]
    fn nothing_is_mixed_across_a_depth_edge() {
        let (values, offsets) = scattered(|x, _| if x < 24.5 { 0.0 } else { 100.0 }, 1.0);
        let inverse_depth: Vec<f32> = (0..2000).map(|i| if i % 50 < 25 { 0.1 } else { 0.05 }).collect();
        let values: Vec<f32> = values.iter().enumerate().map(|(i, _)| if i % 50 < 25 { 0.0 } else { 100.0 }).collect();
        let image =
            Scattered { width: 50, height: 40, values: &values, offsets: &offsets, inverse_depth: &inverse_depth };
        for (i, v) in resampled(&image, 0.8, 3.0, false).iter().enumerate() {
            let expected = if i % 50 < 25 { 0.0 } else { 100.0 };
            assert!((v - expected).abs() < 1e-3);
        }
    }
}
