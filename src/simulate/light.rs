//! Where light comes from: sun, sky with clouds, and what the surfaces send on to one another.
//!
//! All light is in units of the radiance of a white matt surface: a surface of reflectance ρ under irradiance E shows ρE.
//! What comes from the sky, from lamps and from other surfaces varies slowly; it is gathered once on a grid over each
//! primitive (a light map) and interpolated. The sun is sharp and is traced for every sample.

use nalgebra::Vector3;
use rayon::prelude::*;

use super::material::Spot;
use super::noise::{fractal, smoothstep, split};
use super::scene::Scene;
use super::shape::Outline;

/// Linear red, green, blue.
pub type Light = [f32; 3];

/// The sun and the sky.
#[derive(Clone, Debug)]
pub struct Lighting {
    /// Unit vector towards the sun.
    pub sun_direction: Vector3<f64>,
    /// What a white surface that faces the sun shows by it; 0 for none.
    pub sun: Light,
    /// Angular radius of the sun's disc, radians.
    pub sun_radius: f64,
    /// Radiance of the sky overhead, at the horizon, and of what lies below it.
    pub zenith: Light,
    /// See `zenith`.
    pub horizon: Light,
    /// See `zenith`.
    pub ground: Light,
    /// Cloud cover, 0 to 1.
    pub clouds: f32,
    /// Seed of the clouds.
    pub seed: u32,
    /// Spacing of the light map, metres, and directions gathered at each of its nodes.
    pub map_spacing: f64,
    /// See `map_spacing`.
    pub map_directions: usize,
    /// How often light is passed on between surfaces.
    pub bounces: usize,
}

impl Lighting {
    /// Radiance of the sky in a direction (a unit vector).
    pub fn sky(&self, direction: &Vector3<f64>) -> Light {
        self.wide_sky(direction, 0.002)
    }

    /// The same under a footprint of `width` radians: coarse clouds will do for light that is gathered.
    fn wide_sky(&self, direction: &Vector3<f64>, width: f32) -> Light {
        let up = direction.z as f32;
        if up < 0.0 {
            let t = smoothstep(0.0, 0.06, -up);
            return blend(self.horizon, self.ground, t);
        }
        let mut colour = blend(self.horizon, self.zenith, 1.0 - (1.0 - up).powi(4));
        let towards_sun = direction.dot(&self.sun_direction).max(0.0) as f32;
        if self.sun.iter().any(|c| *c > 0.0) {
            let glow = 0.25 * towards_sun.powi(24) + 0.12 * towards_sun.powi(4);
            colour = std::array::from_fn(|i| colour[i] + glow * 0.12 * self.sun[i]);
        }
        if self.clouds > 0.0 {
            let reach = 1.0 / (direction.z + 0.12);
            let p = [direction.x * reach * 0.9, direction.y * reach * 0.9, f64::from(self.seed % 97)];
            let density = fractal(p, width, 7, 0.55, self.seed) * 0.7 + 0.5;
            let cover = smoothstep(1.0 - self.clouds, 1.45 - self.clouds, density);
            let bright = 0.25 * (self.zenith.iter().sum::<f32>()) + 0.34 * self.sun.iter().sum::<f32>() / 3.0;
            let lit = bright * (1.1 - 0.35 * smoothstep(0.5, 1.1, density)) * (1.0 + 0.25 * towards_sun.powi(8));
            let haze = smoothstep(0.02, 0.22, up);
            colour = blend(colour, [lit, lit, 1.03 * lit], 0.9 * cover * haze);
        }
        colour
    }
}

fn blend(a: Light, b: Light, t: f32) -> Light {
    std::array::from_fn(|i| a[i] + t * (b[i] - a[i]))
}

/// Irradiance (in units of white radiance) over every primitive, on both sides where both are seen.
#[derive(Clone, Debug)]
pub struct LightMap {
    grids: Vec<Grid>,
    values: Vec<Light>,
}

#[derive(Clone, Copy, Debug)]
struct Grid {
    start: usize,
    size: [usize; 2],
    two_sided: bool,
}

/// Directions over the hemisphere about +z with cosine-weighted density: a Hammersley set, the same for every node, so
/// that neighbouring nodes see the same occluders and the map stays smooth.
fn hemisphere(n: usize) -> Vec<Vector3<f64>> {
    (0..n)
        .map(|i| {
            let a = (i as f64 + 0.5) / n as f64;
            let b = f64::from((i as u32).reverse_bits()) / 4_294_967_296.0;
            let (radius, angle) = (a.sqrt(), std::f64::consts::TAU * b);
            Vector3::new(radius * angle.cos(), radius * angle.sin(), (1.0 - a).sqrt())
        })
        .collect()
}

/// Two unit vectors across `normal`.
fn tangents(normal: &Vector3<f64>) -> (Vector3<f64>, Vector3<f64>) {
    let helper = if normal.z.abs() > 0.9 { Vector3::x() } else { Vector3::z() };
    let across = helper.cross(normal).normalize();
    (across, normal.cross(&across))
}

impl LightMap {
    /// Gathers the light of a scene.
    pub fn bake(scene: &Scene) -> Self {
        let lighting = &scene.lighting;
        let mut total = 0;
        let grids: Vec<Grid> = scene
            .primitives
            .iter()
            .map(|p| {
                let size = p.grid_size(lighting.map_spacing, 96);
                let material = &scene.materials[p.material as usize];
                let two_sided = p.outline == Outline::Leaf || material.translucency > 0.0;
                let grid = Grid { start: total, size, two_sided };
                total += size[0] * size[1] * if two_sided { 2 } else { 1 };
                grid
            })
            .collect();
        // The first guess of what the surfaces pass on: a part of the sky's mean.
        let guess = if lighting.bounces > 0 { 0.0 } else { 0.3 };
        let sky = lighting.sky(&Vector3::new(0.6, 0.0, 0.8));
        let mut map = Self { grids, values: vec![sky.map(|c| guess * c); total] };
        for bounce in 0..=lighting.bounces {
            let last = bounce == lighting.bounces;
            let count = if last { lighting.map_directions } else { lighting.map_directions.div_ceil(2) };
            let directions = hemisphere(count);
            let pieces: Vec<Vec<Light>> = (0..map.grids.len())
                .into_par_iter()
                .with_min_len(8)
                .map(|i| map.gather(scene, i, &directions))
                .collect();
            map.values = pieces.concat();
        }
        map
    }

    fn gather(&self, scene: &Scene, index: usize, directions: &[Vector3<f64>]) -> Vec<Light> {
        let (grid, primitive) = (self.grids[index], &scene.primitives[index]);
        let directions =
            if primitive.outline == Outline::Leaf { &directions[..directions.len().min(24)] } else { directions };
        let mut out = Vec::with_capacity(2 * grid.size[0] * grid.size[1]);
        for side in 0..if grid.two_sided { 2 } else { 1 } {
            for j in 0..grid.size[1] {
                for i in 0..grid.size[0] {
                    let g = [(i as f64 + 0.5) / grid.size[0] as f64, (j as f64 + 0.5) / grid.size[1] as f64];
                    let point = primitive.grid_point(g);
                    let normal = primitive.normal(&point) * if side == 0 { 1.0 } else { -1.0 };
                    let (a, b) = tangents(&normal);
                    let from = point + normal * 1e-4;
                    let mut sum = [0.0_f32; 3];
                    for d in directions {
                        let ray = a * d.x + b * d.y + normal * d.z;
                        let light = self.arriving(scene, &from, &ray);
                        sum = std::array::from_fn(|k| sum[k] + light[k]);
                    }
                    out.push(sum.map(|s| s / directions.len() as f32));
                }
            }
        }
        out
    }

    /// What arrives at `from` out of the direction `ray` by way of sky, lamps and lit surfaces.
    fn arriving(&self, scene: &Scene, from: &Vector3<f64>, ray: &Vector3<f64>) -> Light {
        let Some((t, index)) = scene.nearest(from, ray, 1e-6, f64::INFINITY) else {
            return scene.lighting.wide_sky(ray, 0.3);
        };
        let (primitive, point) = (&scene.primitives[index as usize], from + ray * t);
        let material = &scene.materials[primitive.material as usize];
        let normal = primitive.normal(&point);
        let front = normal.dot(ray) < 0.0;
        if !front && !self.grids[index as usize].two_sided {
            // The inside of a solid, where the grid's node is buried in another one.
            return [0.0; 3];
        }
        let facing = if front { normal } else { -normal };
        let spot = Spot { point, uv: primitive.surface_coordinates(&point), footprint: 0.3 };
        let reflectance = material.reflectance(&spot, &scene.paintings);
        let mut light = self.at(scene, index, &point, front);
        let slant = facing.dot(&scene.lighting.sun_direction);
        if slant > 0.0 && scene.lighting.sun[1] > 0.0 && scene.in_sun(&point, &facing, &scene.lighting.sun_direction) {
            light = std::array::from_fn(|k| light[k] + slant as f32 * scene.lighting.sun[k]);
        }
        std::array::from_fn(|k| reflectance[k] * light[k] + material.emission[k])
    }

    /// The light at a point of a primitive, interpolated between the nodes of its grid.
    pub fn at(&self, scene: &Scene, index: u32, point: &Vector3<f64>, front: bool) -> Light {
        let (grid, primitive) = (&self.grids[index as usize], &scene.primitives[index as usize]);
        let start = grid.start + if front || !grid.two_sided { 0 } else { grid.size[0] * grid.size[1] };
        let g = primitive.grid_coordinates(point);
        let place = |g: f64, n: usize, round: bool| {
            let (whole, part) = split(g * n as f64 - 0.5);
            let wrap = |i: i32| {
                if round { i.rem_euclid(n as i32) as usize } else { (i.max(0) as usize).min(n - 1) }
            };
            (wrap(whole), wrap(whole + 1), part as f32)
        };
        let (i0, i1, a) = place(g[0], grid.size[0], primitive.is_round());
        let (j0, j1, b) = place(g[1], grid.size[1], false);
        let node = |i: usize, j: usize| self.values[start + j * grid.size[0] + i];
        blend(blend(node(i0, j0), node(i1, j0), a), blend(node(i0, j1), node(i1, j1), a), b)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn directions_are_weighted_by_the_cosine() {
        let directions = hemisphere(512);
        let mean = directions.iter().map(|d| d.z).sum::<f64>() / 512.0;
        assert!((mean - 2.0 / 3.0).abs() < 1e-3, "mean cosine {mean}");
        let aside: Vector3<f64> = directions.iter().sum::<Vector3<f64>>() / 512.0;
        assert!(aside.x.abs() < 5e-3 && aside.y.abs() < 5e-3);
    }
}
