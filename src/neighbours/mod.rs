//! The nearest of many points, in the plane and in space.
//!
//! Two structures share the work. A *grid* of square cells with about two points each is the fastest that there is for
//! points of the plane that lie evenly; queries whose neighbours lie more than a few cells away are given to one of larger
//! cells. What is farther still, clustered points and points of space go to a balanced *kd-tree*. Both are exact, so that
//! the choice shows in time alone. Batches are worked off in an order that keeps neighbours in the cache, in parallel;
//! the results do not depend on it.
//!
//! Between points at the same distance the grid takes the lower index; the tree takes one of them, always the same.

mod approach;
mod grid;
mod order;
mod tree;

use std::sync::OnceLock;

use rayon::prelude::*;

use crate::error::{Error, Result};
use crate::memory::{Zeroed, fresh};
pub use approach::Approach;
use grid::Grid;
pub(crate) use order::along_a_curve;
use tree::Tree;

/// Stands where there is no neighbour.
pub const NONE: u32 = u32::MAX;

/// Queries per task.
const BLOCK: usize = 2048;

/// A neighbour: the point's index, or [`NONE`], and its squared distance.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Neighbour {
    /// The position in the points that were indexed.
    pub index: u32,
    /// Squared; infinite where there is no neighbour.
    pub distance2: f64,
}

// SAFETY: all bits zero is the first point, at no distance.
unsafe impl Zeroed for Neighbour {}

impl Neighbour {
    /// No neighbour.
    pub const NONE: Self = Self { index: NONE, distance2: f64::INFINITY };

    /// Its index, if there is one.
    #[inline]
    pub fn found(&self) -> Option<usize> {
        (self.index != NONE).then_some(self.index as usize)
    }

    /// Nearer, or as near with the lower index.
    #[inline(always)]
    fn before(&self, other: &Self) -> bool {
        (self.distance2 < other.distance2) | ((self.distance2 == other.distance2) & (self.index < other.index))
    }
}

/// Neighbours of many queries, of a different number each.
#[derive(Debug, Clone, PartialEq)]
pub struct Within {
    /// The neighbours of query `i` are `neighbours[offsets[i]..offsets[i + 1]]`, nearest first.
    pub offsets: Vec<usize>,
    /// All of them.
    pub neighbours: Vec<Neighbour>,
}

/// Points of D dimensions (2 or 3), ready to be searched.
pub struct Neighbours<const D: usize> {
    points: Vec<[f64; D]>,
    grid: Option<Grid>,
    /// The same with larger cells, for queries that the grid gives up.
    coarse: OnceLock<Grid>,
    tree: OnceLock<Tree<D>>,
}

impl<const D: usize> Neighbours<D> {
    /// Indexes the points. Refuses an empty set, values that are not finite, and more than 2³² − 2 points.
    pub fn new(points: &[[f64; D]]) -> Result<Self> {
        if points.is_empty() {
            return Err(Error::invalid("there is no point to search among"));
        }
        if points.len() >= NONE as usize {
            return Err(Error::invalid(format!("{} points are too many to be indexed", points.len())));
        }
        refuse_not_finite(points, "point")?;
        let points = points.to_vec();
        let grid = if D == 2 { Grid::new(points.as_flattened().as_chunks::<2>().0) } else { None };
        let this = Self { points, grid, coarse: OnceLock::new(), tree: OnceLock::new() };
        if this.grid.is_none() {
            this.tree();
        }
        Ok(this)
    }

    /// How many points there are.
    pub fn len(&self) -> usize {
        self.points.len()
    }

    /// Never true: an empty set is refused.
    pub fn is_empty(&self) -> bool {
        self.points.is_empty()
    }

    /// The points, as they were given.
    pub fn points(&self) -> &[[f64; D]] {
        &self.points
    }

    /// Built when the first query needs it: a grid answers most queries of the plane alone.
    fn tree(&self) -> &Tree<D> {
        self.tree.get_or_init(|| apart(|| Tree::new(&self.points)))
    }

    /// Asks the grid, and the coarser one where that cannot tell.
    #[inline]
    fn ask_grids<T>(&self, mut ask: impl FnMut(&Grid) -> Option<T>) -> Option<T> {
        let grid = self.grid.as_ref()?;
        ask(grid).or_else(|| {
            let points = || self.points.as_flattened().as_chunks::<2>().0;
            ask(self.coarse.get_or_init(|| apart(|| grid.coarser(points()))))
        })
    }

    /// The nearest point of one query within a distance; the query has to be finite.
    #[inline]
    pub fn nearest_one(&self, query: &[f64; D], max_distance: f64) -> Neighbour {
        self.nearest_from(query, Neighbour { index: NONE, distance2: max_distance * max_distance })
    }

    #[inline]
    fn nearest_from(&self, query: &[f64; D], known: Neighbour) -> Neighbour {
        match self.ask_grids(|g| g.nearest(&[query[0], query[1]], known)) {
            Some(neighbour) => neighbour,
            None => self.tree().nearest(query, known.distance2),
        }
    }

    /// The nearest point of one query where one is known to be no farther than `known`, which has that point's index or
    /// [`NONE`]: the closer it is, the shorter the search. And a squared distance below which there is no other point,
    /// which may be too small: as long as the query moves less than it allows, no search is needed.
    #[inline]
    pub(crate) fn nearest_and_rest(&self, query: &[f64; D], known: Neighbour) -> (Neighbour, f64) {
        match self.ask_grids(|g| g.nearest_and_rest(&[query[0], query[1]], known)) {
            Some(found) => found,
            None => {
                let nearest = self.tree().nearest(query, f64::INFINITY);
                let within = if nearest.distance2 <= known.distance2 { nearest } else { Neighbour::NONE };
                (within, nearest.distance2)
            }
        }
    }

    /// The `k` nearest of one query within a distance, nearest first, into `out`, which is filled up with
    /// [`Neighbour::NONE`].
    pub fn k_nearest_one(&self, query: &[f64; D], max_distance: f64, out: &mut [Neighbour]) {
        let limit2 = max_distance * max_distance;
        let answered = self.ask_grids(|g| g.k_nearest(&[query[0], query[1]], limit2, out));
        if answered.is_none() {
            self.tree().k_nearest(query, limit2, out);
        }
    }

    /// All points within a distance of one query, nearest first.
    pub fn within_one(&self, query: &[f64; D], max_distance: f64, out: &mut Vec<Neighbour>) {
        out.clear();
        let limit2 = max_distance * max_distance;
        let answered = self.grid.as_ref().is_some_and(|g| g.within(&[query[0], query[1]], max_distance, out));
        if !answered {
            self.tree().within(query, limit2, out);
        }
        out.sort_unstable_by(|a, b| a.distance2.total_cmp(&b.distance2).then(a.index.cmp(&b.index)));
    }

    /// The nearest point of each query within a distance (which may be infinite).
    pub fn nearest(&self, queries: &[[f64; D]], max_distance: f64) -> Result<Vec<Neighbour>> {
        self.check(queries, max_distance)?;
        let Some(order) = self.order(queries) else {
            return Ok(self.nearest_in_order(queries, max_distance));
        };
        let mut sorted: Vec<Neighbour> = fresh(queries.len());
        sorted.par_chunks_mut(BLOCK).zip(order.par_chunks(BLOCK)).for_each(|(out, order)| {
            for (out, &i) in out.iter_mut().zip(order) {
                *out = self.nearest_one(&queries[i as usize], max_distance);
            }
        });
        Ok(order::back(&order, &sorted, 1))
    }

    /// As [`Neighbours::nearest`] for finite queries that follow each other in space already.
    pub(crate) fn nearest_in_order(&self, queries: &[[f64; D]], max_distance: f64) -> Vec<Neighbour> {
        queries.par_iter().with_min_len(BLOCK.min(256)).map(|q| self.nearest_one(q, max_distance)).collect()
    }

    /// The `k` nearest points of each query within a distance, row by row, nearest first; a row is filled up with
    /// [`Neighbour::NONE`] where there are fewer.
    pub fn k_nearest(&self, queries: &[[f64; D]], k: usize, max_distance: f64) -> Result<Vec<Neighbour>> {
        self.check(queries, max_distance)?;
        if k == 0 {
            return Err(Error::invalid("k = 0 neighbours were asked for; ask for one or more"));
        }
        let fill = |rows: &mut [Neighbour], which: &mut dyn Iterator<Item = usize>| {
            for (row, i) in rows.chunks_exact_mut(k).zip(which) {
                self.k_nearest_one(&queries[i], max_distance, row);
            }
        };
        let mut rows: Vec<Neighbour> = fresh(queries.len() * k);
        match self.order(queries) {
            None => {
                rows.par_chunks_mut(64 * k).enumerate().for_each(|(b, rows)| fill(rows, &mut (64 * b..queries.len())));
                Ok(rows)
            }
            Some(order) => {
                rows.par_chunks_mut(BLOCK * k)
                    .zip(order.par_chunks(BLOCK))
                    .for_each(|(rows, order)| fill(rows, &mut order.iter().map(|&i| i as usize)));
                Ok(order::back(&order, &rows, k))
            }
        }
    }

    /// All points within a distance of each query.
    pub fn within(&self, queries: &[[f64; D]], max_distance: f64) -> Result<Within> {
        self.check(queries, max_distance)?;
        let lists: Vec<(Vec<usize>, Vec<Neighbour>)> = queries
            .par_chunks(256)
            .map(|queries| {
                let (mut counts, mut all, mut one) = (Vec::with_capacity(queries.len()), Vec::new(), Vec::new());
                for query in queries {
                    self.within_one(query, max_distance, &mut one);
                    counts.push(one.len());
                    all.extend_from_slice(&one);
                }
                (counts, all)
            })
            .collect();
        let mut offsets = Vec::with_capacity(queries.len() + 1);
        let mut total = 0;
        offsets.push(0);
        for count in lists.iter().flat_map(|(counts, _)| counts) {
            total += count;
            offsets.push(total);
        }
        let mut neighbours = Vec::with_capacity(total);
        for (_, list) in lists {
            neighbours.extend(list);
        }
        Ok(Within { offsets, neighbours })
    }

    fn check(&self, queries: &[[f64; D]], max_distance: f64) -> Result<()> {
        if max_distance.is_nan() || max_distance < 0.0 {
            return Err(Error::invalid(format!("a largest distance of {max_distance} is not possible")));
        }
        refuse_not_finite(queries, "query")
    }

    /// The order in which to work off many queries, or `None` for few.
    fn order(&self, queries: &[[f64; D]]) -> Option<Vec<u32>> {
        if queries.len() < 4096 || queries.len() >= NONE as usize {
            return None;
        }
        Some(match &self.grid {
            Some(grid) => grid.order(queries.as_flattened().as_chunks::<2>().0),
            None => order::along_a_curve(queries),
        })
    }
}

/// Builds what several queries may be waiting for, in threads of its own: a thread of the pool that waited for a part of
/// it would take up another query meanwhile, and wait for itself.
fn apart<T: Send>(build: impl FnOnce() -> T + Send) -> T {
    if rayon::current_thread_index().is_none() {
        return build();
    }
    let threads = rayon::current_num_threads();
    let run = || match rayon::ThreadPoolBuilder::new().num_threads(threads).build() {
        Ok(pool) => pool.install(build),
        Err(_) => build(),
    };
    std::thread::scope(|scope| scope.spawn(run).join()).unwrap_or_else(|panic| std::panic::resume_unwind(panic))
}

/// Names the first row that holds a value that is not finite.
pub(crate) fn refuse_not_finite<const D: usize>(points: &[[f64; D]], what: &str) -> Result<()> {
    let bad = points.par_iter().position_first(|p| !p.iter().all(|v| v.is_finite()));
    bad.map_or(Ok(()), |i| {
        Err(Error::invalid(format!("{what} {i} is not finite: {:?}; leave such points out first", points[i])))
    })
}

#[cfg(test)]
mod tests;
