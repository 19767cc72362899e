//! Oriented gradient channels: what a picture in near-infrared and one in daylight have in common.
//!
//! Ye et al. (2019, CFOG) sort each pixel's gradient magnitude into many channels by its orientation modulo π, blur
//! them, and compare the stack by its inner product. For one pair of gradients that inner product depends on the angle
//! Δ between them alone, as a tuning curve; so the same comparison is had from the curve's few Fourier coefficients in
//! place of the many channels: magnitude times (w0, w2 cos 2θ, w2 sin 2θ, w4 cos 4θ, w4 sin 4θ). Five planes do what
//! nine or more channels do, without their steps between orientations, and the curve becomes a choice ([`Tuning`]).

use super::plane::Plane;
use crate::error::{Error, Result};

/// How the likeness of two gradients falls with the angle between them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Tuning {
    /// The curve of CFOG's |cos| channels: 0.64 left at right angles.
    Cfog,
    /// cos² Δ.
    Cosine2,
    /// cos⁴ Δ.
    Cosine4,
}

impl Tuning {
    /// The amplitudes of harmonics 0, 2 and 4, whose squares are the curve's Fourier coefficients.
    fn amplitudes(self) -> [f32; 3] {
        let squares: [f32; 3] = match self {
            // |cos φ| = 2/π + 4/3π cos 2φ − 4/15π cos 4φ …, correlated with itself and scaled to 1 at Δ = 0.
            Self::Cfog => [0.4053 / 0.4989, 0.0901 / 0.4989, 0.0036 / 0.4989],
            Self::Cosine2 => [0.5, 0.5, 0.0],
            Self::Cosine4 => [0.375, 0.5, 0.125],
        };
        squares.map(f32::sqrt)
    }
}

/// How channels are made.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ChannelOptions {
    /// Blur before differences are taken, px.
    pub sigma_gradient: f32,
    /// Blur of the channels, px.
    pub sigma_channel: f32,
    /// Magnitudes saturate around this multiple of their median, so that a hard shadow does not outvote a wall.
    pub saturation: f32,
    /// How orientation counts.
    pub tuning: Tuning,
}

impl Default for ChannelOptions {
    fn default() -> Self {
        Self { sigma_gradient: 0.8, sigma_channel: 1.0, saturation: 3.0, tuning: Tuning::Cosine4 }
    }
}

/// A picture's channels and where they hold.
#[derive(Debug, Clone)]
pub struct Channels {
    /// One plane for each channel, zero where `weight` is.
    pub planes: Vec<Plane>,
    /// 1 where the gradient stands on known pixels only, else 0.
    pub weight: Plane,
}

/// The gradient of a picture of which only some pixels are known.
#[derive(Debug, Clone)]
pub struct Gradient {
    /// Along x, per pixel.
    pub x: Plane,
    /// Along y, per pixel.
    pub y: Plane,
    /// 1 where all pixels that it stands on are known, else 0.
    pub weight: Plane,
}

/// Central differences of the blurred picture. `known` is 1 where a pixel is known and 0 elsewhere; the blur takes
/// known pixels alone.
pub fn gradient(image: &Plane, known: Option<&Plane>, sigma: f32) -> Result<Gradient> {
    let (w, h) = (image.width, image.height);
    if let Some(known) = known
        && !known.same_size(image)
    {
        return Err(Error::invalid(format!(
            "the mask of {} × {} pixels is not that of an image of {w} × {h}",
            known.width, known.height
        )));
    }
    let blurred = masked_blur(image, known, sigma);
    let is_known = |x: usize, y: usize| known.is_none_or(|k| k.at(x, y) > 0.0);
    let weight = Plane::by_rows(w, h, |y, out| {
        if y == 0 || y + 1 == h {
            return;
        }
        for x in 1..w.saturating_sub(1) {
            let all = (y - 1..=y + 1).all(|v| (x - 1..=x + 1).all(|u| is_known(u, v)));
            out[x] = f32::from(u8::from(all));
        }
    });
    let along = |vertical: bool| {
        Plane::by_rows(w, h, |y, out| {
            if y == 0 || y + 1 == h {
                return;
            }
            let (above, row, below) = (blurred.row(y - 1), blurred.row(y), blurred.row(y + 1));
            for x in 1..w.saturating_sub(1) {
                let d = if vertical { below[x] - above[x] } else { row[x + 1] - row[x - 1] };
                out[x] = 0.5 * d * weight.at(x, y);
            }
        })
    };
    Ok(Gradient { x: along(false), y: along(true), weight })
}

/// A Gaussian blur that takes known pixels alone; 0 where none is near.
pub fn masked_blur(image: &Plane, known: Option<&Plane>, sigma: f32) -> Plane {
    let Some(known) = known else { return image.blurred(sigma) };
    let clean = image.zip(known, |v, k| if k > 0.0 { v } else { 0.0 });
    if sigma <= 0.0 {
        return clean;
    }
    let (sum, weight) = (clean.blurred(sigma), known.blurred(sigma));
    sum.zip(&weight, |s, w| if w > 1e-4 { s / w } else { 0.0 })
}

/// The channels of a picture. `known` is 1 where a pixel is known and 0 elsewhere.
pub fn channels(image: &Plane, known: Option<&Plane>, options: &ChannelOptions) -> Result<Channels> {
    let gradient = gradient(image, known, options.sigma_gradient)?;
    let magnitude = gradient.x.zip(&gradient.y, f32::hypot);
    let floor = options.saturation * median_where(&magnitude, &gradient.weight);
    if floor <= 0.0 {
        return Err(Error::Degenerate {
            what: "the picture has no edges to match".into(),
            quantity: "median gradient",
            value: f64::from(floor),
            limit: 0.0,
            remedy: "check that the intensity is not constant and the photo not blank",
        });
    }
    let [w0, w2, w4] = options.tuning.amplitudes();
    let strength = |gx: f32, gy: f32| {
        let m2 = gx * gx + gy * gy;
        // Saturated magnitude over magnitude squared: what unit-free products of gx, gy are scaled by.
        if m2 > 0.0 { (m2 / (m2 + floor * floor)).sqrt() / m2 } else { 0.0 }
    };
    let channel = |f: &(dyn Fn(f32, f32) -> f32 + Sync)| -> Plane {
        let raw = gradient.x.zip(&gradient.y, f);
        masked_blur(&raw, Some(&gradient.weight), options.sigma_channel).zip(&gradient.weight, |v, k| v * k)
    };
    let mut planes = vec![
        channel(&|gx, gy| w0 * strength(gx, gy) * (gx * gx + gy * gy)),
        channel(&|gx, gy| w2 * strength(gx, gy) * (gx * gx - gy * gy)),
        channel(&|gx, gy| w2 * strength(gx, gy) * (2.0 * gx * gy)),
    ];
    if w4 > 0.1 {
        let fourfold = |gx: f32, gy: f32| {
            let m2 = gx * gx + gy * gy;
            if m2 > 0.0 { (strength(gx, gy) / m2, gx * gx - gy * gy, 2.0 * gx * gy) } else { (0.0, 0.0, 0.0) }
        };
        planes.push(channel(&|gx, gy| {
            let (s, c2, s2) = fourfold(gx, gy);
            w4 * s * (c2 * c2 - s2 * s2)
        }));
        planes.push(channel(&|gx, gy| {
            let (s, c2, s2) = fourfold(gx, gy);
            w4 * s * 2.0 * c2 * s2
        }));
    }
    Ok(Channels { planes, weight: gradient.weight })
}

/// The median of the values whose weight is not zero; 0 when there are none.
fn median_where(values: &Plane, weight: &Plane) -> f32 {
    let mut kept: Vec<f32> =
        values.values.iter().zip(&weight.values).filter(|(_, w)| **w > 0.0).map(|(v, _)| *v).collect();
    if kept.is_empty() {
        return 0.0;
    }
    // In a picture of large even areas the median may be 0: then the mean stands in.
    let middle = kept.len() / 2;
    let (_, median, _) = kept.select_nth_unstable_by(middle, f32::total_cmp);
    if *median > 0.0 { *median } else { kept.iter().map(|v| f64::from(*v)).sum::<f64>() as f32 / kept.len() as f32 }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A stripe pattern whose gradient runs along `angle`.
    fn stripes(angle: f32) -> Plane {
        Plane::by_rows(64, 64, |y, row| {
            for (x, v) in row.iter_mut().enumerate() {
                let (u, w) = (x as f32 - 31.5, y as f32 - 31.5);
                *v = (0.4 * (u * angle.cos() + w * angle.sin())).sin();
            }
        })
    }

    fn likeness(a: &Channels, b: &Channels) -> f32 {
        let dot = |a: &Channels, b: &Channels| -> f32 {
            a.planes.iter().zip(&b.planes).map(|(p, q)| p.at(32, 32) * q.at(32, 32)).sum()
        };
        dot(a, b) / (dot(a, a) * dot(b, b)).sqrt()
    }

    #[test]
    fn likeness_follows_the_tuning_curve() {
        let of = |angle: f32, tuning| {
            let options = ChannelOptions { tuning, sigma_channel: 0.0, ..ChannelOptions::default() };
            channels(&stripes(angle), None, &options).unwrap()
        };
        for degrees in [0.0f32, 20.0, 45.0, 70.0, 90.0] {
            let delta = degrees.to_radians();
            let c2 = likeness(&of(0.3, Tuning::Cosine2), &of(0.3 + delta, Tuning::Cosine2));
            assert!((c2 - delta.cos().powi(2)).abs() < 0.03, "{degrees} {c2}");
            let c4 = likeness(&of(0.3, Tuning::Cosine4), &of(0.3 + delta, Tuning::Cosine4));
            assert!((c4 - delta.cos().powi(4)).abs() < 0.03, "{degrees} {c4}");
        }
        // CFOG, from its definition with many |cos| channels.
        let many = |a: f32, b: f32| -> f32 {
            (0..180).map(|k| (k as f32).to_radians()).map(|t| (a - t).cos().abs() * (b - t).cos().abs()).sum()
        };
        for degrees in [30.0f32, 90.0] {
            let (a, b) = (0.3, 0.3 + degrees.to_radians());
            let expected = many(a, b) / many(a, a);
            let found = likeness(&of(a, Tuning::Cfog), &of(b, Tuning::Cfog));
            assert!((found - expected).abs() < 0.03, "{degrees}: {found} {expected}");
        }
    }

    #[test]
    fn reversed_contrast_gives_the_same_channels() {
        let a = stripes(0.7);
        let b = a.map(|v| 5.0 - 3.0 * v);
        let options = ChannelOptions::default();
        let (ca, cb) = (channels(&a, None, &options).unwrap(), channels(&b, None, &options).unwrap());
        for (p, q) in ca.planes.iter().zip(&cb.planes) {
            for (u, v) in p.values.iter().zip(&q.values) {
                assert!((u - v).abs() < 1e-5);
            }
        }
    }

    #[test]
    fn unknown_pixels_make_no_edges() {
        let image = Plane::by_rows(40, 40, |y, row| {
            for (x, v) in row.iter_mut().enumerate() {
                *v = if x > 20 { 1000.0 } else { x as f32 * 0.1 + y as f32 * 0.05 };
            }
        });
        let known = image.map(|v| f32::from(u8::from(v < 500.0)));
        let g = gradient(&image, Some(&known), 0.8).unwrap();
        let largest = g.x.values.iter().fold(0.0f32, |a, b| a.max(b.abs()));
        assert!(largest < 0.12, "{largest}");
        assert_eq!(g.weight.at(20, 10), 0.0);
        assert_eq!(g.weight.at(19, 10), 1.0);
    }

    #[test]
    fn a_blank_picture_is_refused() {
        let error = channels(&Plane::filled(20, 20, 3.0), None, &ChannelOptions::default()).unwrap_err();
        assert!(error.to_string().contains("no edges"), "{error}");
    }
}
