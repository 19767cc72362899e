//! The nearest primitive along a ray: a bounding-volume hierarchy with the surface-area heuristic (binned).
//!
//! A node holds the boxes of both its children, in single precision rounded outwards: one cache line, one look. The
//! primitives themselves are met in double precision.

use nalgebra::Vector3;

use super::shape::Primitive;

const BINS: usize = 12;
const LEAF: usize = 4;
const INNER: u32 = u32::MAX;

/// Two children: their boxes by axis as (low, low, high, high), and what they are.
#[derive(Clone, Debug)]
struct Pair {
    bounds: [[f32; 4]; 3],
    /// Leaf: first of its primitives in `order`. Otherwise: index of the pair of its children.
    start: [u32; 2],
    /// Leaf: how many primitives (none for the empty one). Otherwise [`INNER`].
    count: [u32; 2],
}

/// A tree over the primitives of a scene.
#[derive(Clone, Debug)]
pub struct Bvh {
    pairs: Vec<Pair>,
    order: Vec<u32>,
}

struct Item {
    lo: Vector3<f64>,
    hi: Vector3<f64>,
    mid: Vector3<f64>,
    index: u32,
}

type Bounds = (Vector3<f64>, Vector3<f64>);

fn half_area(lo: &Vector3<f64>, hi: &Vector3<f64>) -> f64 {
    let d = hi - lo;
    if d.x < 0.0 { 0.0 } else { d.x * d.y + d.y * d.z + d.z * d.x }
}

fn nothing() -> Bounds {
    (Vector3::repeat(f64::INFINITY), Vector3::repeat(f64::NEG_INFINITY))
}

impl Bvh {
    /// The tree over `primitives`.
    pub fn new(primitives: &[Primitive]) -> Self {
        let mut items: Vec<Item> = primitives
            .iter()
            .zip(0..)
            .map(|(primitive, index)| {
                let (lo, hi) = primitive.bounds();
                Item { lo, hi, mid: (lo + hi) * 0.5, index }
            })
            .collect();
        let mut tree = Self { pairs: Vec::with_capacity(items.len()), order: Vec::with_capacity(items.len()) };
        // The root is a pair whose second child is empty, so that every box is in a pair.
        tree.pairs.push(Pair { bounds: [[1.0, 1.0, -1.0, -1.0]; 3], start: [0; 2], count: [0; 2] });
        let root = tree.build(&mut items);
        tree.set(0, 0, root);
        tree
    }

    /// Builds the subtree of these items and returns its box, its start and its count.
    fn build(&mut self, items: &mut [Item]) -> (Bounds, u32, u32) {
        let bounds = items.iter().fold(nothing(), |(lo, hi), item| (lo.inf(&item.lo), hi.sup(&item.hi)));
        let Some(middle) = split(items) else {
            let start = self.order.len() as u32;
            self.order.extend(items.iter().map(|item| item.index));
            return (bounds, start, items.len() as u32);
        };
        let here = self.pairs.len();
        self.pairs.push(Pair { bounds: [[1.0, 1.0, -1.0, -1.0]; 3], start: [0; 2], count: [0; 2] });
        let (first, second) = items.split_at_mut(middle);
        let child = self.build(first);
        self.set(here, 0, child);
        let child = self.build(second);
        self.set(here, 1, child);
        (bounds, here as u32, INNER)
    }

    fn set(&mut self, pair: usize, side: usize, (bounds, start, count): (Bounds, u32, u32)) {
        if count == 0 {
            return;
        }
        let size = bounds.0.amax().max(bounds.1.amax());
        // Wider than exact by more than single precision rounds anywhere on the way: what a ray meets is never missed.
        let margin = 4e-6 * size.max(1.0);
        for axis in 0..3 {
            self.pairs[pair].bounds[axis][side] = (bounds.0[axis] - margin) as f32;
            self.pairs[pair].bounds[axis][side + 2] = (bounds.1[axis] + margin) as f32;
        }
        self.pairs[pair].start[side] = start;
        self.pairs[pair].count[side] = count;
    }

    /// The nearest primitive that the ray meets within (`near`, `far`), and where.
    #[inline]
    pub fn nearest(
        &self,
        primitives: &[Primitive],
        from: &Vector3<f64>,
        ray: &Vector3<f64>,
        near: f64,
        far: f64,
    ) -> Option<(f64, u32)> {
        self.walk::<false>(primitives, from, ray, near, far)
    }

    /// Whether anything stands in the ray's way within (`near`, `far`).
    #[inline]
    pub fn blocked(
        &self,
        primitives: &[Primitive],
        from: &Vector3<f64>,
        ray: &Vector3<f64>,
        near: f64,
        far: f64,
    ) -> bool {
        self.walk::<true>(primitives, from, ray, near, far).is_some()
    }

    fn walk<const ANY: bool>(
        &self,
        primitives: &[Primitive],
        from: &Vector3<f64>,
        ray: &Vector3<f64>,
        near: f64,
        far: f64,
    ) -> Option<(f64, u32)> {
        let origin: [f32; 3] = std::array::from_fn(|i| from[i] as f32);
        // A direction component of 0 becomes tiny: 0 · ∞ would not be a number.
        let inverse: [f32; 3] = std::array::from_fn(|i| {
            let c = ray[i] as f32;
            1.0 / if c.abs() < 1e-20 { 1e-20_f32.copysign(c) } else { c }
        });
        let mut best: Option<(f64, u32)> = None;
        let (mut limit, mut at) = (far, 0);
        let mut stack = Stack::new();
        loop {
            let pair = &self.pairs[at as usize];
            let (enter, leave) = pair.crossed(&origin, &inverse);
            let mut inner = [false; 2];
            for side in 0..2 {
                // The margin for single precision, along the ray.
                if enter[side].max(near as f32) > leave[side] * 1.000_002 || f64::from(enter[side]) * 0.999_998 > limit
                {
                    continue;
                }
                let (start, count) = (pair.start[side] as usize, pair.count[side]);
                if count == INNER {
                    inner[side] = true;
                    continue;
                }
                for &index in &self.order[start..start + count as usize] {
                    if let Some(t) = primitives[index as usize].intersect(from, ray, near, limit) {
                        if ANY {
                            return Some((t, index));
                        }
                        // At equal distance the lower index wins: the answer does not depend on the tree.
                        if best.is_none_or(|(b, i)| t < b || (t == b && index < i)) {
                            best = Some((t, index));
                            limit = t.next_up();
                        }
                    }
                }
            }
            at = match inner {
                [true, true] => {
                    let nearer = usize::from(enter[1] < enter[0]);
                    stack.push((pair.start[1 - nearer], enter[1 - nearer]));
                    pair.start[nearer]
                }
                [true, false] => pair.start[0],
                [false, true] => pair.start[1],
                [false, false] => loop {
                    let Some((next, enter)) = stack.pop() else {
                        return best;
                    };
                    if f64::from(enter) * 0.999_998 <= limit {
                        break next;
                    }
                },
            };
        }
    }
}

impl Pair {
    /// Distances along the ray at which it enters and leaves both boxes.
    #[inline(always)]
    fn crossed(&self, origin: &[f32; 3], inverse: &[f32; 3]) -> ([f32; 2], [f32; 2]) {
        let (mut enter, mut leave) = ([f32::NEG_INFINITY; 2], [f32::INFINITY; 2]);
        for axis in 0..3 {
            let t: [f32; 4] = std::array::from_fn(|k| (self.bounds[axis][k] - origin[axis]) * inverse[axis]);
            for side in 0..2 {
                let (a, b) = (t[side], t[side + 2]);
                let (low, high) = if a < b { (a, b) } else { (b, a) };
                enter[side] = if low > enter[side] { low } else { enter[side] };
                leave[side] = if high < leave[side] { high } else { leave[side] };
            }
        }
        (enter, leave)
    }
}

/// Rank at which to divide the items; they are reordered for it. `None`: a leaf is cheaper.
fn split(items: &mut [Item]) -> Option<usize> {
    if items.len() <= LEAF {
        return None;
    }
    let (lo, hi) = items.iter().fold(nothing(), |(lo, hi), item| (lo.inf(&item.mid), hi.sup(&item.mid)));
    let mut best: Option<(f64, usize, usize)> = None;
    for axis in 0..3 {
        let extent = hi[axis] - lo[axis];
        if extent <= 0.0 {
            continue;
        }
        let bin = |item: &Item| (((item.mid[axis] - lo[axis]) / extent * BINS as f64) as usize).min(BINS - 1);
        let mut boxes = [nothing(); BINS];
        let mut counts = [0usize; BINS];
        for item in items.iter() {
            let b = bin(item);
            boxes[b] = (boxes[b].0.inf(&item.lo), boxes[b].1.sup(&item.hi));
            counts[b] += 1;
        }
        for cut in 1..BINS {
            let side = |range: std::ops::Range<usize>| {
                let n: usize = counts[range.clone()].iter().sum();
                let (lo, hi) = boxes[range].iter().fold(nothing(), |(lo, hi), b| (lo.inf(&b.0), hi.sup(&b.1)));
                (n, n as f64 * half_area(&lo, &hi))
            };
            let ((n0, cost0), (n1, cost1)) = (side(0..cut), side(cut..BINS));
            if n0 > 0 && n1 > 0 && best.is_none_or(|(cost, _, _)| cost0 + cost1 < cost) {
                best = Some((cost0 + cost1, axis, cut));
            }
        }
    }
    let Some((_, axis, cut)) = best else {
        // All middles coincide: halve by rank, so that the depth stays logarithmic.
        return Some(items.len() / 2);
    };
    let extent = hi[axis] - lo[axis];
    let is_first = |item: &Item| ((((item.mid[axis] - lo[axis]) / extent * BINS as f64) as usize).min(BINS - 1)) < cut;
    items.sort_by_key(|item| !is_first(item));
    let middle = items.iter().take_while(|item| is_first(item)).count();
    Some(middle)
}

/// A stack of pairs with their entry distances that needs no heap until the tree is unusually deep.
struct Stack {
    near: [(u32, f32); 40],
    length: usize,
    spill: Vec<(u32, f32)>,
}

impl Stack {
    #[inline]
    fn new() -> Self {
        Self { near: [(0, 0.0); 40], length: 0, spill: Vec::new() }
    }

    #[inline]
    fn push(&mut self, value: (u32, f32)) {
        if self.length < self.near.len() {
            self.near[self.length] = value;
            self.length += 1;
        } else {
            self.spill.push(value);
        }
    }

    #[inline]
    fn pop(&mut self) -> Option<(u32, f32)> {
        if let Some(value) = self.spill.pop() {
            return Some(value);
        }
        self.length = self.length.checked_sub(1)?;
        Some(self.near[self.length])
    }
}

#[cfg(test)]
mod tests {
    use super::super::shape::Outline;
    use super::*;
    use crate::simulate::noise::{hash, signed};

    #[test]
    fn the_tree_finds_what_testing_every_primitive_finds() {
        let random = |i: i32, k: i32| f64::from(signed(hash(i, k, 0, 11)));
        let primitives: Vec<Primitive> = (0..600)
            .filter_map(|i| {
                let o = Vector3::new(random(i, 0), random(i, 1), random(i, 2)) * 5.0;
                let u = Vector3::new(random(i, 3), random(i, 4), random(i, 5)) * 0.6;
                let v = Vector3::new(random(i, 6), random(i, 7), random(i, 8)) * 0.6;
                let outline = Outline::from_number(i64::from(i % 6))?;
                let v = if i % 6 >= 4 { v.map(f64::abs) } else { v };
                Primitive::new(outline, o, u, v, [0.0; 2], 0)
            })
            .collect();
        let tree = Bvh::new(&primitives);
        let mut hits = 0;
        for i in 0..2000 {
            let from = Vector3::new(random(i, 20), random(i, 21), random(i, 22)) * 8.0;
            // Every fourth ray runs along an axis, where 0 · ∞ lurks.
            let ray = match i % 4 {
                0 => Vector3::new(0.0, signed(hash(i, 30, 0, 3)).signum().into(), 0.0),
                _ => Vector3::new(random(i, 23), random(i, 24), random(i, 25)),
            };
            let mut expected: Option<(f64, u32)> = None;
            for (primitive, index) in primitives.iter().zip(0..) {
                if let Some(t) = primitive.intersect(&from, &ray, 0.0, f64::INFINITY)
                    && expected.is_none_or(|(b, _)| t < b)
                {
                    expected = Some((t, index));
                }
            }
            hits += usize::from(expected.is_some());
            assert_eq!(tree.nearest(&primitives, &from, &ray, 0.0, f64::INFINITY), expected);
            assert_eq!(tree.blocked(&primitives, &from, &ray, 0.0, f64::INFINITY), expected.is_some());
        }
        assert!(hits > 300, "only {hits} rays hit anything");
    }
}
