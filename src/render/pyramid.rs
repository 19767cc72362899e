//! The foremost samples of a depth buffer in cells of growing width: where to look for neighbours that are far away.

use rayon::prelude::*;

use crate::memory::fresh;

use super::marks::MAX_REACH;
use super::sample::Sample;
use super::zbuffer::Grid;

/// Cells that are looked at on each side, at every level.
const WINDOW: isize = 3;

/// Cells of the buffer, on each side, that are left out together where nobody looks: the widest cells of a pyramid.
const SIDE: usize = MAX_REACH / 2;

/// Cells of growing width, each with the foremost sample below it, where somebody will look.
pub(super) struct Pyramid {
    level: u32,
    stride: usize,
    rows: usize,
    asked: Vec<Vec<bool>>,
    /// The cell of the buffer, 0 for none.
    front: Vec<u32>,
}

/// Cells of a level that are looked at on each side.
#[inline(always)]
fn window(reach: f32, level: u32) -> isize {
    WINDOW.min((reach as isize >> level) + 1)
}

impl Pyramid {
    /// The buffer itself, to be looked at from these cells as far as `reach`.
    pub fn new(grid: &Grid, from: impl Iterator<Item = u32>, reach: f32) -> Self {
        let (stride, rows) = (grid.stride(), grid.rows());
        let levels = 1..=SIDE.ilog2();
        let cells = levels.map(|level| (window(reach, level) as usize + 1) << level).max().unwrap_or(0);
        let around = cells.div_ceil(SIDE);
        let (across, down) = (stride.div_ceil(SIDE), rows.div_ceil(SIDE));
        let mut there = vec![vec![false; across]; down];
        for cell in from {
            let [row, column] = grid.row_and_column(cell);
            there[row / SIDE][column / SIDE] = true;
        }
        let mut asked = vec![vec![false; across]; down];
        for (y, row) in there.iter().enumerate() {
            for x in (0..across).filter(|&x| row[x]) {
                for asked in &mut asked[y.saturating_sub(around)..(y + around + 1).min(down)] {
                    asked[x.saturating_sub(around)..(x + around + 1).min(across)].fill(true);
                }
            }
        }
        Self { level: 0, stride, rows, asked, front: Vec::new() }
    }

    /// One level up.
    pub fn coarsen(&mut self, samples: &[Sample]) {
        let (stride, rows) = (self.stride.div_ceil(2), self.rows.div_ceil(2));
        let mut front = fresh::<u32>(stride * rows);
        let (old, old_stride, old_rows, base) = (&self.front, self.stride, self.rows, self.level == 0);
        let side = SIDE >> (self.level + 1);
        front.par_chunks_mut(stride).enumerate().for_each(|(y, row)| {
            let asked = &self.asked[y / side];
            let places = row.chunks_mut(side).zip(asked).enumerate().filter(|(_, (_, asked))| **asked);
            let cells = places.flat_map(|(k, (cells, _))| (k * side..).zip(cells));
            for (x, best) in cells {
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
        (self.level, self.stride, self.rows, self.front) = (self.level + 1, stride, rows, front);
    }

    /// The foremost samples in the cells around a position, as far as `reach` asks for.
    #[inline(always)]
    pub fn around(&self, x: isize, y: isize, reach: f32, mut see: impl FnMut(u32)) {
        let (cx, cy) = (x >> self.level, y >> self.level);
        let window = window(reach, self.level);
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_is_announced_sees_what_a_whole_pyramid_shows() {
        let camera = crate::Camera::new(crate::Model::Pinhole, 400, 300, &[300.0, 300.0, 199.5, 149.5]).unwrap();
        let grid = Grid::new(&crate::View { camera, pose: crate::Pose::identity() }).unwrap();
        let mut state = 7_u32;
        let mut random = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            state >> 8
        };
        let samples: Vec<Sample> =
            (0..grid.len()).map(|_| Sample(if random() % 9 == 0 { random() } else { 0 })).collect();
        let announced = [[3, 3], [40, 200], [grid.rows() - 4, grid.stride() - 4]];
        let cell = |[row, column]: [usize; 2]| (row * grid.stride() + column) as u32;
        for reach in [0.0, 8.0, 32.0, 64.0] {
            let mut whole = Pyramid::new(&grid, (0..grid.len() as u32).step_by(5), reach);
            let mut part = Pyramid::new(&grid, announced.into_iter().map(cell), reach);
            for _ in 0..SIDE.ilog2() {
                whole.coarsen(&samples);
                part.coarsen(&samples);
                for [row, column] in announced {
                    let seen = |pyramid: &Pyramid| {
                        let mut seen = Vec::new();
                        pyramid.around(column as isize, row as isize, reach, |cell| seen.push(cell));
                        seen
                    };
                    assert!(seen(&part) == seen(&whole) && !seen(&whole).is_empty(), "{reach} {row} {column}");
                }
            }
        }
    }
}
