//! The slope of the surfaces that a view sees: a grid of local planes, fitted to the samples of a finished depth buffer.
//!
//! The grid lies over (u, v) = (X, Y)/Z and not over the photo's pixels: what asks for the plane of a point needs its place
//! in the camera frame and no projection through the lens. Cameras that look around have six grids, on the faces of a cube.

use nalgebra::Vector3;
use rayon::prelude::*;

use super::plane_fit::LAYERS;
use super::sample::Sample;
use super::windows::Looks;
use super::zbuffer::Grid;
use crate::geometry::{CUBE_FACES, Depth, Pose, View, cube_face, cube_face_of, forward_field};
use crate::memory::{Zeroed, fresh};

/// By how much a point may lie off its plane, relative and in sigmas of a depth: one of its own cell, and any about it.
const OFF: [(f32, f32); 2] = [(0.0005, 3.0), (0.002, 6.0)];
/// The place's rounding, pixels.
pub(super) const PLACE: f32 = 0.03;
/// Where a ray is not in the grid.
const NOWHERE: u32 = u32::MAX;

/// A plane, n · (u, v, 1) = 1/Z in the axes of a face, zeros for none; and 1 where there is a second one. Never across the
/// border of a line of the cache.
#[derive(Debug, Clone, Copy, Default)]
#[repr(align(16))]
pub(super) struct Cell([f32; 4]);

// SAFETY: zeros are a plane that is none.
unsafe impl Zeroed for Cell {}

impl Cell {
    /// From the two planes of a place.
    pub fn pair([first, second]: [[f32; 3]; LAYERS]) -> [Self; LAYERS] {
        let cell = |[x, y, z]: [f32; 3], flag| Self([x, y, z, flag]);
        [cell(first, if second == [0.0; 3] { 0.0 } else { 1.0 }), cell(second, 0.0)]
    }

    /// By how much the inverse depth of a ray's point is off the plane.
    #[inline(always)]
    fn off(&self, [u, v, w]: [f32; 3]) -> f32 {
        let [x, y, z, _] = self.0;
        (x * u + y * v + z - w).abs()
    }

    #[inline(always)]
    fn has_second(&self) -> bool {
        self.0[3] != 0.0
    }

    #[inline(always)]
    fn normal(&self) -> [f32; 3] {
        let [x, y, z, _] = self.0;
        [x, y, z]
    }
}

/// Local planes over what a view sees.
#[derive(Debug, Clone)]
pub struct LocalPlanes {
    pose: Pose,
    faces: Vec<Face>,
    /// Sigma of a depth, in the cloud's unit.
    noise: f32,
}

/// One of the six pyramids about the projection centre, or the only one. Its axes are u, v and the depth.
#[derive(Debug, Clone)]
pub(crate) struct Face {
    /// The axes in the camera frame.
    pub(super) axes: [usize; 3],
    /// The sign of the depth's axis.
    sign: f64,
    low: [f64; 2],
    /// Columns and rows.
    pub(super) size: [usize; 2],
    /// (X, Y)/Z per cell.
    step: f64,
    /// Sigma of a depth, in the cloud's unit.
    noise: f32,
    /// The first planes, and the second ones, which are seldom needed.
    cells: [Vec<Cell>; LAYERS],
}

impl LocalPlanes {
    /// From the samples in the cells of a grid, whose depths scatter by `noise`, in the cloud's unit.
    pub fn new(view: &View, grid: Grid, samples: &[Sample], noise: f32) -> Self {
        let (looks, mut faces) = prepared(view, grid, samples);
        for face in &mut faces {
            let [columns, rows] = face.size;
            let [mut first, mut second] = [fresh(columns * rows), fresh(columns * rows)];
            let lines = first.par_chunks_mut(columns).zip(second.par_chunks_mut(columns)).enumerate();
            lines.for_each_init(Vec::new, |spots, (row, (first, second))| {
                for column in 0..columns {
                    let [one, other] = Cell::pair(looks.planes(face, [column, row], noise, spots));
                    first[column] = one;
                    if one.has_second() {
                        second[column] = other;
                    }
                }
            });
            (face.cells, face.noise) = ([first, second], noise);
        }
        Self { pose: view.pose, faces, noise }
    }

    /// The grid of a face: the only one, or one of the cube's.
    #[inline(always)]
    pub(crate) fn face(&self, number: usize) -> &Face {
        &self.faces[number]
    }

    /// One or six.
    pub(crate) fn count(&self) -> usize {
        self.faces.len()
    }

    /// The normal, of any length and sign, of the surface on which a point of the camera frame lies; `None` where no plane
    /// was found near it.
    pub fn normal(&self, q: [f32; 3]) -> Option<[f32; 3]> {
        let number = if self.faces.len() == 1 { 0 } else { cube_face_of(q) };
        let face = &self.faces[number];
        let w = 1.0 / (face.sign as f32 * q[face.axes[2]]);
        let [u, v] = [0, 1].map(|k| q[face.axes[k]] * w);
        let n = face.normal(face.cell(u, v, w), u, v, w)?;
        Some(face.to_camera(Vector3::from(n.map(f64::from))).map(|x| x as f32).into())
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
    let looks = Looks::new(view.camera, grid, samples);
    let step = looks.pixels * f64::from(super::pixel_angle(view));
    let face = |axes, sign, low: [f64; 2], high: [f64; 2]| {
        let size = [0, 1].map(|k| ((high[k] - low[k]) / step).ceil().clamp(1.0, 4096.0) as usize);
        Face { axes, sign, low, size, step, noise: 0.0, cells: [Vec::new(), Vec::new()] }
    };
    let faces = match view.camera.depth_kind() {
        Depth::AlongAxis => {
            let (low, high) = forward_field(view);
            vec![face([0, 1, 2], 1.0, low, high)]
        }
        Depth::Range => {
            let faces = (0..CUBE_FACES).map(cube_face);
            faces.map(|(axes, sign)| face(axes, sign, [-1.0; 2], [1.0; 2])).collect()
        }
    };
    (looks, faces)
}

impl Face {
    /// The number of a ray's cell, for an inverse depth above zero; a number that no cell has outside the grid.
    #[inline(always)]
    pub(crate) fn cell(&self, u: f32, v: f32, w: f32) -> u32 {
        let scale = 1.0 / self.step as f32;
        let (x, y) = (u * scale - self.low[0] as f32 * scale, v * scale - self.low[1] as f32 * scale);
        let [columns, rows] = self.size.map(|n| n as f32);
        let inside = (x >= 0.0) & (x < columns) & (y >= 0.0) & (y < rows) & (w > 0.0);
        let (x, y) = (if inside { x } else { 0.0 }, if inside { y } else { 0.0 });
        // SAFETY: both are between 0 and a side, which is at most 4096.
        let (column, row) = unsafe { (x.to_int_unchecked::<i32>(), y.to_int_unchecked::<i32>()) };
        if inside { row as u32 * self.size[0] as u32 + column as u32 } else { NOWHERE }
    }

    /// Asks the memory for a cell.
    #[inline(always)]
    pub(crate) fn fetch(&self, cell: u32) {
        super::fetch(&self.cells[0], cell);
    }

    /// The normal, of any length and sign and in this face's axes, of the surface on which the point of a ray lies; `None`
    /// where no plane was found near it.
    #[inline(always)]
    pub(crate) fn normal(&self, cell: u32, u: f32, v: f32, w: f32) -> Option<[f32; 3]> {
        let mut best = self.cells[0].get(cell as usize)?;
        let point = [u, v, w];
        let mut least = best.off(point);
        if best.has_second() {
            let second = &self.cells[1][cell as usize];
            if second.off(point) < least {
                (best, least) = (second, second.off(point));
            }
        }
        let (relative, sigmas) = OFF[0];
        if least <= (relative + sigmas * self.noise * w) * w { Some(best.normal()) } else { self.beside(cell, point) }
    }

    /// Of the planes in the neighbouring cells the one that the point lies on best, where it does: at edges a surface may
    /// take a small part of its cell only.
    #[cold]
    fn beside(&self, cell: u32, point: [f32; 3]) -> Option<[f32; 3]> {
        let [columns, rows] = self.size;
        let near = |at: usize, size: usize| at.saturating_sub(1)..(at + 2).min(size);
        let (relative, sigmas) = OFF[1];
        let (mut best, mut least) = (None, (relative + sigmas * self.noise * point[2]) * point[2]);
        for row in near(cell as usize / columns, rows) {
            for column in near(cell as usize % columns, columns) {
                for plane in [&self.cells[0][row * columns + column], &self.cells[1][row * columns + column]] {
                    if plane.off(point) <= least {
                        (best, least) = (Some(plane.normal()), plane.off(point));
                    }
                }
            }
        }
        best
    }

    /// The middle of a cell, (X, Y)/Z.
    #[inline(always)]
    pub(super) fn middle(&self, cell: [usize; 2]) -> [f64; 2] {
        [0, 1].map(|k| self.low[k] + (cell[k] as f64 + 0.5) * self.step)
    }

    /// From this face's axes into the camera frame.
    #[inline(always)]
    pub(super) fn to_camera(&self, p: Vector3<f64>) -> Vector3<f64> {
        let mut q = Vector3::zeros();
        q[self.axes[0]] = p.x;
        q[self.axes[1]] = p.y;
        q[self.axes[2]] = self.sign * p.z;
        q
    }
}
