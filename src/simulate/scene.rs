//! A scene: primitives, what they are made of, and what lights them.

use std::sync::OnceLock;

use nalgebra::Vector3;
use rayon::prelude::*;

use super::bvh::Bvh;
use super::image::Painting;
use super::light::{LightMap, Lighting, lamps};
use super::material::{Material, Reflectance, Spot};
use super::shape::Primitive;

/// A scene that rays can be cast into.
#[derive(Debug)]
pub struct Scene {
    pub(super) primitives: Vec<Primitive>,
    pub(super) materials: Vec<Material>,
    pub(super) paintings: Vec<Painting>,
    pub(super) lighting: Lighting,
    pub(super) lamps: Vec<u32>,
    tree: Bvh,
    light_map: OnceLock<LightMap>,
}

/// Where a ray first meets the scene.
#[derive(Clone, Copy, Debug)]
pub struct Hit {
    /// Distance along the ray in units of its length; infinite where it meets nothing.
    pub distance: f64,
    /// Number of the primitive, −1 for none.
    pub primitive: i32,
    /// Unit normal on the side that the ray comes from; zero for none.
    pub normal: Vector3<f64>,
}

impl Hit {
    const NONE: Self = Self { distance: f64::INFINITY, primitive: -1, normal: Vector3::new(0.0, 0.0, 0.0) };
}

impl Scene {
    /// The scene of these parts. Every primitive's material must be among `materials`.
    pub fn new(
        primitives: Vec<Primitive>,
        materials: Vec<Material>,
        paintings: Vec<Painting>,
        lighting: Lighting,
    ) -> Self {
        let tree = Bvh::new(&primitives);
        let mut scene =
            Self { primitives, materials, paintings, lighting, lamps: Vec::new(), tree, light_map: OnceLock::new() };
        scene.lamps = lamps(&scene);
        scene
    }

    /// How many primitives it has.
    pub fn len(&self) -> usize {
        self.primitives.len()
    }

    /// Whether it has none.
    pub fn is_empty(&self) -> bool {
        self.primitives.is_empty()
    }

    /// The gathered light; worked out at the first call.
    pub fn light_map(&self) -> &LightMap {
        self.light_map.get_or_init(|| LightMap::bake(self))
    }

    #[inline]
    pub(super) fn nearest(&self, from: &Vector3<f64>, ray: &Vector3<f64>, near: f64, far: f64) -> Option<(f64, u32)> {
        self.tree.nearest(&self.primitives, from, ray, near, far)
    }

    #[inline]
    pub(super) fn blocked(&self, from: &Vector3<f64>, ray: &Vector3<f64>, near: f64, far: f64) -> bool {
        self.tree.blocked(&self.primitives, from, ray, near, far)
    }

    /// Whether the sun shines on a point, `facing` being the unit normal on its lit side.
    #[inline]
    pub(super) fn in_sun(&self, point: &Vector3<f64>, facing: &Vector3<f64>, sun: &Vector3<f64>) -> bool {
        let from = point + facing * 1e-5;
        !self.tree.blocked(&self.primitives, &from, sun, 1e-6, f64::INFINITY)
    }

    /// The first hit of each ray from one point.
    pub fn cast(&self, from: &Vector3<f64>, rays: &[[f64; 3]]) -> Vec<Hit> {
        rays.par_iter()
            .with_min_len(1024)
            .map(|ray| {
                let ray = Vector3::from(*ray);
                // A ray that is not a number meets nothing.
                if !ray.iter().all(|c| c.is_finite()) {
                    return Hit::NONE;
                }
                let Some((t, index)) = self.nearest(from, &ray, 1e-9, f64::INFINITY) else {
                    return Hit::NONE;
                };
                let normal = self.primitives[index as usize].normal(&(from + ray * t));
                let normal = if normal.dot(&ray) > 0.0 { -normal } else { normal };
                Hit { distance: t, primitive: index as i32, normal }
            })
            .collect()
    }

    /// Whether nothing stands between each point and `from`, but for the last `tolerance` metres before the point.
    pub fn sees(&self, from: &Vector3<f64>, points: &[[f64; 3]], tolerance: f64) -> Vec<bool> {
        points
            .par_iter()
            .with_min_len(1024)
            .map(|point| {
                let ray = Vector3::from(*point) - from;
                let length = ray.norm();
                length.is_finite()
                    && length > tolerance
                    && !self.tree.blocked(&self.primitives, from, &ray, 1e-9, 1.0 - tolerance / length)
            })
            .collect()
    }

    /// The reflectance at points of primitives under footprints (metres); grey 0 where the primitive is −1.
    pub fn reflectance(&self, points: &[[f64; 3]], primitives: &[i32], footprints: &[f64]) -> Vec<Reflectance> {
        points
            .par_iter()
            .zip(primitives)
            .zip(footprints)
            .with_min_len(1024)
            .map(|((point, &index), &footprint)| {
                let Some(primitive) = usize::try_from(index).ok().and_then(|i| self.primitives.get(i)) else {
                    return [0.0; 4];
                };
                let point = Vector3::from(*point);
                let spot = Spot { point, uv: primitive.surface_coordinates(&point), footprint: footprint as f32 };
                self.materials[primitive.material as usize].reflectance(&spot, &self.paintings)
            })
            .collect()
    }
}
