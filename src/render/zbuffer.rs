//! Depth buffers: the nearest point in each pixel.
//!
//! A cell keeps the largest *inverse* depth that was put into it (of a plane it is an affine function of the undistorted
//! pixel position), merged by an atomic maximum: the order of the points, their chunks and the threads cannot be seen
//! in the result, and adding may go on from several threads at once. A [`DepthBuffer`] keeps where in the pixel the point
//! lies beside it, an [`IndexBuffer`] the point's index, and of equal depths the lower index.

use std::sync::atomic::{AtomicU32, AtomicU64, Ordering};

use rayon::prelude::*;

use super::sample::Sample;
use crate::error::{Error, Result};
#[cfg(target_arch = "x86_64")]
use crate::geometry::Registers;
use crate::geometry::{Block, BlockProjector, Frustum, LANES, Model, View};
use crate::memory::{fetched, fresh, zeros};

/// Points per task of the scheduler.
const TASK: usize = 16 * LANES;
/// How far ahead of its use a cell is fetched.
const AHEAD: usize = 24;
/// The widest band around the photo, pixels, that is kept too: what hides a point at the border may lie beyond it.
const MAX_MARGIN: usize = 32;
/// Cells beside the grid that are always there, so that neighbours can be asked for without looking.
pub(super) const PAD: usize = 3;
/// The largest inverse depth: what is nearer counts as this near, and sums stay finite.
const NEAREST: f64 = 1e30;
/// Where a point is not in the grid.
const NOWHERE: u32 = u32::MAX;

/// The cells of a buffer: the photo's pixels or equal parts of them, a margin around them, and a rim of [`PAD`] empty ones.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Grid {
    /// The photo's, cells.
    pub width: usize,
    /// The photo's, cells.
    pub height: usize,
    /// Cells beyond the photo's border, on all four sides.
    pub margin: usize,
    /// Whether the left and the right border are the same place.
    pub wraps: bool,
    /// Cells along a pixel's side, a power of two.
    pub fineness: usize,
}

impl Grid {
    /// The grid for a view, of pixels; refused where the machine could not count its cells.
    pub fn new(view: &View) -> Result<Self> {
        Self::finer(view, 1)
    }

    /// The same with so many cells along a pixel's side, a power of two.
    pub fn finer(view: &View, fineness: usize) -> Result<Self> {
        let (width, height) = (view.camera.width as usize, view.camera.height as usize);
        let wraps = view.camera.model() == Model::Equirectangular;
        let margin = MAX_MARGIN.min(width.max(height) / 16).min(width / 2).min(height);
        let [wide, high, margin] = [width, height, margin].map(|pixels| pixels * fineness);
        let grid = Self { width: wide, height: high, margin, wraps, fineness };
        if grid.stride().saturating_mul(grid.rows()) > i32::MAX as usize {
            return Err(Error::invalid(format!(
                "a photo of {width} × {height} pixels is too large for a depth buffer; make it smaller"
            )));
        }
        Ok(grid)
    }

    /// The grid of the pixels that these cells are parts of.
    pub fn pixels(&self) -> Self {
        let [width, height, margin] = [self.width, self.height, self.margin].map(|cells| cells / self.fineness);
        Self { width, height, margin, wraps: self.wraps, fineness: 1 }
    }

    /// The cell among [`Self::pixels`] that a cell, not of the rim, is a part of.
    pub fn pixel_of(&self, cell: usize) -> usize {
        if self.fineness == 1 {
            return cell;
        }
        let [row, column] = [cell / self.stride(), cell % self.stride()].map(|k| (k - PAD) / self.fineness + PAD);
        row * self.pixels().stride() + column
    }

    /// The nearest sample of each pixel: what a buffer of pixels would hold.
    pub(super) fn in_pixels(&self, samples: &[Sample]) -> Result<Vec<Sample>> {
        let (pixels, side, stride) = (self.pixels(), self.fineness, self.stride());
        let mut out: Vec<Sample> = fetched(pixels.len(), "a depth buffer")?;
        let used = pixels.first_row()..pixels.rows() - pixels.first_row();
        out.par_chunks_mut(pixels.stride()).enumerate().filter(|(y, _)| used.contains(y)).for_each(|(y, row)| {
            for j in 0..side {
                let first = ((y - PAD) * side + PAD + j) * stride + PAD;
                for (out, parts) in row[pixels.used_columns()].iter_mut().zip(samples[first..].chunks(side)) {
                    for (i, part) in parts.iter().enumerate() {
                        *out = (*out).max(part.of_pixel([i, j], side));
                    }
                }
            }
        });
        Ok(out)
    }

    /// Cells in a row, with margins and rim.
    pub fn stride(&self) -> usize {
        self.width + 2 * (self.margin + PAD)
    }

    /// Rows, with margins and rim.
    pub fn rows(&self) -> usize {
        self.height + 2 * (self.margin + PAD)
    }

    /// The first row that may hold a sample; there are as many rows after the last.
    pub(super) fn first_row(&self) -> usize {
        PAD
    }

    /// The columns that may hold a sample.
    pub(super) fn used_columns(&self) -> std::ops::Range<usize> {
        PAD..self.stride() - PAD
    }

    /// Fills the margin of a panorama: left and right are neighbours, and beyond a pole lies the other side.
    pub(super) fn wrap(&self, cells: &mut [Sample]) {
        if !self.wraps {
            return;
        }
        let (w, h, stride, start) = (self.width, self.height, self.stride(), self.margin + PAD);
        for y in start..start + h {
            let row = &mut cells[y * stride..(y + 1) * stride];
            for k in 0..self.margin {
                row[start - 1 - k] = row[start + w - 1 - k];
                row[start + w + k] = row[start + k];
            }
        }
        for k in 0..self.margin.min(h) {
            for x in self.used_columns() {
                let other = start + (x + 2 * w - start + w / 2) % w;
                cells[(start - 1 - k) * stride + x] = cells[(start + k) * stride + other].upside_down();
                cells[(start + h + k) * stride + x] = cells[(start + h - 1 - k) * stride + other].upside_down();
            }
        }
    }

    /// Cells, with margins and rim.
    pub fn len(&self) -> usize {
        self.stride() * self.rows()
    }

    /// A grid without a cell; there is none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The cell of a pixel of the photo.
    #[inline(always)]
    pub fn cell(&self, column: usize, row: usize) -> usize {
        (row + self.margin + PAD) * self.stride() + column + self.margin + PAD
    }

    /// The row and column of a cell.
    pub(super) fn row_and_column(&self, cell: u32) -> [usize; 2] {
        let stride = self.stride() as u32;
        [(cell / stride) as usize, (cell % stride) as usize]
    }

    /// The photo's part of a buffer's row.
    pub fn photo_row<'a, T>(&self, cells: &'a [T], row: usize) -> &'a [T] {
        let start = self.cell(0, row);
        &cells[start..start + self.width]
    }

    #[inline(always)]
    fn locate_here(&self, block: &Block, margin: usize, cells: &mut Located) {
        // Exact, as the fineness is a power of two.
        let side = self.fineness as f64;
        let (low, offset) = (-0.5 - margin as f64 / side, (self.margin + PAD) as f64 + 0.5 * side);
        let (right, below) = ((self.width + margin) as f64 / side - 0.5, (self.height + margin) as f64 / side - 0.5);
        let (last_x, last_y) = (
            (self.width + self.margin + PAD + margin - 1) as f64,
            (self.height + self.margin + PAD + margin - 1) as f64,
        );
        let stride = self.stride() as u32;
        for i in 0..LANES {
            let (x, y, depth) = (block.x[i], block.y[i], block.depth[i]);
            let inside = (x >= low) & (x < right) & (y >= low) & (y < below);
            let (x, y) = (side * x, side * y);
            // The sum may round up to the next cell, which must not lie beyond the last.
            let column = if inside { (x + offset).min(last_x) } else { 0.0 };
            let row = if inside { (y + offset).min(last_y) } else { 0.0 };
            // SAFETY: both are positive and below 2³², as the grid was checked at birth.
            let (column, row) =
                unsafe { (column.to_int_unchecked::<i32>() as u32, row.to_int_unchecked::<i32>() as u32) };
            cells.cell[i] = if inside { row * stride + column } else { NOWHERE };
            cells.right[i] = (x + offset - f64::from(column as i32)) as f32;
            cells.down[i] = (y + offset - f64::from(row as i32)) as f32;
            cells.inverse[i] = if inside { (1.0 / depth).min(NEAREST) as f32 } else { 0.0 };
        }
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    unsafe fn locate_avx512(&self, block: &Block, margin: usize, cells: &mut Located) {
        self.locate_here(block, margin, cells);
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    unsafe fn locate_avx2(&self, block: &Block, margin: usize, cells: &mut Located) {
        self.locate_here(block, margin, cells);
    }

    /// The cells of a block of projected points, as far as they lie in the photo widened by `margin` cells.
    pub fn locate(&self, block: &Block, margin: usize, cells: &mut Located) {
        #[cfg(target_arch = "x86_64")]
        match Registers::here() {
            // SAFETY: the processor has the features.
            Registers::Avx512 => return unsafe { self.locate_avx512(block, margin, cells) },
            // SAFETY: the processor has the feature.
            Registers::Avx2 => return unsafe { self.locate_avx2(block, margin, cells) },
            Registers::Any => {}
        }
        self.locate_here(block, margin, cells);
    }
}

/// Where the points of a block fall.
#[repr(align(64))]
pub struct Located {
    cell: [u32; LANES],
    inverse: [f32; LANES],
    /// Where in its cell the point lies, in [0, 1].
    right: [f32; LANES],
    down: [f32; LANES],
}

impl Located {
    /// Room for a block.
    pub fn new() -> Self {
        Self { cell: [NOWHERE; LANES], inverse: [0.0; LANES], right: [0.0; LANES], down: [0.0; LANES] }
    }

    /// The cell and inverse depth of a point; `None` beside the grid.
    #[inline(always)]
    pub fn get(&self, i: usize) -> Option<(usize, f32)> {
        (self.cell[i] != NOWHERE).then_some((self.cell[i] as usize, self.inverse[i]))
    }

    /// Where in its cell a point lies, right and down, in [0, 1].
    #[inline(always)]
    pub fn place(&self, i: usize) -> [f32; 2] {
        [self.right[i], self.down[i]]
    }

    /// The cell of a point that follows some way behind this one, to be fetched.
    #[inline(always)]
    pub(crate) fn ahead(&self, i: usize) -> u32 {
        self.cell[(i + AHEAD) % LANES]
    }

    /// The same, and the cell above or below it that is nearer to the point.
    #[inline(always)]
    pub(crate) fn ahead_with_row(&self, i: usize, stride: u32) -> (u32, u32) {
        let i = (i + AHEAD) % LANES;
        let cell = self.cell[i];
        (cell, if self.down[i] < 0.5 { cell.wrapping_sub(stride) } else { cell.wrapping_add(stride) })
    }

    /// Takes a point out.
    #[inline(always)]
    pub fn drop(&mut self, i: usize) {
        self.cell[i] = NOWHERE;
    }
}

impl Default for Located {
    fn default() -> Self {
        Self::new()
    }
}

/// Asks the memory for a cell that will be needed soon.
#[inline(always)]
pub(crate) fn fetch<T>(cells: &[T], cell: u32) {
    #[cfg(target_arch = "x86_64")]
    if let Some(cell) = cells.get(cell as usize) {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        // SAFETY: a reference is a valid address, and fetching changes nothing.
        unsafe { _mm_prefetch::<_MM_HINT_T0>(std::ptr::from_ref(cell).cast()) };
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = (cells, cell);
}

/// Calls `put(located, indices)` for every block of points that may meet the grid, in parallel.
fn scatter(view: &View, grid: &Grid, xyz: &[[f64; 3]], put: impl Fn(&Located, std::ops::Range<usize>) + Sync) {
    let (projector, frustum) = (BlockProjector::new(view), Frustum::new(view, grid.pixels().margin as f64));
    xyz.par_chunks(TASK).enumerate().filter(|(_, points)| frustum.meets(points)).for_each(|(task, points)| {
        let (mut block, mut located) = (Block::new(), Located::new());
        for (k, points) in points.chunks(LANES).enumerate() {
            projector.project(points, &mut block);
            grid.locate(&block, grid.margin, &mut located);
            let first = task * TASK + k * LANES;
            put(&located, first..first + points.len());
        }
    });
}

/// The nearest depth in each pixel, or in each of its parts.
pub struct DepthBuffer {
    view: View,
    grid: Grid,
    /// [`Sample`]s.
    cells: Vec<AtomicU32>,
}

impl DepthBuffer {
    /// An empty buffer of pixels.
    pub fn new(view: View) -> Result<Self> {
        Self::finer(view, 1)
    }

    /// An empty buffer with so many cells along a pixel's side, a power of two.
    pub fn finer(view: View, fineness: usize) -> Result<Self> {
        let grid = Grid::finer(&view, fineness)?;
        let cells = zeros(grid.len(), "a depth buffer")?;
        Ok(Self { view, grid, cells })
    }

    /// Puts points in. May be called from several threads at once, in any order.
    pub fn add(&self, xyz: &[[f64; 3]]) {
        scatter(&self.view, &self.grid, xyz, |located, points| {
            for i in 0..points.len() {
                fetch(&self.cells, located.ahead(i));
                if let Some((cell, inverse)) = located.get(i) {
                    let sample = Sample::new(inverse, located.place(i));
                    let cell = &self.cells[cell];
                    if cell.load(Ordering::Relaxed) < sample.0 {
                        cell.fetch_max(sample.0, Ordering::Relaxed);
                    }
                }
            }
        });
    }

    /// The view.
    pub fn view(&self) -> &View {
        &self.view
    }

    /// How its cells lie.
    pub fn grid(&self) -> Grid {
        self.grid
    }

    /// The samples.
    pub fn into_samples(self) -> Vec<Sample> {
        let mut cells = std::mem::ManuallyDrop::new(self.cells);
        let (start, length, room) = (cells.as_mut_ptr().cast::<Sample>(), cells.len(), cells.capacity());
        // SAFETY: the vector's own parts, which nobody else frees; both types are a u32 in memory. A walk over a hundred
        // megabytes would change none of them.
        unsafe { Vec::from_raw_parts(start, length, room) }
    }
}

/// The nearest depth in each pixel, and the index of the point that has it.
pub struct IndexBuffer {
    view: View,
    grid: Grid,
    /// Inverse depth above, the complement of the index below: the larger is the nearer, then the lower index.
    cells: Vec<AtomicU64>,
}

impl IndexBuffer {
    /// An empty buffer.
    pub fn new(view: View) -> Result<Self> {
        let grid = Grid::new(&view)?;
        let cells = zeros(grid.len(), "a depth buffer")?;
        Ok(Self { view, grid, cells })
    }

    /// Puts points in, of which the first has the given index in its cloud. May be called from several threads at
    /// once, in any order. Refused from 2³² − 1 points on.
    pub fn add(&self, xyz: &[[f64; 3]], first: u64) -> Result<()> {
        if first + xyz.len() as u64 > u64::from(u32::MAX) {
            return Err(Error::invalid(format!("an index buffer holds {} points at most", u32::MAX)));
        }
        scatter(&self.view, &self.grid, xyz, |located, points| {
            for i in 0..points.len() {
                fetch(&self.cells, located.ahead(i));
                if let Some((cell, inverse)) = located.get(i) {
                    let index = (first + (points.start + i) as u64) as u32;
                    let bits = u64::from(inverse.to_bits()) << 32 | u64::from(!index);
                    let cell = &self.cells[cell];
                    if inverse > 0.0 && cell.load(Ordering::Relaxed) < bits {
                        cell.fetch_max(bits, Ordering::Relaxed);
                    }
                }
            }
        });
        Ok(())
    }

    /// The view.
    pub fn view(&self) -> &View {
        &self.view
    }

    /// How its cells lie.
    pub fn grid(&self) -> Grid {
        self.grid
    }

    /// Samples of the inverse depths, of points at their pixels' centres.
    pub(super) fn samples(&self) -> Vec<Sample> {
        let mut samples: Vec<Sample> = fresh(self.cells.len());
        samples.par_iter_mut().zip(&self.cells).with_min_len(1 << 14).for_each(|(sample, cell)| {
            let inverse = nearest_of(cell.load(Ordering::Relaxed)).0;
            if inverse > 0.0 {
                *sample = Sample::new(inverse, [0.5, 0.5]);
            }
        });
        samples
    }

    /// Copies cells of one row, from a column and a row of the photo on that may lie [`PAD`] beside it.
    pub(super) fn copy_row(&self, row: isize, column: isize, out: &mut [u64]) {
        let start = self.grid.cell(0, 0) as isize + row * self.grid.stride() as isize + column;
        for (out, cell) in out.iter_mut().zip(&self.cells[start as usize..]) {
            *out = cell.load(Ordering::Relaxed);
        }
    }
}

/// The inverse depth, 0 in an empty cell, and the index that a cell of an [`IndexBuffer`] holds.
#[inline(always)]
pub(super) fn nearest_of(cell: u64) -> (f32, u32) {
    (f32::from_bits((cell >> 32) as u32), !(cell as u32))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Camera, Pose};

    fn scattered(count: usize) -> Vec<[f64; 3]> {
        let mut state = 11_u32;
        let mut random = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            f64::from(state >> 8) / f64::from(1 << 24) - 0.5
        };
        (0..count).map(|_| [12.0 * random(), 8.0 * random(), 6.0 * random()]).collect()
    }

    #[test]
    fn parts_of_pixels_hold_what_pixels_hold() {
        let pinhole = Camera::new(Model::Pinhole, 96, 64, &[70.0, 71.0, 47.3, 31.9]).unwrap();
        let panorama = Camera::new(Model::Equirectangular, 128, 64, &[]).unwrap();
        let points = scattered(20_000);
        for camera in [pinhole, panorama] {
            let view = View { camera, pose: Pose::identity() };
            let [pixels, parts] = [1, 4].map(|fineness| {
                let buffer = DepthBuffer::finer(view, fineness).unwrap();
                buffer.add(&points);
                let grid = buffer.grid();
                let mut samples = buffer.into_samples();
                grid.wrap(&mut samples);
                (grid, samples)
            });
            assert_eq!(parts.0.pixels(), pixels.0);
            assert!(parts.0.in_pixels(&parts.1).unwrap() == pixels.1);
            for (row, column) in [(0, 0), (63, 95), (17, 40)] {
                let part = parts.0.cell(4 * column + 3, 4 * row + 1);
                assert_eq!(parts.0.pixel_of(part), pixels.0.cell(column, row));
            }
        }
    }
}
