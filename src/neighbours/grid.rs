//! Square cells in the plane, their points side by side in memory.

use rayon::prelude::*;

use super::order::{by_counting, starts};
use super::{NONE, Neighbour};

/// Points per cell, on average, that are tried one after the other: points on lines crowd in few of the cells.
const POINTS_PER_CELL: [f64; 3] = [2.0, 0.5, 0.125];
/// The number of points in a point's own cell, on average over the points, that is good enough (evenly spread points
/// have one more than the points per cell), and the one above which they are so clustered that a tree is faster.
const CROWD: [f64; 2] = [6.0, 12.0];
/// Rings of cells that are searched before the query is given up.
const RINGS: usize = 6;
/// Below this number a tree is as fast, and builds faster.
const FEWEST: usize = 64;

pub(super) struct Grid {
    origin: [f64; 2],
    cell: f64,
    columns: usize,
    rows: usize,
    /// Of the points of each cell, row by row.
    start: Vec<u32>,
    xy: Vec<[f64; 2]>,
    index: Vec<u32>,
}

impl Grid {
    /// `None` where the points are few, or so clustered that a grid would be slow.
    pub fn new(points: &[[f64; 2]]) -> Option<Self> {
        if points.len() < FEWEST {
            return None;
        }
        let empty = [f64::INFINITY, f64::INFINITY, f64::NEG_INFINITY, f64::NEG_INFINITY];
        let larger = |a: [f64; 4], b: [f64; 4]| [a[0].min(b[0]), a[1].min(b[1]), a[2].max(b[2]), a[3].max(b[3])];
        let [x0, y0, x1, y1] = points
            .par_chunks(8192)
            .map(|c| c.iter().fold(empty, |b, p| larger(b, [p[0], p[1], p[0], p[1]])))
            .reduce(|| empty, larger);
        let (width, height) = (x1 - x0, y1 - y0);
        let mut best = None;
        for per_cell in POINTS_PER_CELL {
            let cells = points.len() as f64 / per_cell;
            // Points on an axis-parallel line get a row of cells.
            let cell = (width * height / cells).sqrt().max(width.max(height) / cells);
            if !(cell.is_finite() && cell > 1e-12 * x0.abs().max(x1.abs()).max(y0.abs()).max(y1.abs())) {
                break;
            }
            let (columns, rows) = ((width / cell) as usize + 1, (height / cell) as usize + 1);
            let mut this =
                Self { origin: [x0, y0], cell, columns, rows, start: Vec::new(), xy: Vec::new(), index: Vec::new() };
            let keys = this.keys(points);
            this.start = starts(&keys, columns * rows);
            let crowd: f64 = this.start.windows(2).map(|w| f64::from(w[1] - w[0]).powi(2)).sum();
            let crowd = crowd / points.len() as f64;
            best = Some((this, keys, crowd));
            if crowd <= CROWD[0] {
                break;
            }
        }
        let (mut this, keys, _) = best.filter(|(_, _, crowd)| *crowd <= CROWD[1])?;
        let mut next = this.start.clone();
        this.xy = vec![[0.0; 2]; points.len()];
        this.index = vec![0; points.len()];
        for (i, &key) in keys.iter().enumerate() {
            let place = next[key as usize] as usize;
            next[key as usize] += 1;
            this.xy[place] = points[i];
            this.index[place] = i as u32;
        }
        Some(this)
    }

    /// The cell of a point, the nearest one for points outside.
    #[inline(always)]
    fn cell_of(&self, p: &[f64; 2]) -> (usize, usize) {
        // A conversion of floats to integers saturates, so that nothing can be out of range.
        let i = ((p[0] - self.origin[0]) / self.cell) as usize;
        let j = ((p[1] - self.origin[1]) / self.cell) as usize;
        (i.min(self.columns - 1), j.min(self.rows - 1))
    }

    fn keys(&self, points: &[[f64; 2]]) -> Vec<u32> {
        let key = |p: &[f64; 2]| {
            let (i, j) = self.cell_of(p);
            (j * self.columns + i) as u32
        };
        points.par_iter().with_min_len(4096).map(key).collect()
    }

    /// The order in which queries walk through the cells.
    pub fn order(&self, queries: &[[f64; 2]]) -> Vec<u32> {
        by_counting(&self.keys(queries), self.columns * self.rows)
    }

    /// Shows the points of some cells of one row to `visit`.
    #[inline(always)]
    fn scan(&self, j: usize, i0: usize, i1: usize, q: &[f64; 2], visit: &mut impl FnMut(Neighbour)) {
        let row = j * self.columns;
        let (from, to) = (self.start[row + i0] as usize, self.start[row + i1 + 1] as usize);
        for (p, &index) in self.xy[from..to].iter().zip(&self.index[from..to]) {
            let (dx, dy) = (p[0] - q[0], p[1] - q[1]);
            visit(Neighbour { index, distance2: dx * dx + dy * dy });
        }
    }

    /// The squared distance below which everything lies within `ring` cells of the query's own; infinite when these
    /// are all cells.
    #[inline(always)]
    fn covered2(&self, q: &[f64; 2], (i, j): (usize, usize), ring: usize) -> f64 {
        let mut near = f64::INFINITY;
        let mut side = |open: bool, distance: f64| {
            if open {
                near = near.min(distance);
            }
        };
        // What rounding may move across a border of cells is far less than this.
        let slack = 1e-9 * self.cell;
        let (x, y) = (q[0] - self.origin[0], q[1] - self.origin[1]);
        side(i > ring, x - (i as f64 - ring as f64) * self.cell - slack);
        side(j > ring, y - (j as f64 - ring as f64) * self.cell - slack);
        side(i + ring + 1 < self.columns, (i + ring + 1) as f64 * self.cell - x - slack);
        side(j + ring + 1 < self.rows, (j + ring + 1) as f64 * self.cell - y - slack);
        let near = near.max(0.0);
        near * near
    }

    /// Shows cells in growing rings to `visit` until `limit` is covered; false when it is not within [`RINGS`].
    #[inline(always)]
    fn search(&self, q: &[f64; 2], state: &mut impl Search) -> bool {
        let (ci, cj) = self.cell_of(q);
        // The first block of three by three at once, its middle row first.
        let (i0, i1) = (ci.saturating_sub(1), (ci + 1).min(self.columns - 1));
        self.scan(cj, i0, i1, q, &mut |n| state.visit(n));
        let y = q[1] - self.origin[1] - cj as f64 * self.cell;
        let slack = 1e-9 * self.cell;
        let (below, above) = ((y - slack).max(0.0), (self.cell - y - slack).max(0.0));
        if cj > 0 && below * below <= state.limit2() {
            self.scan(cj - 1, i0, i1, q, &mut |n| state.visit(n));
        }
        if cj + 1 < self.rows && above * above <= state.limit2() {
            self.scan(cj + 1, i0, i1, q, &mut |n| state.visit(n));
        }
        let mut ring = 1;
        loop {
            let covered2 = self.covered2(q, (ci, cj), ring);
            if covered2 > state.limit2() || covered2 == f64::INFINITY {
                return true;
            }
            if ring == RINGS {
                return false;
            }
            ring += 1;
            let (i0, i1) = (ci.saturating_sub(ring), (ci + ring).min(self.columns - 1));
            let (j0, j1) = (cj.saturating_sub(ring - 1), (cj + ring - 1).min(self.rows - 1));
            if cj >= ring {
                self.scan(cj - ring, i0, i1, q, &mut |n| state.visit(n));
            }
            if cj + ring < self.rows {
                self.scan(cj + ring, i0, i1, q, &mut |n| state.visit(n));
            }
            for j in j0..=j1 {
                if ci >= ring {
                    self.scan(j, i0, i0, q, &mut |n| state.visit(n));
                }
                if ci + ring < self.columns {
                    self.scan(j, i1, i1, q, &mut |n| state.visit(n));
                }
            }
        }
    }

    /// What is nearer than `best`; `None` where the grid cannot tell within a few rings.
    #[inline]
    pub fn nearest(&self, q: &[f64; 2], best: Neighbour) -> Option<Neighbour> {
        let mut best = Nearest(best);
        if !self.search(q, &mut best) {
            return None;
        }
        Some(if best.0.index == NONE { Neighbour::NONE } else { best.0 })
    }

    /// False where the grid cannot tell within a few rings.
    pub fn k_nearest(&self, q: &[f64; 2], limit2: f64, out: &mut [Neighbour]) -> bool {
        out.fill(Neighbour { index: NONE, distance2: limit2 });
        if !self.search(q, &mut Several(out)) {
            return false;
        }
        out.iter_mut().filter(|n| n.index == NONE).for_each(|n| *n = Neighbour::NONE);
        true
    }

    /// False where the distance is of many cells.
    pub fn within(&self, q: &[f64; 2], distance: f64, out: &mut Vec<Neighbour>) -> bool {
        let reach = distance * (1.0 + 1e-9);
        let (i0, j0) = self.cell_of(&[q[0] - reach, q[1] - reach]);
        let (i1, j1) = self.cell_of(&[q[0] + reach, q[1] + reach]);
        if j1 - j0 > 256 {
            return false;
        }
        let limit2 = distance * distance;
        for j in j0..=j1 {
            self.scan(j, i0, i1, q, &mut |n| {
                if n.distance2 <= limit2 {
                    out.push(n);
                }
            });
        }
        true
    }
}

/// What is kept of the points that a search passes.
trait Search {
    fn visit(&mut self, n: Neighbour);
    /// Points farther away are of no interest.
    fn limit2(&self) -> f64;
}

struct Nearest(Neighbour);

impl Search for Nearest {
    #[inline(always)]
    fn visit(&mut self, n: Neighbour) {
        if n.before(&self.0) {
            self.0 = n;
        }
    }

    #[inline(always)]
    fn limit2(&self) -> f64 {
        self.0.distance2
    }
}

/// Sorted, nearest first.
struct Several<'a>(&'a mut [Neighbour]);

impl Search for Several<'_> {
    #[inline(always)]
    fn visit(&mut self, n: Neighbour) {
        let last = self.0.len() - 1;
        if !n.before(&self.0[last]) {
            return;
        }
        let mut place = last;
        while place > 0 && n.before(&self.0[place - 1]) {
            self.0[place] = self.0[place - 1];
            place -= 1;
        }
        self.0[place] = n;
    }

    #[inline(always)]
    fn limit2(&self) -> f64 {
        self.0[self.0.len() - 1].distance2
    }
}
