//! The foremost samples of a depth buffer in cells of growing width: where to look for neighbours that are far away.

use rayon::prelude::*;

use super::sample::Sample;
use super::zbuffer::Grid;

/// Cells that are looked at on each side, at every level.
const WINDOW: isize = 3;

/// Cells of growing width, each with the foremost sample below it.
pub(super) struct Pyramid {
    level: u32,
    stride: usize,
    rows: usize,
    /// The cell of the buffer, 0 for none.
    front: Vec<u32>,
}

impl Pyramid {
    /// The buffer itself.
    pub fn new(grid: &Grid) -> Self {
        Self { level: 0, stride: grid.stride(), rows: grid.rows(), front: Vec::new() }
    }

    /// One level up.
    pub fn coarsen(&mut self, samples: &[Sample]) {
        let (stride, rows) = (self.stride.div_ceil(2), self.rows.div_ceil(2));
        let mut front = vec![0_u32; stride * rows];
        let (old, old_stride, old_rows, base) = (&self.front, self.stride, self.rows, self.level == 0);
        front.par_chunks_mut(stride).enumerate().for_each(|(y, row)| {
            for (x, best) in row.iter_mut().enumerate() {
                for cy in 2 * y..(2 * y + 2).min(old_rows) {
                    for cx in 2 * x..(2 * x + 2).min(old_stride) {
                        let cell = cy * old_stride + cx;
                        let candidate = if base { cell as u32 } else { old[cell] };
                        if samples[candidate as usize] > samples[*best as usize] {
                            *best = candidate;
                        }
                    }
                }
            }
        });
        *self = Self { level: self.level + 1, stride, rows, front };
    }

    /// The foremost samples in the cells around a position, as far as `reach` asks for.
    #[inline(always)]
    pub fn around(&self, x: isize, y: isize, reach: f32, mut see: impl FnMut(u32)) {
        let (cx, cy) = (x >> self.level, y >> self.level);
        let window = WINDOW.min((reach as isize >> self.level) + 1);
        let (left, right) = ((cx - window).max(0), (cx + window).min(self.stride as isize - 1));
        for row in (cy - window).max(0)..=(cy + window).min(self.rows as isize - 1) {
            let start = row as usize * self.stride;
            for &cell in &self.front[start + left as usize..=start + right as usize] {
                if cell != 0 {
                    see(cell);
                }
            }
        }
    }
}
