//! Flat places: tiles of a depth buffer whose samples, and those around, all lie on one plane and leave no gap. One plane
//! then says for the whole tile what hides, as well as a plane for each sample does, and nothing has to be looked for or
//! drawn for any of them. Most of a building is flat.

use super::extremes::larger;
use super::marks::{Canvas, Rule};
use super::sample::Sample;
use super::zbuffer::{Grid, PAD};

/// Cells of a block: what is flat is told for each.
pub(super) const BLOCK: usize = 8;
/// Cells around a tile that have to lie on its plane too, so that what stands before it or ends it is not near.
const AROUND: usize = 4;
/// How many of these the plane is drawn over: the samples of the tile would have covered them.
const BEYOND: usize = 2;
/// The widest tile and its window; one that is not flat is looked at in blocks.
const TILE: usize = 2 * BLOCK;
const WIDE: usize = TILE + 2 * AROUND;
const NARROW: usize = BLOCK + 2 * AROUND;
/// What the misfit of a patch is of the noise of one inverse depth, on the average.
const MISFIT: f32 = 2.0;
/// How widely the samples of a fit have to lie, of the squares of both axes as they are for a full window.
const SPREAD: f64 = 0.25;

/// Which blocks of a band of rows are flat.
pub(super) struct Flat {
    first_row: usize,
    columns: usize,
    /// For each block its samples' spacing in quarters of a pixel; 0 where it is not flat.
    blocks: Vec<u8>,
}

/// The plane of a tile.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Plane {
    /// Inverse depth in the tile's middle.
    middle: f32,
    /// Its change by one cell.
    gradient: [f32; 2],
    slack: f32,
    /// Samples in each cell.
    fill: f32,
}

impl Flat {
    /// Finds the flat blocks of the canvas's own rows, and draws them.
    #[inline(always)]
    pub fn over(
        grid: &Grid,
        samples: &[Sample],
        rule: &Rule,
        rows: std::ops::Range<usize>,
        canvas: &mut Canvas<'_>,
    ) -> Self {
        let columns = (grid.stride() - 2 * PAD) / BLOCK;
        let mut this = Self { first_row: rows.start, columns, blocks: vec![0; columns * rows.len().div_ceil(BLOCK)] };
        for top in rows.clone().step_by(TILE) {
            for left in (PAD..PAD + columns * BLOCK).step_by(TILE) {
                if top + TILE <= rows.end && this.take::<TILE, WIDE>(grid, samples, rule, [top, left], canvas) {
                    continue;
                }
                for [down, right] in [[0, 0], [0, BLOCK], [BLOCK, 0], [BLOCK, BLOCK]] {
                    if top + down < rows.end {
                        this.take::<BLOCK, NARROW>(grid, samples, rule, [top + down, left + right], canvas);
                    }
                }
            }
        }
        this
    }

    /// Takes a tile for flat, if it is.
    #[inline(always)]
    fn take<const SIDE: usize, const WINDOW: usize>(
        &mut self,
        grid: &Grid,
        samples: &[Sample],
        rule: &Rule,
        [top, left]: [usize; 2],
        canvas: &mut Canvas<'_>,
    ) -> bool {
        let stride = grid.stride();
        if top < AROUND || left < AROUND || top + SIDE + AROUND > grid.rows() || left + SIDE + AROUND > stride {
            return false;
        }
        let start = (top - AROUND) * stride + left - AROUND;
        let Some(plane) = plane::<WINDOW>(&samples[start..], stride, rule) else { return false };
        canvas.fill::<SIDE>(stride, [top, left], &plane);
        let code = (4.0 / plane.fill.sqrt() + 1.0) as u8;
        for y in (top - self.first_row) / BLOCK..(top + SIDE - self.first_row).div_ceil(BLOCK) {
            for x in (left - PAD) / BLOCK..((left - PAD + SIDE) / BLOCK).min(self.columns) {
                self.blocks[y * self.columns + x] = code;
            }
        }
        true
    }

    /// The blocks of a row, from left to right: the spacing code of those that are flat, 0 for the others.
    pub fn row(&self, row: usize) -> &[u8] {
        &self.blocks[(row - self.first_row) / BLOCK * self.columns..][..self.columns]
    }
}

/// The plane of a window's samples, if all lie on it and there are enough. `samples` begins with the window's first cell.
#[inline(always)]
fn plane<const WINDOW: usize>(samples: &[Sample], stride: usize, rule: &Rule) -> Option<Plane> {
    let rows: [&[Sample; WINDOW]; WINDOW] = {
        let mut rows = [const { &[Sample(0); WINDOW] }; WINDOW];
        for (y, row) in rows.iter_mut().enumerate() {
            *row = samples[y * stride..].first_chunk()?;
        }
        rows
    };
    if !covered(&rows) {
        return None;
    }
    let reference = rows[WINDOW / 2 - 1..].iter().flat_map(|row| row.iter()).find(|s| s.found())?.inverse_depth();
    let half = 0.5 * (WINDOW - 1) as f32;
    // A wide window has more samples than its plane needs; all of them are compared with it.
    let every = if WINDOW > NARROW { 2 } else { 1 };
    let mut sums = [[0.0_f32; BLOCK]; 9];
    for y in (0..WINDOW).step_by(every) {
        for x in (0..WINDOW).step_by(BLOCK) {
            for l in 0..BLOCK {
                let sample = rows[y][x + l];
                let [right, down] = sample.place();
                let (dx, dy) = (x as f32 - half + l as f32 + right, y as f32 - half + down);
                let dw = sample.inverse_depth() - reference;
                let n = if sample.found() { 1.0 } else { 0.0 };
                let (nx, ny, nw) = (n * dx, n * dy, n * dw);
                let products = [n, nx, ny, nw, nx * dx, nx * dy, ny * dy, nx * dw, ny * dw];
                for k in 0..9 {
                    sums[k][l] += products[k];
                }
            }
        }
    }
    let [n, x, y, w, xx, xy, yy, xw, yw] = sums.map(|lanes| lanes.iter().map(|&v| f64::from(v)).sum::<f64>());
    let (x, y, w) = (x / n, y / n, w / n);
    let (xx, xy, yy, xw, yw) = (xx / n - x * x, xy / n - x * y, yy / n - y * y, xw / n - x * w, yw / n - y * w);
    let det = xx * yy - xy * xy;
    // What it is for samples everywhere in the window.
    let whole = (WINDOW as f64).powi(4) / 144.0;
    if det.is_nan() || det < SPREAD * whole {
        return None;
    }
    let gradient = [(yy * xw - xy * yw) / det, (xx * yw - xy * xw) / det];
    let middle = w - gradient[0] * x - gradient[1] * y;
    let ([gx, gy], own) = (gradient.map(|g| g as f32), reference + middle as f32);
    let slack = rule.slack(own, [gx, gy], MISFIT * rule.noise_at(own) * own * own);
    let mut most = [0.0_f32; BLOCK];
    for y in 0..WINDOW {
        for x in (0..WINDOW).step_by(BLOCK) {
            let start = own + gx * (x as f32 - half) + gy * (y as f32 - half);
            for l in 0..BLOCK {
                let sample = rows[y][x + l];
                let [right, down] = sample.place();
                let off = sample.inverse_depth() - (start + gx * (l as f32 + right) + gy * down);
                most[l] = larger(if sample.found() { off.abs() } else { 0.0 }, most[l]);
            }
        }
    }
    let flat = most.iter().all(|&off| off <= slack);
    let fill = (n as f32) * every as f32 / (WINDOW * WINDOW) as f32;
    flat.then_some(Plane { middle: own, gradient: [gx, gy], slack, fill })
}

/// Whether there is a sample within two cells, to the sides and up and down, of each cell of a window but its two outermost.
#[inline(always)]
fn covered<const WINDOW: usize>(rows: &[&[Sample; WINDOW]; WINDOW]) -> bool {
    let mut wide = [0_u32; WINDOW];
    for (wide, row) in wide.iter_mut().zip(rows) {
        let bits = found_bits(row);
        *wide = bits | bits << 1 | bits << 2 | bits >> 1 | bits >> 2;
    }
    let all = (2..WINDOW - 2)
        .fold(u32::MAX, |all, y| all & (wide[y - 2] | wide[y - 1] | wide[y] | wide[y + 1] | wide[y + 2]));
    let inner = ((1_u32 << (WINDOW - 4)) - 1) << 2;
    all & inner == inner
}

/// Which cells of a row hold a sample, the first in the lowest bit.
#[inline(always)]
fn found_bits<const WINDOW: usize>(row: &[Sample; WINDOW]) -> u32 {
    let mut bits = 0_u32;
    for (k, block) in row.as_chunks::<BLOCK>().0.iter().enumerate() {
        bits |= u32::from(!Sample::empty(block)) << (BLOCK * k);
    }
    bits
}

impl Canvas<'_> {
    /// Draws a tile's plane over it and a little beyond.
    #[inline(always)]
    fn fill<const SIDE: usize>(&mut self, stride: usize, [top, left]: [usize; 2], plane: &Plane) {
        let Plane { middle, gradient: [gx, gy], slack, .. } = *plane;
        let half = 0.5 * (SIDE - 1) as f32;
        let last = self.first_row + self.cells.len() / stride;
        for row in (top - BEYOND).max(self.first_row)..(top + SIDE + BEYOND).min(last) {
            let start = middle - slack + gy * (row as f32 - top as f32 - half) - gx * (half + BEYOND as f32);
            let cells = &mut self.cells[(row - self.first_row) * stride + left - BEYOND..][..SIDE + 2 * BEYOND];
            for (x, cell) in cells.iter_mut().enumerate() {
                *cell = larger(start + gx * x as f32, *cell);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: [usize; 2] = [160, 96];
    const NOISE: f32 = 0.002;

    fn grid() -> Grid {
        let [width, height] = SIZE;
        let camera = crate::Camera::new(crate::Model::Pinhole, 160, 96, &[120.0, 120.0, 79.5, 47.5]).unwrap();
        let grid = Grid::new(&crate::View { camera, pose: crate::Pose::identity() }).unwrap();
        assert_eq!([grid.width, grid.height], [width, height]);
        grid
    }

    fn rule() -> Rule {
        Rule { tolerance: None, inner: 0.9, pixel_angle: 1.0 / 120.0, noise: NOISE, wide_noise: 0.0 }
    }

    /// Samples of what `inverse(column, row)` says of the grid's cells, half of which have one; which blocks of all rows are
    /// flat, and the limits; behind the grid and the samples themselves.
    fn found(inverse: impl Fn(f32, f32) -> Option<f32>) -> (Grid, Vec<Sample>, Vec<Vec<bool>>, Vec<f32>) {
        let grid = grid();
        let mut state = 7_u32;
        let mut random = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) as f32 / (1 << 24) as f32
        };
        let mut samples = vec![Sample::default(); grid.len()];
        let rows = grid.first_row()..grid.rows() - grid.first_row();
        for y in rows.clone() {
            for x in grid.used_columns() {
                let [right, down, noise] = [random(), random(), 3.46 * (random() - 0.5)];
                let there = random() < 0.5;
                if let Some(w) = inverse(x as f32 + right - 0.5, y as f32 + down - 0.5).filter(|_| there) {
                    samples[y * grid.stride() + x] = Sample::new(w + NOISE * w * w * noise, [right, down]);
                }
            }
        }
        let mut limit = vec![0.0; grid.len()];
        let mut canvas = Canvas { first_row: 0, cells: &mut limit };
        let flat = Flat::over(&grid, &samples, &rule(), rows.clone(), &mut canvas);
        let blocks = rows.step_by(BLOCK).map(|y| flat.row(y).iter().map(|&code| code > 0).collect()).collect();
        (grid, samples, blocks, limit)
    }

    /// Whether a block is flat, by a cell in it.
    fn flat_at(blocks: &[Vec<bool>], x: usize, y: usize) -> bool {
        blocks[(y - PAD) / BLOCK][(x - PAD) / BLOCK]
    }

    #[test]
    fn a_slanted_wall_is_flat_and_hides_what_is_behind_it_but_no_sample_of_its_own() {
        let wall = |x: f32, y: f32| 0.1 + 1e-4 * x - 5e-5 * y;
        let (grid, samples, blocks, limit) = found(|x, y| Some(wall(x, y)));
        let inner = |n: usize| 1..n - 2;
        for row in inner(blocks.len()) {
            assert!(inner(blocks[0].len()).all(|column| blocks[row][column]), "{row}");
        }
        let slack = rule().slack(0.11, [1e-4, 5e-5], 2.0 * NOISE * 0.0121);
        for y in 2 * BLOCK..grid.rows() - 3 * BLOCK {
            for x in 2 * BLOCK..grid.stride() - 3 * BLOCK {
                let (cell, plane) = (y * grid.stride() + x, wall(x as f32, y as f32));
                assert!(limit[cell] < plane && limit[cell] > plane - 1.5 * slack, "{x} {y}");
                assert!(!samples[cell].found() || samples[cell].inverse_depth() >= limit[cell] - 1e-4, "{x} {y}");
            }
        }
    }

    #[test]
    fn edges_holes_and_what_stands_before_a_wall_are_not_flat() {
        let middle = (80.0, 56.0);
        let near = |x: f32, y: f32, r: f32| (x - middle.0).abs() < r && (y - middle.1).abs() < r;
        let step = found(|x, _| Some(if x < middle.0 { 0.1 } else { 0.101 })).2;
        let hole = found(|x, y| (!near(x, y, 6.0)).then_some(0.1)).2;
        // Large enough that one of its cells has a sample.
        let bolt = found(|x, y| Some(if near(x, y, 1.5) { 0.11 } else { 0.1 })).2;
        for (name, blocks) in [("step", step), ("hole", hole), ("bolt", bolt)] {
            for x in [middle.0 as usize - AROUND, middle.0 as usize + AROUND - 1] {
                assert!(!flat_at(&blocks, x, middle.1 as usize), "{name} {x}");
            }
            assert!(flat_at(&blocks, 40, 40) && flat_at(&blocks, 120, 40), "{name}");
        }
    }

    #[test]
    fn samples_whose_rows_tell_no_slope_give_no_plane() {
        // The fit looks at every other row, and of these only one holds samples, all at the same place in their pixels.
        let mut state = 3_u32;
        let mut random = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) as f32 / (1 << 24) as f32
        };
        for row in (0..WIDE).step_by(2).cycle().take(600) {
            let mut samples = vec![Sample::default(); WIDE * WIDE];
            for y in (0..WIDE).filter(|y| y % 2 == 1 || *y == row) {
                for x in 0..WIDE {
                    let noise = 3.46 * NOISE * 0.01 * (random() - 0.5);
                    if y % 2 == 1 || random() < 0.5 {
                        samples[y * WIDE + x] = Sample::new(0.1 + noise, [0.5, 0.5]);
                    }
                }
            }
            let found = plane::<WIDE>(&samples, WIDE, &rule());
            assert!(found.is_none(), "{found:?}");
        }
    }

    #[test]
    fn leaves_and_sparse_walls_are_not_flat() {
        let leaves = found(|x, y| Some(0.1 + 0.01 * ((13.7 * x).sin() * (7.3 * y).cos()))).2;
        let sixth = |v: f32| (v as usize).is_multiple_of(6);
        let sparse = found(|x, y| (sixth(x) && sixth(y)).then_some(0.1)).2;
        assert!(leaves.iter().chain(&sparse).flatten().all(|&flat| !flat));
    }
}
