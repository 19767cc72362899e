//! How the samples of a finished depth buffer are looked at for planes: through windows about the cells of a grid.
//!
//! Most windows hold one surface. For these the least-squares plane and how many samples lie on it are found eight samples at
//! a time, from the buffer as it lies; only where too many lie off it are samples listed and planes tried one by one.

use std::ops::Range;

use nalgebra::{Matrix2, Vector2, Vector3};
use rayon::prelude::*;

use super::plane_fit::{FEWEST, Fit, LAYERS, NEARLY_ALL, Noise, Plane, SHARE, Spot, planes_in};
use super::planes::{Face, PLACE};
use super::sample::Sample;
#[cfg(target_arch = "x86_64")]
use super::window_fit::Part;
use super::zbuffer::Grid;
use crate::geometry::{Camera, Depth};

/// The smallest and the largest cell, pixels.
const CELL: [f64; 2] = [8.0, 48.0];
/// Samples that a cell is to be wide, about.
const SAMPLES_ACROSS: f64 = 3.0;
/// A window's radius as a part of a cell.
const RADIUS: f64 = 0.75;
/// The largest radius, pixels.
const FARTHEST: f64 = 40.0;
/// Samples across a window, about, that are looked at.
const LOOKS: f64 = 16.0;
/// With a sigma of the tangent below this a plane is good enough; else a wider window is tried.
const GOOD: f32 = 0.1;
/// With a sigma of the tangent above this there is no plane.
const USELESS: f32 = 0.3;
/// The inverse depth's rounding, relative.
const ROUNDING: f32 = 1e-5;
/// Pixels of the blocks in which the density of samples is found, and of how many one is looked at.
const BLOCK: (usize, usize) = (64, 3);
/// Of so many cells, across and down, one says how noisy depths are.
const EVERY: usize = 5;

/// A window about the middle of a cell.
struct Window {
    /// The middle, (X, Y)/Z.
    middle: [f64; 2],
    /// The same, pixels.
    xy: [f64; 2],
    /// From pixels to (X, Y)/Z.
    from_pixels: Matrix2<f64>,
}

impl Window {
    /// A radius in pixels as one in (X, Y)/Z.
    fn unit(&self, radius: f64) -> f64 {
        radius * self.from_pixels.determinant().abs().sqrt()
    }
}

/// The samples, and how they are looked at.
pub(super) struct Looks<'a> {
    camera: Camera,
    grid: Grid,
    samples: &'a [Sample],
    /// Of a cell.
    pub pixels: f64,
    fill: f64,
}

impl<'a> Looks<'a> {
    pub fn new(camera: Camera, grid: Grid, samples: &'a [Sample]) -> Self {
        let fill = density(&grid, samples);
        let pixels = (SAMPLES_ACROSS / fill.sqrt()).clamp(CELL[0], CELL[1]);
        Self { camera, grid, samples, pixels, fill }
    }

    #[inline(always)]
    fn window(&self, face: &Face, cell: [usize; 2]) -> Option<Window> {
        let middle = face.middle(cell);
        let ray = face.to_camera(Vector3::new(middle[0], middle[1], 1.0));
        let (xy, d) = self.camera.project_with_point_jacobian(&ray)?;
        let reach = RADIUS * self.pixels;
        let size = [self.grid.width as f64, self.grid.height as f64];
        if (0..2).any(|k| xy[k] < -reach || xy[k] > size[k] + reach) {
            return None;
        }
        let to_pixels = Matrix2::from_fn(|i, k| d[i][face.axes[k]]);
        let from_pixels = to_pixels.try_inverse().filter(|m| m.iter().all(|x| x.is_finite()))?;
        Some(Window { middle, xy, from_pixels })
    }

    /// The photo's columns and rows within a radius in pixels.
    #[inline(always)]
    fn ranges(&self, window: &Window, radius: f64) -> [Range<usize>; 2] {
        let size = [self.grid.width, self.grid.height];
        [0, 1].map(|k| {
            // The half more and the cut are rounding, for what is not negative.
            let low = (window.xy[k] - radius + 0.5).clamp(0.0, size[k] as f64) as usize;
            let high = (window.xy[k] + radius + 1.5).clamp(0.0, size[k] as f64) as usize;
            low..high
        })
    }

    /// Of so many samples across and down one is looked at.
    #[inline(always)]
    fn every(&self, radius: f64) -> usize {
        (((2.0 * radius + 1.0) * self.fill.sqrt() / LOOKS) as usize).max(1)
    }

    /// The samples within a radius in pixels.
    fn gather(&self, window: &Window, radius: f64, spots: &mut Vec<Spot>) {
        spots.clear();
        let [columns, rows] = self.ranges(window, radius);
        let every = self.every(radius);
        let unit = window.unit(radius);
        let m = window.from_pixels / unit;
        let along_axis = self.camera.depth_kind() == Depth::AlongAxis;
        for row in rows.step_by(every) {
            let start = self.grid.cell(0, row);
            for column in columns.clone().step_by(every) {
                let sample = self.samples[start + column];
                if !sample.found() {
                    continue;
                }
                let [right, down] = sample.place().map(f64::from);
                let d = Vector2::new(column as f64 + right - window.xy[0], row as f64 + down - window.xy[1]);
                let at = m * d;
                let mut w = f64::from(sample.inverse_depth());
                if !along_axis {
                    let (u, v) = (window.middle[0] + unit * at.x, window.middle[1] + unit * at.y);
                    w *= (u * u + v * v + 1.0).sqrt();
                }
                spots.push(Spot { a: at.x as f32, b: at.y as f32, w: w as f32 });
            }
        }
    }

    /// The least-squares plane of all samples within a radius in pixels; `None` where not all are to be looked at, at the end
    /// of the buffer, and on processors for which it is not written.
    fn fit(&self, window: &Window, radius: f64, noise: &Noise) -> Option<Fit> {
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") && self.every(radius) == 1 {
            let [columns, rows] = self.ranges(window, radius);
            let start = self.grid.cell(columns.start, rows.start);
            let part = Part {
                samples: self.samples.get(start..)?,
                stride: self.grid.stride(),
                size: [columns.len(), rows.len()],
                first: [columns.start as f64 - window.xy[0], rows.start as f64 - window.xy[1]],
                radius,
                middle: window.middle,
                from_pixels: window.from_pixels,
            };
            // SAFETY: the processor has the feature.
            return unsafe {
                match self.camera.depth_kind() {
                    Depth::AlongAxis => part.fit::<false>(noise),
                    Depth::Range => part.fit::<true>(noise),
                }
            };
        }
        let _ = (window, radius, noise);
        None
    }

    /// The planes within a radius in pixels, and whether there is any sample.
    #[inline(always)]
    fn planes_within(
        &self,
        window: &Window,
        radius: f64,
        noise: &Noise,
        spots: &mut Vec<Spot>,
    ) -> ([Option<Plane>; LAYERS], bool) {
        if let Some(fit) = self.fit(window, radius, noise) {
            let Fit { plane, count, near } = fit;
            if count < FEWEST {
                return ([None; LAYERS], count > 0);
            }
            let fewest = FEWEST.max((SHARE[1] * count as f32) as usize);
            let enough = near >= FEWEST && near as f32 >= NEARLY_ALL * count as f32;
            // Those that are left are too few for a plane of their own.
            if plane.is_some() && enough && count - near < fewest {
                return ([plane, None], true);
            }
        }
        self.gather(window, radius, spots);
        let any = !spots.is_empty();
        (planes_in(spots, noise), any)
    }

    /// The planes about a cell, from the smallest window that tells them well enough: each n of n · (u, v, 1) = 1/Z in the
    /// face's axes, zeros for none.
    pub fn planes(&self, face: &Face, cell: [usize; 2], depth_noise: f32, spots: &mut Vec<Spot>) -> [[f32; 3]; LAYERS] {
        let mut result = [[0.0; 3]; LAYERS];
        let Some(window) = self.window(face, cell) else { return result };
        let mut radius = RADIUS * self.pixels;
        loop {
            let unit = window.unit(radius);
            let noise = Noise { depth: depth_noise, rounding: ROUNDING, place: PLACE / radius as f32 };
            let (found, any) = self.planes_within(&window, radius, &noise, spots);
            let tangents = found.map(|plane| plane.map_or(f32::INFINITY, |p| tangent_sigma(&p, unit as f32, &noise)));
            for ((result, plane), tangent) in result.iter_mut().zip(found).zip(tangents) {
                if let Some(plane) = plane.filter(|_| tangent < USELESS) {
                    *result = normal(&plane, window.middle, unit);
                }
            }
            radius *= 2.0;
            if tangents[0] < GOOD || radius > FARTHEST.max(2.0 * RADIUS * self.pixels) {
                return result;
            }
            if !any && radius > 2.0 * self.pixels {
                return result;
            }
        }
    }

    /// Sigma of a depth, in the cloud's unit: the median, over windows, of what the least-squares plane leaves over where
    /// places are good to `place` pixels. Edges and leaves do not count.
    pub fn depth_noise(&self, faces: &[Face], place: f32) -> f32 {
        let rows = |face: &Face| (EVERY / 2..face.size[1]).step_by(EVERY).collect::<Vec<_>>();
        let rows: Vec<(&Face, usize)> =
            faces.iter().flat_map(|f| rows(f).into_iter().map(move |row| (f, row))).collect();
        let of_row = |spots: &mut Vec<Spot>, (face, row): (&Face, usize)| {
            let mut found = Vec::new();
            for column in (EVERY / 2..face.size[0]).step_by(EVERY) {
                let Some(window) = self.window(face, [column, row]) else { continue };
                self.gather(&window, RADIUS * self.pixels, spots);
                let Some(plane) = Plane::fitted(spots.iter()).filter(|_| spots.len() >= FEWEST) else { continue };
                let rounded = ROUNDING * plane.c + place / (RADIUS * self.pixels) as f32 * plane.ga.hypot(plane.gb);
                let rest = plane.rms * plane.rms - rounded * rounded;
                found.push(rest.max(0.0).sqrt() / (plane.c * plane.c));
            }
            found
        };
        let found: Vec<Vec<f32>> = rows.into_par_iter().map_init(Vec::new, of_row).collect();
        let mut found = found.concat();
        found.retain(|noise| noise.is_finite());
        found.sort_by(f32::total_cmp);
        found.get(found.len() / 2).copied().unwrap_or(0.0)
    }
}

/// Sigma of the tangent between the plane and the one that faces the camera.
fn tangent_sigma(plane: &Plane, unit: f32, noise: &Noise) -> f32 {
    let least = (noise.depth * plane.c + noise.rounding) * plane.c;
    plane.rms.max(least) * plane.weakness / (unit * plane.c)
}

/// n of n · (u, v, 1) = 1/Z.
fn normal(plane: &Plane, middle: [f64; 2], unit: f64) -> [f32; 3] {
    let (gu, gv) = (f64::from(plane.ga) / unit, f64::from(plane.gb) / unit);
    [gu, gv, f64::from(plane.c) - gu * middle[0] - gv * middle[1]].map(|x| x as f32)
}

/// The share of cells that hold a sample, where there are any: the median of blocks of the photo.
fn density(grid: &Grid, samples: &[Sample]) -> f64 {
    let (side, every) = BLOCK;
    let starts = |length: usize| (0..length).step_by(every * side);
    let mut shares: Vec<f64> = starts(grid.height)
        .flat_map(|row| starts(grid.width).map(move |column| (row, column)))
        .filter_map(|(row, column)| {
            let (rows, columns) = (side.min(grid.height - row), side.min(grid.width - column));
            let line = |y| &samples[grid.cell(column, row + y)..][..columns];
            let found: usize = (0..rows).map(|y| line(y).iter().filter(|s| s.found()).count()).sum();
            (found > 0).then(|| found as f64 / (rows * columns) as f64)
        })
        .collect();
    shares.sort_by(f64::total_cmp);
    shares.get(shares.len() / 2).copied().unwrap_or(1.0)
}
