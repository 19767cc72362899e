//! What the pixels of a finished [`IndexBuffer`] show, row by row: the nearest point in each, or with *splats* the nearest
//! of those whose square covers it.
//!
//! The square of a point about its pixel holds another pixel exactly when that pixel's own square holds the point: points
//! are put in once, and the squares are a running maximum over the finished buffer, whatever the number of points.

use rayon::prelude::*;

use super::zbuffer::{Grid, IndexBuffer};
use crate::error::{Error, Result};

/// Rows that one task draws.
const BAND: usize = 32;
/// The largest splat, pixels: the grid has so many empty cells about it.
const LARGEST: usize = 2 * super::zbuffer::PAD + 1;

/// Squares of points, pixels on a side.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Splat(usize);

impl Splat {
    /// A point in its own pixel alone.
    pub const POINT: Self = Self(1);

    /// An odd number of pixels.
    pub fn new(size: usize) -> Result<Self> {
        if size.is_multiple_of(2) || size > LARGEST {
            return Err(Error::invalid(format!("a splat of {size} pixels is not an odd number up to {LARGEST}")));
        }
        Ok(Self(size))
    }
}

/// Calls `put(y, cells, row)` for every row of the photo with what its pixels show, in parallel; `row` is that of `rows`.
pub(super) fn each_row<R: Send>(
    buffer: &IndexBuffer,
    splat: Splat,
    rows: impl IndexedParallelIterator<Item = R>,
    put: impl Fn(usize, &[u64], R) + Sync,
) {
    let grid = buffer.grid();
    rows.enumerate()
        .fold_chunks_with(BAND, Window::new(&grid, splat), |mut window, (y, row)| {
            put(y, window.at(buffer, y), row);
            window
        })
        .for_each(drop);
}

/// The rows that a row of splats needs, and what came of them. A row is read from the buffer once.
#[derive(Clone)]
struct Window {
    grid: Grid,
    reach: usize,
    /// Cells of the rows from `next - 2·reach - 1` on, each in the place of its number modulo the height of the window.
    rows: Vec<Vec<u64>>,
    /// The first row that has not been read; rows are counted from `reach` above the photo.
    next: usize,
    column: Vec<u64>,
    out: Vec<u64>,
}

impl Window {
    fn new(grid: &Grid, Splat(size): Splat) -> Self {
        let reach = size / 2;
        let width = grid.width + 2 * reach;
        let rows = vec![vec![0; width]; size];
        Self { grid: *grid, reach, rows, next: usize::MAX, column: vec![0; width], out: vec![0; grid.width] }
    }

    /// What row `y` of the photo shows.
    fn at(&mut self, buffer: &IndexBuffer, y: usize) -> &[u64] {
        let size = self.rows.len();
        let first = if self.next == y + size - 1 { self.next } else { y };
        for row in first..y + size {
            self.read(buffer, row);
        }
        self.next = y + size;
        if size == 1 {
            return &self.rows[0];
        }
        self.column.copy_from_slice(&self.rows[0]);
        for row in &self.rows[1..] {
            raise(&mut self.column, row);
        }
        self.out.copy_from_slice(&self.column[..self.grid.width]);
        for shift in 1..size {
            raise(&mut self.out, &self.column[shift..]);
        }
        &self.out
    }

    fn read(&mut self, buffer: &IndexBuffer, row: usize) {
        let (grid, reach, size) = (self.grid, self.reach, self.rows.len());
        let cells = &mut self.rows[row % size];
        buffer.copy_row(row as isize - reach as isize, -(reach as isize), cells);
        if grid.wraps {
            // Left and right are neighbours.
            let width = grid.width;
            cells.copy_within(width..width + reach, 0);
            cells.copy_within(reach..2 * reach, width + reach);
        }
    }
}

/// Each of `cells` becomes the larger one. Inverse depths are positive, so that the sign does not matter; compared with it,
/// wide registers can do it.
fn raise(cells: &mut [u64], others: &[u64]) {
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("avx2") {
        // SAFETY: the processor has the feature.
        return unsafe { raise_avx2(cells, others) };
    }
    raise_here(cells, others);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
unsafe fn raise_avx2(cells: &mut [u64], others: &[u64]) {
    raise_here(cells, others);
}

#[inline(always)]
fn raise_here(cells: &mut [u64], others: &[u64]) {
    for (cell, other) in cells.iter_mut().zip(others) {
        *cell = (*cell as i64).max(*other as i64) as u64;
    }
}
