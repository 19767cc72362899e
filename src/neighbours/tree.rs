//! A balanced kd-tree, and what it needs to stay fast where many points coincide.

use std::num::NonZeroUsize;

use kiddo::{ImmutableKdTree, SquaredEuclidean};
use rayon::prelude::*;

use super::{NONE, Neighbour};

/// Points that coincide cannot be divided: a leaf that holds more than this many is a sign of them.
const LARGEST_LEAF: usize = 128;

pub(super) struct Tree<const D: usize> {
    tree: ImmutableKdTree<f64, D>,
    /// Where points coincide, the tree holds each place once.
    places: Option<Places>,
}

/// Indices of the points at each place, ascending: those of place `i` are `points[start[i]..start[i + 1]]`.
struct Places {
    start: Vec<u32>,
    points: Vec<u32>,
}

impl Places {
    fn new<const D: usize>(points: &[[f64; D]]) -> (Self, Vec<[f64; D]>) {
        let compare = |a: &u32, b: &u32| {
            let (p, q) = (&points[*a as usize], &points[*b as usize]);
            let by_place = p.iter().zip(q).map(|(x, y)| x.total_cmp(y)).find(|o| o.is_ne());
            by_place.unwrap_or_else(|| a.cmp(b))
        };
        let mut order: Vec<u32> = (0..points.len() as u32).collect();
        order.par_sort_unstable_by(compare);
        let mut this = Self { start: Vec::new(), points: Vec::with_capacity(points.len()) };
        let mut unique: Vec<[f64; D]> = Vec::new();
        for i in order {
            let p = points[i as usize];
            if unique.last() != Some(&p) {
                this.start.push(this.points.len() as u32);
                unique.push(p);
            }
            this.points.push(i);
        }
        this.start.push(this.points.len() as u32);
        (this, unique)
    }

    fn at(&self, place: u32) -> &[u32] {
        &self.points[self.start[place as usize] as usize..self.start[place as usize + 1] as usize]
    }
}

fn build<const D: usize>(points: &[[f64; D]]) -> ImmutableKdTree<f64, D> {
    match ImmutableKdTree::new_from_slice_parallel(points) {
        Ok(tree) => tree,
        // The only cause is an index that overflows, and the caller has counted the points.
        Err(_) => unreachable!("{} points have indices of 32 bits", points.len()),
    }
}

impl<const D: usize> Tree<D> {
    pub fn new(points: &[[f64; D]]) -> Self {
        let tree = build(points);
        if tree.max_leaf_len() <= LARGEST_LEAF {
            return Self { tree, places: None };
        }
        let (places, unique) = Places::new(points);
        Self { tree: build(&unique), places: Some(places) }
    }

    pub fn nearest(&self, q: &[f64; D], limit2: f64) -> Neighbour {
        let best = self.tree.query(q).nearest_one::<SquaredEuclidean<f64>>().execute();
        if best.distance > limit2 {
            return Neighbour::NONE;
        }
        let index = self.places.as_ref().map_or(best.item, |p| p.at(best.item)[0]);
        Neighbour { index, distance2: best.distance }
    }

    pub fn k_nearest(&self, q: &[f64; D], limit2: f64, out: &mut [Neighbour]) {
        let Some(k) = NonZeroUsize::new(out.len().min(self.tree.size())) else { return };
        let query = self.tree.query(q).nearest_n::<SquaredEuclidean<f64>>(k);
        let found = if limit2.is_finite() { query.within(limit2).execute() } else { query.execute() };
        let mut n = 0;
        for hit in found {
            let one = [hit.item];
            for &index in self.places.as_ref().map_or(&one[..], |p| p.at(hit.item)) {
                if n < out.len() {
                    out[n] = Neighbour { index, distance2: hit.distance };
                    n += 1;
                }
            }
        }
        out[n..].fill(Neighbour { index: NONE, distance2: f64::INFINITY });
    }

    pub fn within(&self, q: &[f64; D], limit2: f64, out: &mut Vec<Neighbour>) {
        for hit in self.tree.query(q).within::<SquaredEuclidean<f64>>(limit2).unsorted().execute() {
            let one = [hit.item];
            let indices = self.places.as_ref().map_or(&one[..], |p| p.at(hit.item));
            out.extend(indices.iter().map(|&index| Neighbour { index, distance2: hit.distance }));
        }
    }
}
