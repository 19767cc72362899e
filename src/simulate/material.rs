//! What surfaces are made of: a stack of procedural layers, each evaluated under the footprint of the sample.
//!
//! A reflectance has four channels: linear red, green, blue, and near infrared (the scanner's). They differ the way real
//! surfaces do because each layer gives all four.

use nalgebra::Vector3;

use super::image::Painting;
use super::noise::{fractal, gradient, hash, pulse_coverage, resolved, signed, smoothstep, split, step_coverage};

/// Red, green, blue, near infrared, each in [0, 1].
pub type Reflectance = [f32; 4];

/// One layer over those below it.
#[derive(Clone, Debug)]
pub struct Layer {
    /// What it does.
    pub pattern: Pattern,
    /// Its colour, or for noise the gain of each channel.
    pub colour: Reflectance,
    /// How strongly it acts: opacity, or amplitude for noise.
    pub amount: f32,
    /// Size of its features along the two or three coordinates, metres.
    pub scale: [f32; 3],
    /// Seed of what is random in it.
    pub seed: u32,
}

/// What a layer does. Lengths are in metres of surface coordinates unless said otherwise.
///
/// Noise is taken at the place in space or, with `on_surface`, at the surface coordinates; `gain` is the amplitude of each
/// octave relative to the one before.
#[derive(Clone, Debug)]
pub enum Pattern {
    /// Covers everything.
    Fill,
    /// Multiplies by 1 + amount · colour · fractal noise.
    Noise {
        /// How many octaves.
        octaves: u32,
        /// See above.
        gain: f32,
        /// See above.
        on_surface: bool,
    },
    /// Covers where fractal noise is above a threshold.
    Patches {
        /// How many octaves.
        octaves: u32,
        /// See above.
        gain: f32,
        /// See above.
        on_surface: bool,
        /// The value of the noise (about ±1) at the middle of the patches' edge.
        threshold: f32,
        /// Half the width of the edge, in units of the noise.
        softness: f32,
    },
    /// Joints between courses of cells of the layer's scale (bricks, stones, tiles, planks).
    Courses {
        /// Width of a joint.
        joint: f32,
        /// Shift of each course against the one below, in cells; negative for a random one.
        stagger: f32,
        /// How much the cells differ in brightness.
        brightness: f32,
        /// How much they differ in hue (warm against cold).
        hue: f32,
        /// How much each darkens from its upper to its lower edge.
        relief: f32,
        /// How far the edges wander.
        wobble: f32,
    },
    /// Covers what lies low, fading out upwards.
    Gradient {
        /// Height up to which it covers.
        from: f32,
        /// Height from which it does not.
        to: f32,
        /// Height is that in space, not the second surface coordinate.
        by_height: bool,
    },
    /// A painting on a rectangle.
    Painted {
        /// Number of the painting.
        image: usize,
        /// First surface coordinate of its left edge.
        s0: f32,
        /// Second surface coordinate of its lower edge.
        t0: f32,
        /// First surface coordinate of its right edge.
        s1: f32,
        /// Second surface coordinate of its upper edge.
        t1: f32,
    },
    /// A ring, or a disc if the inner radius is 0.
    Ring {
        /// Its centre.
        centre: [f32; 2],
        /// Inner radius.
        inner: f32,
        /// Outer radius.
        outer: f32,
    },
    /// The first and third quadrant of a disc: a black-and-white target's pattern.
    Quadrants {
        /// Its centre.
        centre: [f32; 2],
        /// Its radius.
        radius: f32,
    },
    /// A rectangle.
    Rectangle {
        /// Left edge.
        s0: f32,
        /// Lower edge.
        t0: f32,
        /// Right edge.
        s1: f32,
        /// Upper edge.
        t1: f32,
    },
}

/// A stack of layers, and how the whole surface takes light.
#[derive(Clone, Debug, Default)]
pub struct Material {
    /// From the lowest up.
    pub layers: Vec<Layer>,
    /// Mirror reflectance at normal incidence (0 for matt surfaces; glass has 0.04 and more).
    pub gloss: f32,
    /// Part of the light that comes through from behind (leaves, cloth).
    pub translucency: f32,
    /// Height, metres, of the fine relief that tilts the normals under sunlight, and its wavelength.
    pub relief: [f32; 2],
    /// Light that the surface gives off itself.
    pub emission: [f32; 3],
}

/// Where a material is asked for.
#[derive(Clone, Copy, Debug)]
pub struct Spot {
    /// Place in the scene, metres.
    pub point: Vector3<f64>,
    /// Surface coordinates, metres.
    pub uv: [f64; 2],
    /// Width of the sample on the surface, metres.
    pub footprint: f32,
}

impl Material {
    /// The reflectance at a spot.
    pub fn reflectance(&self, spot: &Spot, paintings: &[Painting]) -> Reflectance {
        let mut colour = [0.5; 4];
        for layer in &self.layers {
            layer.apply(&mut colour, spot, paintings);
        }
        colour.map(|c| c.clamp(0.0, 1.0))
    }

    /// The normal as the fine relief tilts it.
    pub fn tilted(&self, normal: Vector3<f64>, spot: &Spot) -> Vector3<f64> {
        let [height, wavelength] = self.relief;
        let visible = if height > 0.0 { resolved(spot.footprint, wavelength) } else { 0.0 };
        if visible <= 0.0 {
            return normal;
        }
        let step = 0.15;
        let at = spot.point / f64::from(wavelength);
        let relief = |p: Vector3<f64>| {
            gradient(p.into(), 77) + 0.5 * resolved(2.1 * spot.footprint, wavelength) * gradient((p * 2.1).into(), 78)
        };
        let here = relief(at);
        let slope = Vector3::new(
            relief(at + Vector3::new(step, 0.0, 0.0)) - here,
            relief(at + Vector3::new(0.0, step, 0.0)) - here,
            relief(at + Vector3::new(0.0, 0.0, step)) - here,
        )
        .cast::<f64>()
            * (f64::from(visible * height / wavelength) / step);
        let along = slope - normal * slope.dot(&normal);
        (normal - along).normalize()
    }
}

fn cover(below: &mut Reflectance, colour: &Reflectance, opacity: f32) {
    for (b, c) in below.iter_mut().zip(colour) {
        *b += opacity * (c - *b);
    }
}

impl Layer {
    fn apply(&self, below: &mut Reflectance, spot: &Spot, paintings: &[Painting]) {
        let w = spot.footprint;
        let (s, t) = (spot.uv[0] as f32, spot.uv[1] as f32);
        match self.pattern {
            Pattern::Fill => cover(below, &self.colour, self.amount),
            Pattern::Noise { octaves, gain, on_surface } => {
                let value = self.amount * self.noise(spot, octaves, gain, on_surface);
                for (b, g) in below.iter_mut().zip(self.colour) {
                    *b *= (1.0 + g * value).max(0.0);
                }
            }
            Pattern::Patches { octaves, gain, on_surface, threshold, softness } => {
                let value = self.noise(spot, octaves, gain, on_surface);
                let edge = smoothstep(threshold - softness, threshold + softness, value);
                cover(below, &self.colour, self.amount * edge);
            }
            Pattern::Courses { joint, stagger, brightness, hue, relief, wobble } => {
                self.courses(below, spot, [joint, stagger, brightness, hue, relief, wobble]);
            }
            Pattern::Gradient { from, to, by_height } => {
                let height = if by_height { spot.point.z as f32 } else { t };
                cover(below, &self.colour, self.amount * (1.0 - smoothstep(from, to, height)));
            }
            Pattern::Painted { image, s0, t0, s1, t1 } => {
                let (x, y) = ((s - s0) / (s1 - s0), (t1 - t) / (t1 - t0));
                let inside = box_coverage(s, w, s0, s1) * box_coverage(t, w, t0, t1);
                if inside > 0.0
                    && let Some(painting) = paintings.get(image)
                {
                    let texel = (s1 - s0) / painting.size().0 as f32;
                    let [r, g, b, nir, opacity] = painting.sample(x, y, w / texel);
                    cover(below, &[r, g, b, nir], self.amount * opacity * inside);
                }
            }
            Pattern::Ring { centre, inner, outer } => {
                let radius = (s - centre[0]).hypot(t - centre[1]);
                let within = |r: f32| if r > 0.0 { 1.0 - step_coverage(radius, w, r) } else { 0.0 };
                cover(below, &self.colour, self.amount * (within(outer) - within(inner)).max(0.0));
            }
            Pattern::Quadrants { centre, radius } => {
                let (x, y) = (s - centre[0], t - centre[1]);
                let disc = 1.0 - step_coverage(x.hypot(y), w, radius);
                let (a, b) = (step_coverage(x, w, 0.0), step_coverage(y, w, 0.0));
                cover(below, &self.colour, self.amount * disc * (a * b + (1.0 - a) * (1.0 - b)));
            }
            Pattern::Rectangle { s0, t0, s1, t1 } => {
                cover(below, &self.colour, self.amount * box_coverage(s, w, s0, s1) * box_coverage(t, w, t0, t1));
            }
        }
    }

    fn noise(&self, spot: &Spot, octaves: u32, gain: f32, on_surface: bool) -> f32 {
        let scale = self.scale.map(f64::from);
        let p = if on_surface {
            [spot.uv[0] / scale[0], spot.uv[1] / scale[1], 0.5]
        } else {
            [spot.point.x / scale[0], spot.point.y / scale[1], spot.point.z / scale[2]]
        };
        let finest = self.scale.iter().copied().fold(f32::INFINITY, f32::min);
        fractal(p, spot.footprint / finest, octaves, gain, self.seed)
    }

    fn courses(&self, below: &mut Reflectance, spot: &Spot, parameters: [f32; 6]) {
        let [joint, stagger, brightness, hue, relief, wobble] = parameters;
        let [length, height, _] = self.scale;
        let w = spot.footprint;
        let mut uv = spot.uv;
        if wobble > 0.0 {
            // Edges of hand-made cells wander: displace the coordinates by noise a few joints long.
            let reach = 6.0 * f64::from(joint.max(wobble));
            let amount = f64::from(wobble * resolved(w, reach as f32));
            if amount > 0.0 {
                uv[0] += amount * f64::from(gradient([spot.uv[0] / reach, spot.uv[1] / reach, 3.5], self.seed));
                uv[1] += amount * f64::from(gradient([spot.uv[0] / reach, spot.uv[1] / reach, 9.5], self.seed));
            }
        }
        let (row, up) = split(uv[1] / f64::from(height));
        let shift = if stagger >= 0.0 {
            f64::from(stagger) * f64::from(row)
        } else {
            // A negative stagger: every row begins at its own random place.
            f64::from(signed(hash(row, 5, 9, self.seed)))
        };
        let (column, along) = split(uv[0] / f64::from(length) + shift);
        let (along, up) = (along as f32, up as f32);
        let seen = resolved(w, length.min(height));
        if seen > 0.0 {
            let h = hash(column, row, 1, self.seed);
            let light = seen * brightness * signed(h);
            let warm = seen * hue * signed(h.wrapping_mul(0x9E37_79B1) ^ (h >> 13));
            let shade = seen * relief * (0.5 - up);
            let gains = [light + warm - shade, light + 0.2 * warm - shade, light - warm - shade, 0.6 * light];
            for (b, g) in below.iter_mut().zip(gains) {
                *b *= (1.0 + g).max(0.0);
            }
        }
        if joint > 0.0 {
            // Half a joint lies on either side of a cell's edge.
            let (ju, jv) = (joint / length, joint / height);
            let a = pulse_coverage(along + 0.5 * ju, w / length, ju);
            let b = pulse_coverage(up + 0.5 * jv, w / height, jv);
            cover(below, &self.colour, self.amount * (1.0 - (1.0 - a) * (1.0 - b)));
        }
    }
}

fn box_coverage(x: f32, w: f32, from: f32, to: f32) -> f32 {
    (step_coverage(x, w, from) - step_coverage(x, w, to)).max(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn layer(pattern: Pattern) -> Material {
        let below = Layer { pattern: Pattern::Fill, colour: [0.2; 4], amount: 1.0, scale: [1.0; 3], seed: 1 };
        let above = Layer { pattern, colour: [0.9, 0.1, 0.5, 0.7], amount: 1.0, scale: [0.24, 0.08, 0.1], seed: 5 };
        Material { layers: vec![below, above], ..Material::default() }
    }

    /// A wide footprint must see the mean of what narrow ones see.
    #[test]
    fn a_wide_footprint_sees_the_mean_of_the_pattern() {
        let plain = [0.01, 0.5, 0.0, 0.0, 0.0, 0.0];
        let [joint, stagger, brightness, hue, relief, wobble] = plain;
        let material = layer(Pattern::Courses { joint, stagger, brightness, hue, relief, wobble });
        let at = |s: f64, t: f64, footprint: f32| {
            let spot = Spot { point: Vector3::zeros(), uv: [s, t], footprint };
            material.reflectance(&spot, &[])[0]
        };
        let n = 400;
        let mean: f32 = (0..n * n)
            .map(|i| at(0.48 * f64::from(i % n) / f64::from(n), 0.16 * f64::from(i / n) / f64::from(n), 0.0))
            .sum::<f32>()
            / (n * n) as f32;
        assert!((at(0.1, 0.1, 4.8) - mean).abs() < 0.01, "{} against {mean}", at(0.1, 0.1, 4.8));
    }

    #[test]
    fn reflectance_is_continuous() {
        let material = layer(Pattern::Quadrants { centre: [0.0, 0.0], radius: 0.1 });
        let mut last: Option<f32> = None;
        for i in 0..2000 {
            let spot = Spot { point: Vector3::zeros(), uv: [-0.12 + 0.000_12 * f64::from(i), 0.02], footprint: 0.004 };
            let value = material.reflectance(&spot, &[])[0];
            if let Some(last) = last {
                assert!((value - last).abs() < 0.03);
            }
            last = Some(value);
        }
    }
}
