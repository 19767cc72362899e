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
/// of the Gaussian, px; pixels whose neighbours are farther away are reached by a wider one, up to `widest`.
pub fn resampled(image: &Scattered, sigma: f32, widest: f32) -> Vec<f32> {
    let mut out = vec![f32::NAN; image.width * image.height];
    out.par_chunks_mut(image.width).enumerate().for_each(|(y, row)| {
        for (x, value) in row.iter_mut().enumerate() {
            if image.inverse_depth[y * image.width + x] > 0.0 {
                let mut s = sigma;
                loop {
                    if let Some(v) = fit(image, x, y, s) {
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

fn fit(image: &Scattered, x: usize, y: usize, sigma: f32) -> Option<f32> {
    let reach = (2.2 * sigma + 0.5).ceil() as isize;
    let (w, h) = (image.width as isize, image.height as isize);
    let here = image.inverse_depth[y * image.width + x];
    let scale = -0.5 / (sigma * sigma);
    let (mut s, mut sx, mut sy, mut sxx, mut sxy, mut syy) = (0.0f32, 0.0, 0.0, 0.0, 0.0, 0.0);
    let (mut sv, mut svx, mut svy) = (0.0f32, 0.0, 0.0);
    for dy in -reach..=reach {
        let v = y as isize + dy;
        if v < 0 || v >= h {
            continue;
        }
        for dx in -reach..=reach {
            let u = x as isize + dx;
            if u < 0 || u >= w {
                continue;
            }
            let i = (v * w + u) as usize;
            let [ox, oy] = image.offsets[i];
            if ox.is_nan() {
                continue;
            }
            let steps = dx.abs().max(dy.abs()).max(1) as f32;
            if (image.inverse_depth[i] - here).abs() > STEP * steps * here {
                continue;
            }
            let (px, py) = (dx as f32 + ox, dy as f32 + oy);
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
        }
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
            let out = resampled(&image, 0.7, 3.0);
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
        for (i, v) in resampled(&image, 0.8, 3.0).iter().enumerate() {
            let expected = if i % 50 < 25 { 0.0 } else { 100.0 };
            assert!((v - expected).abs() < 1e-3);
        }
    }
}
