//! A scene from tables of numbers, as a caller in another language hands it over; every entry is checked here.

use nalgebra::Vector3;

use super::image::Painting;
use super::light::Lighting;
use super::material::{Layer, Material, Pattern};
use super::scene::Scene;
use super::shape::{Outline, Primitive};
use crate::error::{Error, Result};

/// outline, origin (3), u (3), v (3), surface coordinates of the origin (2).
pub const PRIMITIVE_COLUMNS: usize = 12;
/// pattern, colour (4), amount, scale (3), seed, parameters (6).
pub const LAYER_COLUMNS: usize = 16;
/// number of layers, gloss, translucency, relief height and wavelength, emission (3).
pub const MATERIAL_COLUMNS: usize = 8;
/// sun direction (3), sun (3), sun radius, zenith (3), horizon (3), ground (3), clouds, seed, map spacing, map directions,
/// bounces.
pub const LIGHTING_COLUMNS: usize = 21;

/// The tables of a scene.
#[derive(Clone, Copy, Debug)]
pub struct Tables<'a> {
    /// One row for each primitive.
    pub primitives: &'a [[f64; PRIMITIVE_COLUMNS]],
    /// Its material.
    pub primitive_materials: &'a [i64],
    /// One row for each material; its layers follow those of the material before.
    pub materials: &'a [[f64; MATERIAL_COLUMNS]],
    /// One row for each layer.
    pub layers: &'a [[f64; LAYER_COLUMNS]],
    /// Sun and sky.
    pub lighting: &'a [f64; LIGHTING_COLUMNS],
}

impl Tables<'_> {
    /// The scene that the tables describe.
    pub fn scene(&self, paintings: Vec<Painting>) -> Result<Scene> {
        let materials = self.materials(paintings.len())?;
        if self.primitives.len() != self.primitive_materials.len() {
            return Err(Error::invalid(format!(
                "{} primitives, but {} materials given for them",
                self.primitives.len(),
                self.primitive_materials.len()
            )));
        }
        let mut primitives = Vec::with_capacity(self.primitives.len());
        for (i, (row, &material)) in self.primitives.iter().zip(self.primitive_materials).enumerate() {
            if !usize::try_from(material).is_ok_and(|m| m < materials.len()) {
                return Err(Error::invalid(format!("primitive {i} has material {material} of {}", materials.len())));
            }
            let outline = Outline::from_number(row[0] as i64)
                .ok_or_else(|| Error::invalid(format!("primitive {i} has the outline {}", row[0])))?;
            let vector = |k: usize| Vector3::new(row[k], row[k + 1], row[k + 2]);
            let primitive =
                Primitive::new(outline, vector(1), vector(4), vector(7), [row[10], row[11]], material as u32)
                    .ok_or_else(|| Error::invalid(format!("primitive {i} spans no surface: {row:?}")))?;
            primitives.push(primitive);
        }
        Ok(Scene::new(primitives, materials, paintings, self.lighting()?))
    }

    fn materials(&self, paintings: usize) -> Result<Vec<Material>> {
        let mut layers = self.layers.iter().enumerate();
        let mut materials = Vec::with_capacity(self.materials.len());
        for (i, row) in self.materials.iter().enumerate() {
            let mut own = Vec::new();
            for _ in 0..row[0] as usize {
                let (k, layer) = layers.next().ok_or_else(|| Error::invalid(format!("material {i} lacks layers")))?;
                own.push(
                    layer_from(layer, paintings)
                        .ok_or_else(|| Error::invalid(format!("layer {k} cannot be read: {layer:?}")))?,
                );
            }
            materials.push(Material {
                layers: own,
                gloss: row[1] as f32,
                translucency: row[2] as f32,
                relief: [row[3] as f32, row[4] as f32],
                emission: [row[5] as f32, row[6] as f32, row[7] as f32],
            });
        }
        Ok(materials)
    }

    fn lighting(&self) -> Result<Lighting> {
        let row = self.lighting;
        if row.iter().any(|x| !x.is_finite()) {
            return Err(Error::invalid(format!("lighting holds values that are not finite: {row:?}")));
        }
        let light = |k: usize| [row[k] as f32, row[k + 1] as f32, row[k + 2] as f32];
        let sun_direction = Vector3::new(row[0], row[1], row[2])
            .try_normalize(1e-12)
            .ok_or_else(|| Error::invalid("the sun's direction has no length"))?;
        if row[18] <= 0.0 || row[19] < 1.0 {
            return Err(Error::invalid(format!("light map of spacing {} m and {} directions", row[18], row[19])));
        }
        Ok(Lighting {
            sun_direction,
            sun: light(3),
            sun_radius: row[6],
            zenith: light(7),
            horizon: light(10),
            ground: light(13),
            clouds: row[16] as f32,
            seed: row[17] as u32,
            map_spacing: row[18],
            map_directions: row[19] as usize,
            bounces: row[20] as usize,
        })
    }
}

fn layer_from(row: &[f64; LAYER_COLUMNS], paintings: usize) -> Option<Layer> {
    if row.iter().any(|x| !x.is_finite()) {
        return None;
    }
    let f = |k: usize| row[k] as f32;
    let p = |k: usize| row[10 + k] as f32;
    let pattern = match row[0] as i64 {
        0 => Pattern::Fill,
        1 => Pattern::Noise { octaves: p(0) as u32, gain: p(1), on_surface: p(2) > 0.0 },
        2 => Pattern::Patches {
            octaves: p(0) as u32,
            gain: p(1),
            on_surface: p(2) > 0.0,
            threshold: p(3),
            softness: p(4),
        },
        3 => Pattern::Courses { joint: p(0), stagger: p(1), brightness: p(2), hue: p(3), relief: p(4), wobble: p(5) },
        4 => Pattern::Gradient { from: p(0), to: p(1), by_height: p(2) > 0.0 },
        5 => {
            let image = row[10] as usize;
            if image >= paintings {
                return None;
            }
            Pattern::Painted { image, s0: p(1), t0: p(2), s1: p(3), t1: p(4) }
        }
        6 => Pattern::Ring { centre: [p(0), p(1)], inner: p(2), outer: p(3) },
        7 => Pattern::Quadrants { centre: [p(0), p(1)], radius: p(2) },
        8 => Pattern::Rectangle { s0: p(0), t0: p(1), s1: p(2), t1: p(3) },
        _ => return None,
    };
    let scale = [f(6), f(7), f(8)];
    if scale.iter().any(|s| *s <= 0.0) {
        return None;
    }
    Some(Layer { pattern, colour: [f(1), f(2), f(3), f(4)], amount: f(5), scale, seed: row[9] as u32 })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lighting() -> [f64; LIGHTING_COLUMNS] {
        let mut row = [0.0; LIGHTING_COLUMNS];
        (row[2], row[18], row[19]) = (1.0, 0.5, 16.0);
        row[7..16].fill(0.5);
        row
    }

    fn square(at: f64) -> [f64; PRIMITIVE_COLUMNS] {
        [0.0, -5.0, -5.0, at, 10.0, 0.0, 0.0, 0.0, 10.0, 0.0, 0.0, 0.0]
    }

    #[test]
    fn a_white_square_under_an_even_sky_is_as_bright_as_the_sky() {
        let white = [0.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        let tables = Tables {
            primitives: &[square(0.0)],
            primitive_materials: &[0],
            materials: &[[1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]],
            layers: &[white],
            lighting: &lighting(),
        };
        let scene = tables.scene(Vec::new()).unwrap();
        let down = |x: f64, y: f64| Some(Vector3::new(x / 100.0, y / 100.0, -1.0).normalize());
        let picture = scene.picture(&Vector3::new(0.0, 0.0, 3.0), &down, 4, 0..3, 16);
        assert_eq!(picture.len(), 12);
        assert!(picture.iter().flatten().all(|c| (c - 0.5).abs() < 1e-5), "{picture:?}");
        assert!(scene.sees(&Vector3::new(0.0, 0.0, 3.0), &[[1.0, 1.0, 0.0]], 1e-6)[0]);
        assert!(!scene.sees(&Vector3::new(0.0, 0.0, 3.0), &[[1.0, 1.0, -1.0]], 1e-6)[0]);
    }

    #[test]
    fn impossible_entries_are_refused_by_number() {
        let tables = Tables {
            primitives: &[square(0.0)],
            primitive_materials: &[3],
            materials: &[[0.0; MATERIAL_COLUMNS]],
            layers: &[],
            lighting: &lighting(),
        };
        assert!(tables.scene(Vec::new()).is_err_and(|e| e.to_string().contains("material 3 of 1")));
    }
}
