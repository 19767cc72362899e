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
use crate::geometry::tangents;

/// Cells of a light map along one side of a primitive, at most.
const MOST_CELLS: usize = 36;
/// Directions that a single leaf gathers light from.
const LEAF_DIRECTIONS: usize = 16;

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
    round: bool,
    two_sided: bool,
}

impl Grid {
    fn sides(&self) -> usize {
        if self.two_sided { 2 } else { 1 }
    }

    /// Grid coordinates of a node. The outermost nodes lie just inside the edges, so that patches of one wall that meet
    /// there agree, and yet no node lies within what stands at the edge.
    fn node(&self, i: usize, axis: usize, length: f64) -> f64 {
        let n = self.size[axis];
        if n == 1 {
            0.5
        } else if self.round && axis == 0 {
            i as f64 / n as f64
        } else {
            let inset = (0.02 / length).min(0.1);
            (i as f64 / (n - 1) as f64).clamp(inset, 1.0 - inset)
        }
    }

    /// The two nodes on either side of a grid coordinate, and the weight of the second.
    #[inline]
    fn between(&self, g: f64, axis: usize) -> (usize, usize, f32) {
        let n = self.size[axis];
        if self.round && axis == 0 {
            let (whole, part) = split(g * n as f64);
            let wrap = |i: i32| i.rem_euclid(n as i32) as usize;
            (wrap(whole), wrap(whole + 1), part as f32)
        } else {
            let (whole, part) = split(g.clamp(0.0, 1.0) * (n - 1) as f64);
            let first = (whole as usize).min(n - 1);
            (first, (first + 1).min(n - 1), part as f32)
        }
    }
}

/// What a node gathered; `buried` if it lies within or right behind something else, where nobody sees it but its
/// neighbours would be darkened by it.
#[derive(Clone, Copy)]
struct Node {
    light: Light,
    buried: bool,
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

impl LightMap {
    /// Gathers the light of a scene.
    pub fn bake(scene: &Scene) -> Self {
        let lighting = &scene.lighting;
        let mut total = 0;
        let grids: Vec<Grid> = scene
            .primitives
            .iter()
            .map(|p| {
                let size = p.grid_size(lighting.map_spacing, MOST_CELLS);
                let material = &scene.materials[p.material as usize];
                let two_sided = p.outline == Outline::Leaf || material.translucency > 0.0;
                let grid = Grid { start: total, size, round: p.is_round(), two_sided };
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
            let (directions, few) = (hemisphere(count), hemisphere(count.min(LEAF_DIRECTIONS)));
            let pieces: Vec<Vec<Light>> = (0..map.grids.len())
                .into_par_iter()
                .with_min_len(8)
                .map(|i| {
                    let leaf = scene.primitives[i].outline == Outline::Leaf;
                    map.gather(scene, i, if leaf { &few } else { &directions })
                })
                .collect();
            map.values = pieces.concat();
        }
        map
    }

    fn gather(&self, scene: &Scene, index: usize, directions: &[Vector3<f64>]) -> Vec<Light> {
        let (grid, primitive) = (self.grids[index], &scene.primitives[index]);
        let lengths = primitive.grid_lengths();
        let mut out = Vec::with_capacity(grid.sides() * grid.size[0] * grid.size[1]);
        for side in 0..grid.sides() {
            let mut nodes = Vec::with_capacity(grid.size[0] * grid.size[1]);
            for j in 0..grid.size[1] {
                for i in 0..grid.size[0] {
                    let point = primitive.grid_point([grid.node(i, 0, lengths[0]), grid.node(j, 1, lengths[1])]);
                    let normal = primitive.normal(&point) * if side == 0 { 1.0 } else { -1.0 };
                    nodes.push(self.node(scene, &point, &normal, directions));
                }
            }
            settle(&mut nodes, grid.size);
            out.extend(nodes.iter().map(|node| node.light));
        }
        out
    }

    fn node(&self, scene: &Scene, point: &Vector3<f64>, normal: &Vector3<f64>, directions: &[Vector3<f64>]) -> Node {
        let (a, b) = tangents(normal);
        let from = point + normal * 1e-4;
        let mut sum = [0.0_f32; 3];
        let mut covered = 0;
        for d in directions {
            let (light, cover) = self.arriving(scene, &from, &(a * d.x + b * d.y + normal * d.z));
            sum = std::array::from_fn(|k| sum[k] + light[k]);
            covered += usize::from(cover);
        }
        let lamps = from_lamps(scene, &from, normal);
        let light = std::array::from_fn(|k| sum[k] / directions.len() as f32 + lamps[k]);
        Node { light, buried: 10 * covered > 7 * directions.len() }
    }

    /// What arrives at `from` out of the direction `ray` by way of sky and lit surfaces, and whether the ray ends within a
    /// solid or right at the start. Lamps of which [`from_lamps`] tells are left out.
    fn arriving(&self, scene: &Scene, from: &Vector3<f64>, ray: &Vector3<f64>) -> (Light, bool) {
        let Some((t, index)) = scene.nearest(from, ray, 1e-6, f64::INFINITY) else {
            return (scene.lighting.wide_sky(ray, 0.3), false);
        };
        let (primitive, point) = (&scene.primitives[index as usize], from + ray * t);
        let material = &scene.materials[primitive.material as usize];
        let normal = primitive.normal(&point);
        let front = normal.dot(ray) < 0.0;
        if !front && !self.grids[index as usize].two_sided {
            return ([0.0; 3], true);
        }
        let facing = if front { normal } else { -normal };
        let spot = Spot { point, uv: primitive.surface_coordinates(&point), footprint: 0.3 };
        let reflectance = material.reflectance(&spot, &scene.paintings);
        let mut light = self.at(scene, index, &point, front);
        let slant = facing.dot(&scene.lighting.sun_direction);
        if slant > 0.0 && scene.lighting.sun[1] > 0.0 && scene.in_sun(&point, &facing, &scene.lighting.sun_direction) {
            light = std::array::from_fn(|k| light[k] + slant as f32 * scene.lighting.sun[k]);
        }
        let emission = if is_lamp(scene, index) { [0.0; 3] } else { material.emission };
        (std::array::from_fn(|k| reflectance[k] * light[k] + emission[k]), t < 0.02)
    }

    /// The light at a point of a primitive, interpolated between the nodes of its grid.
    pub fn at(&self, scene: &Scene, index: u32, point: &Vector3<f64>, front: bool) -> Light {
        let (grid, primitive) = (&self.grids[index as usize], &scene.primitives[index as usize]);
        let start = grid.start + if front || !grid.two_sided { 0 } else { grid.size[0] * grid.size[1] };
        let g = primitive.grid_coordinates(point);
        let ((i0, i1, a), (j0, j1, b)) = (grid.between(g[0], 0), grid.between(g[1], 1));
        let node = |i: usize, j: usize| self.values[start + j * grid.size[0] + i];
        blend(blend(node(i0, j0), node(i1, j0), a), blend(node(i0, j1), node(i1, j1), a), b)
    }
}

/// Gives buried nodes the mean of their neighbours, from the open ones inwards. Where all are buried, they stay dark.
fn settle(nodes: &mut [Node], size: [usize; 2]) {
    for _ in 0..size[0].max(size[1]) {
        if !nodes.iter().any(|n| n.buried) {
            return;
        }
        let before = nodes.to_vec();
        for j in 0..size[1] {
            for i in 0..size[0] {
                if !before[j * size[0] + i].buried {
                    continue;
                }
                let (mut sum, mut count) = ([0.0_f32; 3], 0.0);
                for b in j.saturating_sub(1)..(j + 2).min(size[1]) {
                    for a in i.saturating_sub(1)..(i + 2).min(size[0]) {
                        let near = &before[b * size[0] + a];
                        if !near.buried {
                            sum = std::array::from_fn(|k| sum[k] + near.light[k]);
                            count += 1.0;
                        }
                    }
                }
                if count > 0.0 {
                    nodes[j * size[0] + i] = Node { light: sum.map(|s| s / count), buried: false };
                }
            }
        }
    }
}

fn is_lamp(scene: &Scene, index: u32) -> bool {
    let primitive = &scene.primitives[index as usize];
    primitive.outline == Outline::Parallelogram && scene.materials[primitive.material as usize].emission[1] > 0.0
}

/// Irradiance from the flat lamps: they are small and strong, so they are looked at themselves rather than left to chance.
fn from_lamps(scene: &Scene, from: &Vector3<f64>, normal: &Vector3<f64>) -> Light {
    const SIDE: usize = 6;
    let mut sum = [0.0_f32; 3];
    for &index in &scene.lamps {
        let lamp = &scene.primitives[index as usize];
        let emission = scene.materials[lamp.material as usize].emission;
        let area = lamp.u.cross(&lamp.v).norm();
        let mut part = 0.0;
        for k in 0..SIDE * SIDE {
            let g = [((k % SIDE) as f64 + 0.5) / SIDE as f64, ((k / SIDE) as f64 + 0.5) / SIDE as f64];
            let point = lamp.grid_point(g);
            let way = point - from;
            let r2 = way.norm_squared();
            let cosines = way.dot(normal) * -way.dot(&lamp.normal(&point)) / r2;
            if way.dot(normal) > 0.0 && cosines > 0.0 && !scene.blocked(from, &way, 1e-6, 1.0 - 1e-4) {
                part += cosines * area / (std::f64::consts::PI * r2);
            }
        }
        let part = (part / (SIDE * SIDE) as f64) as f32;
        sum = std::array::from_fn(|k| sum[k] + part * emission[k]);
    }
    sum
}

/// The numbers of the scene's flat lamps.
pub(super) fn lamps(scene: &Scene) -> Vec<u32> {
    (0..scene.primitives.len() as u32).filter(|&index| is_lamp(scene, index)).collect()
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
