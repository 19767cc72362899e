//! What one sample of a depth buffer covers: a quarter of an ellipse in each of four quadrants, on the plane through the
//! sample and its neighbours.

use super::extremes::{larger, smaller};
use super::links::LANES;
use super::patch::{Patch, QUADRANTS};
use super::zbuffer::Grid;

/// The farthest that a mark reaches, rows.
pub(super) const MAX_REACH: usize = 64;
/// How far beyond its last sample a surface reaches, as a part of the distance to the neighbour before it: up to one whole
/// distance is possible, and what is behind the rim would be coloured when it is taken for less.
const OUTER: f32 = 0.9;
/// The least that a sample covers, cells.
const LEAST: f32 = 0.1;

/// What is believed of the noise in wide windows, as a part of the depth: a third of a percent is a bad depth camera's.
const MOST_WIDE_NOISE: f32 = 1.0 / 300.0;

/// How a surface becomes a mark.
pub(super) struct Rule {
    /// What is in front by less than this part of the depth hides nothing; `None` for what the noise suggests.
    pub tolerance: Option<f32>,
    /// How far a sample covers towards a neighbour, as a part of the distance to it.
    pub inner: f32,
    /// Radians that a cell spans.
    pub pixel_angle: f32,
    /// Sigma of a depth, in the cloud's unit, against the nearest neighbours.
    pub noise: f32,
    /// The same against planes through wide windows, which tells the noise of depths that come in steps, as a depth
    /// camera's do; and takes the relief of a sparse scan for noise.
    pub wide_noise: f32,
}

/// What a sample covers, and how near that is.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Mark {
    /// Where the sample lies against its cell's centre, right and down.
    place: [f32; 2],
    /// Inverse depth of the surface at the sample.
    own: f32,
    /// Its change by one cell, right and down.
    gradient: [f32; 2],
    /// By how much something has to be behind it to be hidden.
    slack: f32,
    /// How much more for each cell of distance.
    fading: f32,
    /// One by the cells that it covers to the east, south, west and north.
    per: [f32; QUADRANTS],
    /// Whole cells that it reaches from the sample's own, in the same order.
    cells: [f32; QUADRANTS],
}

impl Rule {
    /// Sigma of a depth, in the cloud's unit, of a surface with this inverse depth.
    #[inline(always)]
    pub fn noise_at(&self, own: f32) -> f32 {
        larger(self.noise, smaller(self.wide_noise, MOST_WIDE_NOISE / own))
    }

    /// By how much something has to be behind a surface with this inverse depth and its change by one cell to be hidden.
    #[inline(always)]
    pub fn slack(&self, own: f32, [gx, gy]: [f32; 2], misfit: f32) -> f32 {
        let noise = self.noise_at(own);
        // Noise moves a point not only along the ray: across it, on a slope, it does as much.
        let across = 0.5 + smaller(1.5 * noise * own / self.pixel_angle, 2.0);
        let floor = self.tolerance.unwrap_or(1e-4 + 3.0 * noise * own) + 0.3 * self.pixel_angle;
        own * floor + 0.25 * misfit + across * (gx.abs() + gy.abs())
    }

    /// What a sample covers.
    #[inline(always)]
    pub fn mark(&self, patch: &Patch) -> Mark {
        let [gx, gy] = patch.gradient();
        let own = patch.own + patch.lift([gx, gy]);
        let slack = self.slack(own, [gx, gy], patch.misfit());
        let spacing = patch.spacing();
        let spacing = if spacing < f32::INFINITY { spacing } else { 0.0 };
        let mut covered = [0.0_f32; QUADRANTS];
        for (k, covered) in covered.iter_mut().enumerate() {
            let (link, opposite) = (&patch.links[k], &patch.links[(k + 2) % QUADRANTS]);
            let end = OUTER * if opposite.found() { opposite.distance } else { spacing };
            let reach = if link.found() { self.inner * link.distance } else { end };
            *covered = smaller(larger(reach, LEAST), MAX_REACH as f32 - 1.0);
        }
        let ([east, south, west, north], [right, down]) = (covered, patch.place);
        Mark {
            place: patch.place,
            own,
            gradient: [gx, gy],
            slack,
            fading: own * self.pixel_angle,
            per: covered.map(|c| 1.0 / c),
            cells: [east + right, south + down, west - right, north - down],
        }
    }
}

/// Marks side by side, as wide registers leave them.
#[repr(align(32))]
pub(super) struct Marks {
    numbers: [[f32; LANES]; NUMBERS],
}

/// Numbers in a mark.
const NUMBERS: usize = 7 + 2 * QUADRANTS;

impl Marks {
    /// Room for them.
    pub fn new() -> Self {
        Self { numbers: [[0.0; LANES]; NUMBERS] }
    }

    /// Keeps one.
    #[inline(always)]
    pub fn set(&mut self, lane: usize, mark: &Mark) {
        let Mark { place: [right, down], own, gradient: [gx, gy], slack, fading, per, cells } = *mark;
        let ([e, s, w, n], [east, south, west, north]) = (per, cells);
        let numbers = [right, down, own, gx, gy, slack, fading, e, s, w, n, east, south, west, north];
        for (kept, number) in self.numbers.iter_mut().zip(numbers) {
            kept[lane] = number;
        }
    }

    /// Gives one back.
    #[inline(always)]
    pub fn get(&self, lane: usize) -> Mark {
        let [right, down, own, gx, gy, slack, fading, e, s, w, n, east, south, west, north] =
            std::array::from_fn(|k| self.numbers[k][lane]);
        let (per, cells) = ([e, s, w, n], [east, south, west, north]);
        Mark { place: [right, down], own, gradient: [gx, gy], slack, fading, per, cells }
    }
}

/// A part of the limits that one task may write into.
pub(super) struct Canvas<'a> {
    /// The grid's row that it begins with.
    pub first_row: usize,
    /// Whole rows.
    pub cells: &'a mut [f32],
}

impl Canvas<'_> {
    /// Draws what the sample in a row and column covers, where nothing nearer is drawn.
    #[inline(always)]
    pub fn draw(&mut self, grid: &Grid, [row, column]: [usize; 2], mark: &Mark) {
        let stride = grid.stride();
        let [right, down] = mark.place;
        let [per_east, per_south, per_west, per_north] = mark.per;
        // Not beyond the grid and the canvas.
        let [after, below, before, up] = mark.cells;
        let up = (up as i32).min((row - self.first_row) as i32).max(0) as isize;
        let below = (below as i32).min((self.first_row + self.cells.len() / stride - 1 - row) as i32).max(0) as isize;
        let before = (before as i32).min(column as i32).max(0) as usize;
        let after = (after as i32).min((stride - 1 - column) as i32).max(0) as usize;
        let home = (row - self.first_row) * stride + column;
        let mut first = 0;
        while first <= before + after {
            // Cells side by side: how far right, by the sample's own measure, and what of the plane does not change
            // from row to row. Beyond the last one everything is infinitely far.
            let (offset, last) = (first as f32 - before as f32, after as f32);
            let (mut dx2, mut rx2, mut value) = ([0.0_f32; LANES], [0.0_f32; LANES], [0.0_f32; LANES]);
            for l in 0..LANES {
                // Whole numbers, in one kind of register.
                let column = offset + l as f32;
                let dx = column - right;
                let rx = dx * if dx > 0.0 { per_east } else { per_west };
                dx2[l] = dx * dx;
                rx2[l] = if column <= last { rx * rx } else { f32::INFINITY };
                value[l] = mark.own + mark.gradient[0] * dx;
            }
            for j in -up..=below {
                let dy = j as f32 - down;
                let ry = dy * if dy > 0.0 { per_south } else { per_north };
                let (dy2, ry2, rise) = (dy * dy, ry * ry, mark.gradient[1] * dy);
                let start = (home as isize + j * stride as isize) as usize + first - before;
                let paint = |l: usize, limit: f32| {
                    let value = value[l] + rise - mark.slack - mark.fading * (dx2[l] + dy2).sqrt();
                    // Not by comparing: a store that depends on it is slow.
                    limit.max(if rx2[l] + ry2 <= 1.0 { value } else { 0.0 })
                };
                let cells = &mut self.cells[start..];
                // Plain loops: closures given to iterators are not compiled for the wide registers.
                if let Some(cells) = cells.first_chunk_mut::<LANES>() {
                    for l in 0..LANES {
                        cells[l] = paint(l, cells[l]);
                    }
                } else {
                    for l in 0..cells.len() {
                        cells[l] = paint(l, cells[l]);
                    }
                }
            }
            first += LANES;
        }
        // Its own cell is covered even where the sample lies in a corner of it.
        let (dx, dy) = (-right, -down);
        let value = mark.own + mark.gradient[0] * dx + mark.gradient[1] * dy
            - mark.slack
            - mark.fading * (dx * dx + dy * dy).sqrt();
        self.cells[home] = larger(value, self.cells[home]);
    }
}
