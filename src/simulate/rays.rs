//! The rays of a picture: of any point from the camera, and of whole bands by interpolation.

use nalgebra::Vector3;
use rayon::prelude::*;

/// The unit ray, in the scene's frame, of a point of the picture; `None` where the camera has no picture.
pub trait Rays: Fn(f64, f64) -> Option<Vector3<f64>> + Sync {}
impl<F: Fn(f64, f64) -> Option<Vector3<f64>> + Sync> Rays for F {}

/// Side, in pixels, of the blocks within which rays are interpolated.
const BLOCK: usize = 8;
/// Pixels wider than this (radians) get their rays without interpolation.
const WIDE: f64 = 2e-3;

/// Rays of a band of the picture, worked out on a grid of three by three for each block of pixels.
pub(super) struct Field<'a, R> {
    pub rays: &'a R,
    first_row: usize,
    across: usize,
    blocks: Vec<Block>,
}

/// Rays of one block by biquadratic interpolation. Its error is of third order in the block's angle: 1e-9 radians for
/// pixels of a third of a milliradian, 1e-7 at the limit [`WIDE`].
pub(super) struct Block {
    /// Middle of the block, pixels.
    middle: [f64; 2],
    /// Unit rays at −1, 0, 1 half blocks from it; `None` where they are not all in the camera's field.
    nodes: Option<[Vector3<f64>; 9]>,
    /// Angle of a pixel, radians.
    pub angle: f64,
}

impl<'a, R: Rays> Field<'a, R> {
    pub fn new(rays: &'a R, width: usize, rows: std::ops::Range<usize>) -> Self {
        // Blocks lie alike whatever rows are asked for: the same pixel gets the same rays.
        let first_row = rows.start / BLOCK * BLOCK;
        let across = width.div_ceil(BLOCK);
        let down = (rows.end - first_row).div_ceil(BLOCK);
        let half = 0.5 * BLOCK as f64;
        let blocks = (0..across * down)
            .into_par_iter()
            .with_min_len(64)
            .map(|i| {
                let x = (i % across * BLOCK) as f64 - 0.5 + half;
                let y = (first_row + i / across * BLOCK) as f64 - 0.5 + half;
                let angle = pixel_angle(rays, x, y);
                let mut nodes = [Vector3::zeros(); 9];
                let mut inside = angle < WIDE;
                for (k, node) in nodes.iter_mut().enumerate() {
                    let (dx, dy) = ((k % 3) as f64 - 1.0, (k / 3) as f64 - 1.0);
                    match rays(x + dx * half, y + dy * half) {
                        Some(ray) => *node = ray,
                        None => inside = false,
                    }
                }
                Block { middle: [x, y], nodes: inside.then_some(nodes), angle }
            })
            .collect();
        Self { rays, first_row, across, blocks }
    }

    pub fn block(&self, x: usize, y: usize) -> &Block {
        &self.blocks[(y - self.first_row) / BLOCK * self.across + x / BLOCK]
    }
}

impl Block {
    #[inline]
    pub fn ray(&self, rays: &impl Rays, x: f64, y: f64) -> Option<Vector3<f64>> {
        let Some(nodes) = &self.nodes else {
            return rays(x, y);
        };
        let scale = 2.0 / BLOCK as f64;
        let (a, b) = ((x - self.middle[0]) * scale, (y - self.middle[1]) * scale);
        let weights = |t: f64| [0.5 * t * (t - 1.0), 1.0 - t * t, 0.5 * t * (t + 1.0)];
        let (p, q) = (weights(a), weights(b));
        let mut ray = Vector3::zeros();
        for j in 0..3 {
            ray += (nodes[3 * j] * p[0] + nodes[3 * j + 1] * p[1] + nodes[3 * j + 2] * p[2]) * q[j];
        }
        Some(ray.normalize())
    }
}

/// Angle of one pixel at a point of the picture, radians.
pub(super) fn pixel_angle(rays: &impl Rays, x: f64, y: f64) -> f64 {
    match (rays(x - 0.5, y), rays(x + 0.5, y)) {
        (Some(a), Some(b)) => (a - b).norm(),
        _ => 1e-3,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn interpolated_rays_are_the_lens_rays() {
        // A strongly curved, made-up lens with pixels of a third of a milliradian.
        let lens = |x: f64, y: f64| {
            let (u, v) = ((x - 300.0) / 3000.0, (y - 200.0) / 3000.0);
            let r2 = u * u + v * v;
            Some(Vector3::new(u * (1.0 - 0.3 * r2), v * (1.0 - 0.3 * r2), 1.0).normalize())
        };
        let field = Field::new(&lens, 600, 3..400);
        for i in 0..5000 {
            let (x, y) = ((i * 37) % 600, 3 + (i * 53) % 397);
            let (dx, dy) = (0.43 - 0.001 * f64::from((i % 860) as i32), 0.4);
            let ray = field.block(x, y).ray(&lens, x as f64 + dx, y as f64 + dy);
            let exact = lens(x as f64 + dx, y as f64 + dy);
            assert!((ray.unwrap() - exact.unwrap()).norm() < 2e-9);
        }
    }
}
