//! The picture of a scene: radiance along rays, and pixels as the mean over their area.

use nalgebra::Vector3;
use rayon::prelude::*;

use super::light::Light;
use super::material::Spot;
use super::noise::smoothstep;
use super::rays::{Field, Rays, pixel_angle};
use super::scene::Scene;
use crate::geometry::tangents;

/// Contrast (in roots of radiance) against a neighbour from which an even pixel gets more than one sample. Textures are
/// filtered before they are sampled; what remains are the edges of paintings and cells.
const CONTRAST: f32 = 0.06;

/// What is known of a ray before it is cast.
#[derive(Clone, Copy, Default)]
struct Known {
    /// The primitive that it meets.
    primitive: Option<u32>,
    /// Whether the sun shines there.
    sunny: Option<bool>,
}

/// What a surface shows at a spot: always, and by the sun if the sun reaches it.
#[derive(Clone, Copy)]
struct Shade {
    base: Light,
    sun: Light,
}

impl Shade {
    fn seen(&self, sunny: bool) -> Light {
        if sunny { std::array::from_fn(|k| self.base[k] + self.sun[k]) } else { self.base }
    }

    fn takes_sun(&self) -> bool {
        self.sun.iter().any(|c| *c > 0.0)
    }
}

/// Where a ray first meets a surface.
struct Met {
    distance: f64,
    index: u32,
    point: Vector3<f64>,
    /// Unit normal towards where the ray comes from, and whether that is the surface's front.
    facing: Vector3<f64>,
    front: bool,
}

/// What the ray through a pixel's middle meets.
#[derive(Clone, Copy, PartialEq)]
struct Glance {
    primitive: i32,
    sunny: bool,
}

/// A sample: where it looks and where in its disc the sun is taken.
struct Sample<'a> {
    from: &'a Vector3<f64>,
    ray: &'a Vector3<f64>,
    /// Its width, radians.
    angle: f64,
    sun: &'a Vector3<f64>,
}

impl Scene {
    fn meet(&self, from: &Vector3<f64>, ray: &Vector3<f64>, known: Option<u32>) -> Option<Met> {
        let (distance, index) = known
            .and_then(|index| {
                let primitive = self.primitives.get(index as usize)?;
                Some((primitive.intersect(from, ray, 1e-6, f64::INFINITY)?, index))
            })
            .or_else(|| self.nearest(from, ray, 1e-6, f64::INFINITY))?;
        let point = from + ray * distance;
        let outward = self.primitives[index as usize].normal(&point);
        let front = outward.dot(ray) < 0.0;
        Some(Met { distance, index, point, facing: if front { outward } else { -outward }, front })
    }

    /// Radiance along a ray, and the primitive that it meets (−1 for the sky).
    fn look(&self, sample: &Sample<'_>, known: Known, mirror: bool) -> (Light, i32) {
        let Some(met) = self.meet(sample.from, sample.ray, known.primitive) else {
            return (self.lighting.sky(sample.ray), -1);
        };
        let shade = self.shade(sample, &met, mirror);
        let sunny = shade.takes_sun() && known.sunny.unwrap_or_else(|| self.sunny(&met.point, &met.facing, sample.sun));
        (shade.seen(sunny), met.index as i32)
    }

    fn shade(&self, sample: &Sample<'_>, met: &Met, mirror: bool) -> Shade {
        let primitive = &self.primitives[met.index as usize];
        let material = &self.materials[primitive.material as usize];
        let slant = met.facing.dot(sample.ray).abs();
        // Between the width across and along the view: what is left of aliasing, the samples of the pixel average.
        let footprint = (met.distance * sample.angle / slant.max(0.02).powf(0.6)) as f32;
        let spot = Spot { point: met.point, uv: primitive.surface_coordinates(&met.point), footprint };
        let reflectance = material.reflectance(&spot, &self.paintings);
        let light = self.light_map().at(self, met.index, &met.point, met.front);
        let mut shade =
            Shade { base: std::array::from_fn(|k| reflectance[k] * light[k] + material.emission[k]), sun: [0.0; 3] };
        if self.lighting.sun[1] > 0.0 {
            let tilted = material.tilted(met.facing, &spot);
            let part = sun_taken(&met.facing, &tilted, sample.sun, material.translucency);
            shade.sun = std::array::from_fn(|k| reflectance[k] * part * self.lighting.sun[k]);
        }
        if material.gloss > 0.0 && mirror {
            let part = material.gloss + (1.0 - material.gloss) * (1.0 - slant as f32).max(0.0).powi(5);
            let mirrored = sample.ray - met.facing * (2.0 * met.facing.dot(sample.ray));
            let outside = met.point + met.facing * 1e-5;
            let image = Sample { from: &outside, ray: &mirrored, angle: 4.0 * sample.angle, sun: sample.sun };
            let (image, _) = self.look(&image, Known::default(), false);
            shade.base = std::array::from_fn(|k| shade.base[k] * (1.0 - part) + part * image[k]);
            shade.sun = shade.sun.map(|c| c * (1.0 - part));
        }
        shade
    }

    /// Whether the sun reaches a point, on whichever side of the surface it stands.
    fn sunny(&self, point: &Vector3<f64>, facing: &Vector3<f64>, sun: &Vector3<f64>) -> bool {
        let lit_side = if facing.dot(sun) > 0.0 { *facing } else { -facing };
        self.in_sun(point, &lit_side, sun)
    }

    fn glance(&self, from: &Vector3<f64>, ray: Option<Vector3<f64>>) -> Glance {
        let Some(ray) = ray else {
            return Glance { primitive: -2, sunny: false };
        };
        let Some(met) = self.meet(from, &ray, None) else {
            return Glance { primitive: -1, sunny: false };
        };
        let sun = &self.lighting.sun_direction;
        let material = self.primitives[met.index as usize].material as usize;
        let takes_sun = met.facing.dot(sun) > 0.0 || self.materials[material].translucency > 0.0;
        let sunny = self.lighting.sun[1] > 0.0 && takes_sun && self.sunny(&met.point, &met.facing, sun);
        Glance { primitive: met.index as i32, sunny }
    }

    /// Sun directions spread evenly over its disc.
    fn suns(&self, n: usize) -> Vec<Vector3<f64>> {
        let centre = self.lighting.sun_direction;
        let (across, upward) = tangents(&centre);
        (0..n)
            .map(|i| {
                let radius = self.lighting.sun_radius * ((i as f64 + 0.5) / n as f64).sqrt();
                let (sin, cos) = (2.399_963_229_728_653 * i as f64).sin_cos();
                (centre + (across * cos + upward * sin) * radius).normalize()
            })
            .collect()
    }

    /// Radiance of each pixel of the rows `rows.start..rows.end`, row by row; black where the camera has no picture.
    ///
    /// A pixel whose neighbourhood shows one surface in one light takes one sample, or a few where its colour differs from a
    /// neighbour's; any other is the mean over its area of `samples` (rounded up to a power of two). The samples lie
    /// symmetrically about the pixel's centre, no two in one row or column, so that edges do not shift.
    pub fn picture(
        &self,
        from: &Vector3<f64>,
        rays: &impl Rays,
        width: usize,
        rows: std::ops::Range<usize>,
        samples: usize,
    ) -> Vec<Light> {
        self.light_map();
        let (one, few, many) = (
            Pattern::new(self, 1, 1.0),
            Pattern::new(self, samples.div_ceil(4), 0.6),
            Pattern::new(self, samples, 0.6),
        );
        // Rows beyond the edges too: a pixel is judged by its neighbours, whatever rows are asked for.
        let outer = Band::new(width, rows.start.saturating_sub(2)..rows.end + 2);
        let inner = Band::new(width, rows.start.saturating_sub(1)..rows.end + 1);
        let field = Field::new(rays, width, outer.rows.clone());
        let glances = outer.map(|x, y| self.glance(from, field.block(x, y).ray(rays, x as f64, y as f64)));
        let first = inner.map(|x, y| {
            let here = glances[outer.index(x, y)];
            if outer.neighbours(x, y).all(|i| glances[i] == here) {
                let known = Known { primitive: u32::try_from(here.primitive).ok(), sunny: Some(here.sunny) };
                (self.even_pixel(from, &field, (x, y), &one, known), Some(known))
            } else {
                let around = outer.neighbours(x, y).map(|i| glances[i]).chain([here]);
                (self.edge_pixel(from, &field, (x, y), &many, around), None)
            }
        });
        Band::new(width, rows).map(|x, y| {
            let (light, known) = &first[inner.index(x, y)];
            let edge = inner.neighbours(x, y).any(|i| contrast(&first[i].0, light) > CONTRAST);
            match known {
                Some(known) if edge => self.even_pixel(from, &field, (x, y), &few, *known),
                _ => *light,
            }
        })
    }

    /// A pixel of one surface in one light.
    fn even_pixel<R: Rays>(
        &self,
        from: &Vector3<f64>,
        field: &Field<'_, R>,
        (x, y): (usize, usize),
        pattern: &Pattern,
        known: Known,
    ) -> Light {
        let block = field.block(x, y);
        let mut sum = [0.0_f32; 3];
        for (offset, sun) in pattern.offsets.iter().zip(&pattern.suns) {
            if let Some(ray) = block.ray(field.rays, x as f64 + offset[0], y as f64 + offset[1]) {
                let sample = Sample { from, ray: &ray, angle: pattern.width * block.angle, sun };
                let (light, _) = self.look(&sample, known, true);
                sum = std::array::from_fn(|k| sum[k] + light[k]);
            }
        }
        sum.map(|s| s / pattern.offsets.len() as f32)
    }

    /// A pixel across edges. Every sample is cast; what a surface looks like is worked out once in each quarter of the
    /// pixel, and its shadow only where the glances around do not agree on it.
    fn edge_pixel<R: Rays>(
        &self,
        from: &Vector3<f64>,
        field: &Field<'_, R>,
        (x, y): (usize, usize),
        pattern: &Pattern,
        around: impl Iterator<Item = Glance>,
    ) -> Light {
        let block = field.block(x, y);
        let around: Vec<Glance> = around.collect();
        let agreed = |index: u32| {
            let mut same = around.iter().filter(|g| g.primitive == index as i32);
            let first = same.next()?;
            let (agreeing, others) = same.fold((1, 0), |(a, o), g| if g == first { (a + 1, o) } else { (a, o + 1) });
            (others == 0 && agreeing >= 3).then_some(first.sunny)
        };
        let mut shades: Vec<(u32, bool, bool, Shade)> = Vec::with_capacity(8);
        let mut sum = [0.0_f32; 3];
        for (offset, sun) in pattern.offsets.iter().zip(&pattern.suns) {
            // What the camera cannot see counts as black, so that the border of its field is smooth too.
            let Some(ray) = block.ray(field.rays, x as f64 + offset[0], y as f64 + offset[1]) else {
                continue;
            };
            let light = match self.meet(from, &ray, None) {
                None => self.lighting.sky(&ray),
                Some(met) => {
                    let (right, low) = (offset[0] > 0.0, offset[1] > 0.0);
                    let sample = Sample { from, ray: &ray, angle: pattern.width * block.angle, sun };
                    let known = shades.iter().find(|s| (s.0, s.1, s.2) == (met.index, right, low));
                    let shade = known.map(|s| s.3).unwrap_or_else(|| {
                        let shade = self.shade(&sample, &met, true);
                        shades.push((met.index, right, low, shade));
                        shade
                    });
                    let sunny = shade.takes_sun()
                        && agreed(met.index).unwrap_or_else(|| self.sunny(&met.point, &met.facing, sun));
                    shade.seen(sunny)
                }
            };
            sum = std::array::from_fn(|k| sum[k] + light[k]);
        }
        sum.map(|s| s / pattern.offsets.len() as f32)
    }

    /// Radiance at points of the picture as a lens with a Gaussian spot of `sigma` pixels on square pixels would show it.
    ///
    /// With `own_surface` only the primitive that the ray through the point itself meets counts: the colour of that
    /// surface up to its very edge, without the foreground or background beyond. NaN where there is no picture.
    pub fn radiance_at(
        &self,
        from: &Vector3<f64>,
        rays: &impl Rays,
        points: &[[f64; 2]],
        sigma: f64,
        own_surface: bool,
    ) -> Vec<Light> {
        self.light_map();
        // The medians of the normal distribution's quarters: four by four samples of equal weight.
        let spread = (sigma * sigma + 1.0 / 12.0).sqrt();
        let nodes = [-1.1503, -0.3186, 0.3186, 1.1503].map(|q: f64| q * spread);
        let suns = self.suns(16);
        points
            .par_iter()
            .with_min_len(64)
            .map(|&[x, y]| {
                let Some(middle) = rays(x, y) else {
                    return [f32::NAN; 3];
                };
                let own = self.glance(from, Some(middle));
                let angle = 0.5 * pixel_angle(rays, x, y);
                let mut known = Known::default();
                if own_surface {
                    known.primitive = u32::try_from(own.primitive).ok();
                    let corners = [(0, 0), (0, 3), (3, 0), (3, 3)].map(|(i, j)| rays(x + nodes[i], y + nodes[j]));
                    let even = corners.iter().all(|ray| self.glance(from, *ray) == own);
                    known.sunny = even.then_some(own.sunny);
                }
                let (mut sum, mut count) = ([0.0_f32; 3], 0.0);
                for (k, sun) in suns.iter().enumerate() {
                    let Some(ray) = rays(x + nodes[k % 4], y + nodes[k / 4]) else { continue };
                    let (light, met) = self.look(&Sample { from, ray: &ray, angle, sun }, known, true);
                    if !own_surface || met == own.primitive {
                        sum = std::array::from_fn(|c| sum[c] + light[c]);
                        count += 1.0;
                    }
                }
                if count == 0.0 {
                    // A surface so small that only the middle meets it.
                    return self.look(&Sample { from, ray: &middle, angle, sun: &suns[0] }, known, true).0;
                }
                sum.map(|s| s / count)
            })
            .collect()
    }
}

/// The part of the sun's light that a surface takes if the sun reaches it: by its front, or through it from behind.
fn sun_taken(facing: &Vector3<f64>, tilted: &Vector3<f64>, sun: &Vector3<f64>, translucency: f32) -> f32 {
    let geometric = facing.dot(sun) as f32;
    if geometric > 0.0 {
        tilted.dot(sun).max(0.0) as f32 * smoothstep(0.0, 0.03, geometric)
    } else {
        translucency * -geometric
    }
}

/// Some rows of a picture.
struct Band {
    width: usize,
    rows: std::ops::Range<usize>,
}

impl Band {
    fn new(width: usize, rows: std::ops::Range<usize>) -> Self {
        Self { width, rows }
    }

    fn index(&self, x: usize, y: usize) -> usize {
        (y - self.rows.start) * self.width + x
    }

    /// What `f` says of every pixel, row by row.
    fn map<T: Send>(&self, f: impl Fn(usize, usize) -> T + Sync + Send) -> Vec<T> {
        (0..self.rows.len() * self.width)
            .into_par_iter()
            .with_min_len(64)
            .map(|i| f(i % self.width, self.rows.start + i / self.width))
            .collect()
    }

    /// The indices of the up to eight neighbours of a pixel.
    fn neighbours(&self, x: usize, y: usize) -> impl Iterator<Item = usize> {
        let rows = y.saturating_sub(1).max(self.rows.start)..(y + 2).min(self.rows.end);
        let columns = x.saturating_sub(1)..(x + 2).min(self.width);
        rows.flat_map(move |b| columns.clone().map(move |a| (a, b)))
            .filter(move |&at| at != (x, y))
            .map(|(a, b)| self.index(a, b))
    }
}

/// Difference in roots of radiance, about what the eye and the coded picture see.
fn contrast(a: &Light, b: &Light) -> f32 {
    (0..3).map(|k| (a[k].max(0.0).sqrt() - b[k].max(0.0).sqrt()).abs()).fold(0.0, f32::max)
}

/// Where in a pixel, and in the sun, samples are taken.
struct Pattern {
    offsets: Vec<[f64; 2]>,
    suns: Vec<Vector3<f64>>,
    /// Width of a sample in pixels.
    width: f64,
}

impl Pattern {
    /// `n` samples, rounded up to a power of two, each `width` pixels wide: wider than their spacing, as the texture is
    /// filtered and the samples only have to agree.
    fn new(scene: &Scene, n: usize, width: f64) -> Self {
        let n = n.next_power_of_two();
        Self { offsets: offsets(n), suns: scene.suns(n), width }
    }
}

/// `n` points (a power of two) of a (0, 2)-net in [−½, ½]², point-symmetric about the centre.
fn offsets(n: usize) -> Vec<[f64; 2]> {
    let bits = n.trailing_zeros();
    (0..n)
        .map(|i| {
            let reversed = if bits == 0 { 0 } else { (i as u32).reverse_bits() >> (32 - bits) };
            [(i as f64 + 0.5) / n as f64 - 0.5, (f64::from(reversed) + 0.5) / n as f64 - 0.5]
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_are_symmetric_and_fill_rows_and_columns() {
        for n in [4usize, 16, 64] {
            let bits = n.trailing_zeros();
            let offsets = offsets(n);
            let sum = offsets.iter().fold([0.0, 0.0], |s, o| [s[0] + o[0], s[1] + o[1]]);
            assert!(sum[0].abs() < 1e-12 && sum[1].abs() < 1e-12);
            for axis in 0..2 {
                let mut cells: Vec<usize> = offsets.iter().map(|o| ((o[axis] + 0.5) * n as f64) as usize).collect();
                cells.sort_unstable();
                assert_eq!(cells, (0..n).collect::<Vec<_>>(), "{bits} bits, axis {axis}");
            }
        }
    }
}
