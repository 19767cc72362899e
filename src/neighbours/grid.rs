//! Square cells in the plane, their points side by side in memory.

use rayon::prelude::*;

use super::order::by_counting;
use super::{NONE, Neighbour};
use crate::memory::fresh;

/// Points per cell, on average, that are tried one after the other: points on lines crowd in few of the cells.
const POINTS_PER_CELL: [f64; 3] = [2.0, 0.5, 0.125];
/// The number of points in a point's own cell, on average over the points, that is good enough (evenly spread points
/// have one more than the points per cell), and the one above which they are so clustered that a tree is faster.
const CROWD: [f64; 2] = [6.0, 12.0];
/// Rings of cells that are searched before the query is given up.
const RINGS: usize = 6;
/// How many times as large the cells are that such a query is given to.
const COARSER: f64 = 8.0;
/// Cells on a side of a block within which the order of queries does not matter.
const BLOCK: usize = 4;
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
        let box_ = [x0, y0, x1, y1];
        let mut best = None;
        for per_cell in POINTS_PER_CELL {
            let (width, height) = (x1 - x0, y1 - y0);
            let cells = points.len() as f64 / per_cell;
            // Points on an axis-parallel line get a row of cells.
            let cell = (width * height / cells).sqrt().max(width.max(height) / cells);
            if !(cell.is_finite() && cell > 1e-12 * x0.abs().max(x1.abs()).max(y0.abs()).max(y1.abs())) {
                break;
            }
            let empty = Self::empty(box_, cell);
            let crowd = empty.crowd(points);
            best = Some((empty, crowd));
            if crowd <= CROWD[0] {
                break;
            }
        }
        let (empty, _) = best.filter(|(_, crowd)| *crowd <= CROWD[1])?;
        Some(empty.filled(points))
    }

    /// The same points in cells that are [`COARSER`] times as large: for queries that lie too far away from all points.
    pub fn coarser(&self, points: &[[f64; 2]]) -> Self {
        let [x0, y0] = self.origin;
        let (width, height) = (self.columns as f64 * self.cell, self.rows as f64 * self.cell);
        Self::empty([x0, y0, x0 + width, y0 + height], COARSER * self.cell).filled(points)
    }

    fn empty([x0, y0, x1, y1]: [f64; 4], cell: f64) -> Self {
        let (columns, rows) = (((x1 - x0) / cell) as usize + 1, ((y1 - y0) / cell) as usize + 1);
        Self { origin: [x0, y0], cell, columns, rows, start: Vec::new(), xy: Vec::new(), index: Vec::new() }
    }

    /// Points in a point's own cell, on average over the points; of many points from a part of them.
    fn crowd(&self, points: &[[f64; 2]]) -> f64 {
        const PART: usize = 1 << 16;
        let mut keys: Vec<u32> = points.iter().step_by(points.len().div_ceil(PART)).map(|p| self.key(p)).collect();
        keys.sort_unstable();
        let pairs: usize = keys.chunk_by(|a, b| a == b).map(|cell| cell.len() * (cell.len() - 1)).sum();
        let n = keys.len() as f64;
        1.0 + (points.len() - 1) as f64 * pairs as f64 / (n * (n - 1.0).max(1.0))
    }

    fn filled(mut self, points: &[[f64; 2]]) -> Self {
        let keys = self.keys(points, 1);
        let (start, order) = by_counting(&keys, self.columns * self.rows);
        self.xy = fresh(points.len());
        self.xy.par_iter_mut().zip(&order).with_min_len(4096).for_each(|(p, &i)| *p = points[i as usize]);
        (self.start, self.index) = (start, order);
        self
    }

    /// The cell of a point, the nearest one for points outside.
    #[inline(always)]
    fn cell_of(&self, p: &[f64; 2]) -> (usize, usize) {
        // A conversion of floats to integers saturates, so that nothing can be out of range.
        let i = ((p[0] - self.origin[0]) / self.cell) as usize;
        let j = ((p[1] - self.origin[1]) / self.cell) as usize;
        (i.min(self.columns - 1), j.min(self.rows - 1))
    }

    #[inline(always)]
    fn key(&self, p: &[f64; 2]) -> u32 {
        let (i, j) = self.cell_of(p);
        (j * self.columns + i) as u32
    }

    /// Of each point the number of its block of so many by so many cells.
    fn keys(&self, points: &[[f64; 2]], block: usize) -> Vec<u32> {
        let columns = self.columns.div_ceil(block);
        let key = |p: &[f64; 2]| {
            let (i, j) = self.cell_of(p);
            (j / block * columns + i / block) as u32
        };
        points.par_iter().with_min_len(4096).map(key).collect()
    }

    /// The order in which queries walk through the cells, block by block.
    pub fn order(&self, queries: &[[f64; 2]]) -> Vec<u32> {
        by_counting(&self.keys(queries, BLOCK), self.columns.div_ceil(BLOCK) * self.rows.div_ceil(BLOCK)).1
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

    /// Shows cells in growing rings to `state` until its limit is covered; gives the squared distance below which
    /// everything was shown, or `None` where the limit is not within [`RINGS`].
    #[inline(always)]
    fn search(&self, q: &[f64; 2], state: &mut impl Search) -> Option<f64> {
        let (ci, cj) = self.cell_of(q);
        // The first block of three by three at once, its middle row first.
        let (i0, i1) = (ci.saturating_sub(1), (ci + 1).min(self.columns - 1));
        self.scan(cj, i0, i1, q, &mut |n| state.visit(n));
        let y = q[1] - self.origin[1] - cj as f64 * self.cell;
        let slack = 1e-9 * self.cell;
        let (below, above) = ((y - slack).max(0.0), (self.cell - y - slack).max(0.0));
        let mut shown2 = f64::INFINITY;
        if cj > 0 {
            if below * below <= state.wished2() {
                self.scan(cj - 1, i0, i1, q, &mut |n| state.visit(n));
            } else {
                shown2 = below * below;
            }
        }
        if cj + 1 < self.rows {
            if above * above <= state.wished2() {
                self.scan(cj + 1, i0, i1, q, &mut |n| state.visit(n));
            } else {
                shown2 = shown2.min(above * above);
            }
        }
        let mut ring = 1;
        loop {
            let covered2 = self.covered2(q, (ci, cj), ring);
            if covered2 > state.limit2() || covered2 == f64::INFINITY {
                return Some(shown2.min(covered2));
            }
            if ring == RINGS {
                return None;
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
        self.search(q, &mut best)?;
        Some(if best.0.index == NONE { Neighbour::NONE } else { best.0 })
    }

    /// The same, and a squared distance below which there is no other point.
    #[inline]
    pub fn nearest_and_rest(&self, q: &[f64; 2], best: Neighbour) -> Option<(Neighbour, f64)> {
        let mut state = WithRest { best, rest2: f64::INFINITY };
        let shown2 = self.search(q, &mut state)?;
        let best = if state.best.index == NONE { Neighbour::NONE } else { state.best };
        Some((best, state.rest2.min(shown2)))
    }

    /// The nearest within a limit, sorted; `None` where the grid cannot tell within a few rings.
    pub fn k_nearest(&self, q: &[f64; 2], limit2: f64, out: &mut [Neighbour]) -> Option<()> {
        out.fill(Neighbour { index: NONE, distance2: limit2 });
        self.search(q, &mut Several(out))?;
        out.iter_mut().filter(|n| n.index == NONE).for_each(|n| *n = Neighbour::NONE);
        Some(())
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
    /// Points as near as this are welcome where they cost little.
    #[inline(always)]
    fn wished2(&self) -> f64 {
        self.limit2()
    }
}

struct Nearest(Neighbour);

impl Search for Nearest {
    #[inline(always)]
    fn visit(&mut self, n: Neighbour) {
        // Without a branch: which point is nearer cannot be foretold.
        let nearer = n.before(&self.0);
        self.0.index = if nearer { n.index } else { self.0.index };
        self.0.distance2 = if nearer { n.distance2 } else { self.0.distance2 };
    }

    #[inline(always)]
    fn limit2(&self) -> f64 {
        self.0.distance2
    }
}

struct WithRest {
    best: Neighbour,
    /// Of the others that were seen, the nearest.
    rest2: f64,
}

impl Search for WithRest {
    #[inline(always)]
    fn visit(&mut self, n: Neighbour) {
        // Without a branch, as for the nearest alone. The distance that stands beside no index is of no point.
        let (old, nearer) = (self.best, n.before(&self.best));
        let other = if nearer { old } else { n };
        let counts = other.index != if nearer { NONE } else { old.index };
        self.best.index = if nearer { n.index } else { old.index };
        self.best.distance2 = if nearer { n.distance2 } else { old.distance2 };
        self.rest2 = if counts { self.rest2.min(other.distance2) } else { self.rest2 };
    }

    #[inline(always)]
    fn limit2(&self) -> f64 {
        self.best.distance2
    }

    #[inline(always)]
    fn wished2(&self) -> f64 {
        self.rest2
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
