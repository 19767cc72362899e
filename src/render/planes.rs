//! The slope of the surfaces that a view sees: a grid of local planes, fitted to the samples of a finished depth buffer.
//!
//! The grid lies over (X, Y)/Z and not over the photo's pixels: what asks for the plane of a point needs its place in the
//! camera frame and no projection through the lens. Cameras that look around have six grids, on the faces of a cube.

use std::ops::Range;

use nalgebra::{Matrix2, Vector2, Vector3};
use rayon::prelude::*;

use super::plane_fit::{FEWEST, LAYERS, Noise, Plane, Spot, planes_in};
use super::sample::Sample;
use super::zbuffer::Grid;
use crate::geometry::{Camera, Depth, Pose, View, forward_field};

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
/// By how much a point may lie off its plane, relative and in sigmas of a depth: one of its own cell, and any about it.
const OFF: [(f32, f32); 2] = [(0.0005, 3.0), (0.002, 6.0)];
/// The inverse depth's rounding, relative.
const ROUNDING: f32 = 1e-5;
/// The place's rounding, pixels.
pub(super) const PLACE: f32 = 0.03;
/// Pixels of the blocks in which the density of samples is found, and of how many one is looked at.
const BLOCK: (usize, usize) = (64, 3);
/// Of so many cells, across and down, one says how noisy depths are.
const EVERY: usize = 5;

/// Up to two planes, n · X = 1 in the camera frame; zeros for none. Never across the border of a line of the cache.
#[derive(Debug, Clone, Copy, Default)]
#[repr(align(32))]
struct Cell([[f32; 3]; LAYERS]);

/// Local planes over what a view sees.
#[derive(Debug, Clone)]
pub struct LocalPlanes {
    pose: Pose,
    faces: Vec<Face>,
    /// Sigma of a depth, in the cloud's unit.
    noise: f32,
}

/// Where on the grid a point lies.
#[derive(Debug, Clone, Copy)]
pub struct PlaneCell {
    face: u32,
    column: u32,
    row: u32,
    depth: f32,
}

/// One of the six pyramids about the projection centre, or the only one.
#[derive(Debug, Clone)]
struct Face {
    axes: [usize; 3],
    sign: f64,
    low: [f64; 2],
    size: [usize; 2],
    /// (X, Y)/Z per cell.
    step: f64,
    cells: Vec<Cell>,
}

impl LocalPlanes {
    /// From the samples in the cells of a grid.
    pub fn new(view: &View, grid: Grid, samples: &[Sample]) -> Self {
        let (looks, mut faces) = prepared(view, grid, samples);
        let noise = looks.depth_noise(&faces, PLACE);
        for face in &mut faces {
            let [columns, rows] = face.size;
            let mut cells = vec![Cell::default(); columns * rows];
            cells.par_chunks_mut(columns).enumerate().for_each_init(Vec::new, |spots, (row, cells)| {
                for (column, cell) in cells.iter_mut().enumerate() {
                    *cell = looks.planes(face, [column, row], noise, spots);
                }
            });
            face.cells = cells;
        }
        Self { pose: view.pose, faces, noise }
    }

    /// Where the planes of a point of the camera frame are found; the memory is asked for them. `None` outside the grid.
    #[inline(always)]
    pub fn locate(&self, q: [f32; 3]) -> Option<PlaneCell> {
        let number = if self.faces.len() == 1 {
            0
        } else {
            let size = q.map(f32::abs);
            let k = if size[0] >= size[1] && size[0] >= size[2] { 0 } else { 2 - usize::from(size[1] >= size[2]) };
            2 * k + usize::from(q[k] < 0.0)
        };
        let face = &self.faces[number];
        let depth = face.sign as f32 * q[face.axes[2]];
        let scale = 1.0 / (depth * face.step as f32);
        let place = [0, 1].map(|k| q[face.axes[k]] * scale - face.low[k] as f32 / face.step as f32);
        let inside = depth > 0.0 && (0..2).all(|k| place[k] >= 0.0 && place[k] < face.size[k] as f32);
        if !inside {
            return None;
        }
        let [column, row] = place.map(|x| x as u32);
        super::fetch(&face.cells, row * face.size[0] as u32 + column);
        Some(PlaneCell { face: number as u32, column, row, depth })
    }

    /// The normal, of any length and sign, of the surface on which a point of the camera frame lies; `None` where no plane
    /// was found near it.
    #[inline(always)]
    pub fn normal_in(&self, cell: PlaneCell, q: [f32; 3]) -> Option<[f32; 3]> {
        let face = &self.faces[cell.face as usize];
        let [allowed, most] = OFF.map(|(relative, sigmas)| relative + sigmas * self.noise / cell.depth);
        let [column, row] = [cell.column as usize, cell.row as usize];
        face.closest(q, [column..column + 1, row..row + 1], allowed)
            .or_else(|| self.beside(face, q, [column, row], most))
    }

    /// As [`LocalPlanes::normal_in`], for one point alone.
    pub fn normal(&self, q: [f32; 3]) -> Option<[f32; 3]> {
        self.normal_in(self.locate(q)?, q)
    }

    /// The planes of the neighbouring cells: at edges a surface may take a small part of its cell only.
    #[cold]
    fn beside(&self, face: &Face, q: [f32; 3], cell: [usize; 2], allowed: f32) -> Option<[f32; 3]> {
        let around = [0, 1].map(|k| cell[k].saturating_sub(1)..(cell[k] + 2).min(face.size[k]));
        face.closest(q, around, allowed)
    }

    /// Unit normals, away from the camera, at points of the world; zeros where no plane was found.
    pub fn normals(&self, xyz: &[[f64; 3]]) -> Vec<[f64; 3]> {
        let one = |p: &[f64; 3]| {
            let q = self.pose.transform(p);
            let n = Vector3::from(self.normal(q.map(|x| x as f32).into())?.map(f64::from));
            let n = (n * n.dot(&q).signum()).try_normalize(0.0)?;
            Some((self.pose.rotation.transpose() * n).into())
        };
        xyz.par_iter().with_min_len(1024).map(|p| one(p).unwrap_or_default()).collect()
    }

    /// Sigma of a depth, in the cloud's unit, as the samples scatter about their planes.
    pub fn depth_noise(&self) -> f32 {
        self.noise
    }
}

/// Sigma of a depth, in the cloud's unit, as samples scatter about local planes, whose places are good to `place` pixels.
pub(super) fn depth_noise(view: &View, grid: Grid, samples: &[Sample], place: f32) -> f32 {
    let (looks, faces) = prepared(view, grid, samples);
    looks.depth_noise(&faces, place)
}

/// What planes are fitted to, and the empty faces for them.
fn prepared<'a>(view: &View, grid: Grid, samples: &'a [Sample]) -> (Looks<'a>, Vec<Face>) {
    let fill = density(&grid, samples);
    let pixels = (SAMPLES_ACROSS / fill.sqrt()).clamp(CELL[0], CELL[1]);
    let step = pixels * f64::from(super::pixel_angle(view));
    let face = |axes, sign, low: [f64; 2], high: [f64; 2]| {
        let size = [0, 1].map(|k| ((high[k] - low[k]) / step).ceil().clamp(1.0, 4096.0) as usize);
        Face { axes, sign, low, size, step, cells: Vec::new() }
    };
    let faces = match view.camera.depth_kind() {
        Depth::AlongAxis => {
            let (low, high) = forward_field(view);
            vec![face([0, 1, 2], 1.0, low, high)]
        }
        Depth::Range => (0..6)
            .map(|f| {
                let k = f / 2;
                face([(k + 1) % 3, (k + 2) % 3, k], if f % 2 == 0 { 1.0 } else { -1.0 }, [-1.0; 2], [1.0; 2])
            })
            .collect(),
    };
    (Looks { camera: view.camera, grid, samples, pixels, fill }, faces)
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

/// A window about the middle of a cell.
struct Window {
    /// The middle, (X, Y)/Z.
    middle: [f64; 2],
    /// The same, pixels.
    xy: [f64; 2],
    /// From pixels to (X, Y)/Z.
    from_pixels: Matrix2<f64>,
}

/// The samples, and how they are looked at.
struct Looks<'a> {
    camera: Camera,
    grid: Grid,
    samples: &'a [Sample],
    /// Of a cell.
    pixels: f64,
    fill: f64,
}

impl Looks<'_> {
    fn window(&self, face: &Face, cell: [usize; 2]) -> Option<Window> {
        let middle = [0, 1].map(|k| face.low[k] + (cell[k] as f64 + 0.5) * face.step);
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

    /// The samples within a radius in pixels; gives the radius in (X, Y)/Z.
    fn gather(&self, window: &Window, radius: f64, spots: &mut Vec<Spot>) -> f64 {
        spots.clear();
        let size = [self.grid.width, self.grid.height];
        let range = |k: usize| {
            let low = (window.xy[k] - radius).round().clamp(0.0, size[k] as f64) as usize;
            let high = (window.xy[k] + radius + 1.0).round().clamp(0.0, size[k] as f64) as usize;
            low..high
        };
        let every = (((2.0 * radius + 1.0) * self.fill.sqrt() / LOOKS) as usize).max(1);
        let m = window.from_pixels;
        let unit = radius * m.determinant().abs().sqrt();
        let m = m / unit;
        let along_axis = self.camera.depth_kind() == Depth::AlongAxis;
        for row in range(1).step_by(every) {
            let start = self.grid.cell(0, row);
            for column in range(0).step_by(every) {
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
        unit
    }

    /// The planes about a cell, from the smallest window that tells them well enough.
    fn planes(&self, face: &Face, cell: [usize; 2], depth_noise: f32, spots: &mut Vec<Spot>) -> Cell {
        let mut result = Cell::default();
        let Some(window) = self.window(face, cell) else { return result };
        let mut radius = RADIUS * self.pixels;
        loop {
            let unit = self.gather(&window, radius, spots);
            let noise = Noise { depth: depth_noise, rounding: ROUNDING, place: PLACE / radius as f32 };
            let found = planes_in(spots, &noise);
            let tangents = found.map(|plane| plane.map_or(f32::INFINITY, |p| tangent_sigma(&p, unit as f32, &noise)));
            for ((result, plane), tangent) in result.0.iter_mut().zip(found).zip(tangents) {
                if let Some(plane) = plane.filter(|_| tangent < USELESS) {
                    *result = face.normal(&plane, window.middle, unit);
                }
            }
            radius *= 2.0;
            if tangents[0] < GOOD || radius > FARTHEST.max(2.0 * RADIUS * self.pixels) {
                return result;
            }
            if spots.is_empty() && found[0].is_none() && radius > 2.0 * self.pixels {
                return result;
            }
        }
    }

    /// The median, over windows, of what the least-squares plane leaves over: edges and leaves do not count.
    fn depth_noise(&self, faces: &[Face], place: f32) -> f32 {
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

impl Face {
    /// Of the planes in these columns and rows the one that the point lies on best, where it does.
    #[inline(always)]
    fn closest(&self, q: [f32; 3], [columns, rows]: [Range<usize>; 2], allowed: f32) -> Option<[f32; 3]> {
        let (mut best, mut least) = (None, allowed);
        for row in rows {
            for n in self.cells[row * self.size[0]..][columns.clone()].iter().flat_map(|cell| &cell.0) {
                let off = (n[0] * q[0] + n[1] * q[1] + n[2] * q[2] - 1.0).abs();
                if off <= least {
                    (best, least) = (Some(*n), off);
                }
            }
        }
        best
    }

    fn to_camera(&self, p: Vector3<f64>) -> Vector3<f64> {
        let mut q = Vector3::zeros();
        q[self.axes[0]] = p.x;
        q[self.axes[1]] = p.y;
        q[self.axes[2]] = self.sign * p.z;
        q
    }

    /// n of n · X = 1 in the camera frame.
    fn normal(&self, plane: &Plane, middle: [f64; 2], unit: f64) -> [f32; 3] {
        let (gu, gv) = (f64::from(plane.ga) / unit, f64::from(plane.gb) / unit);
        let n = Vector3::new(gu, gv, f64::from(plane.c) - gu * middle[0] - gv * middle[1]);
        let n = self.to_camera(n);
        [n.x as f32, n.y as f32, n.z as f32]
    }
}
