//! The order of queries: those that follow each other should need the same points.

use rayon::prelude::*;

use crate::memory::{Zeroed, fresh};

/// Bits of the curve's position that are sorted by.
const BITS: u32 = 15;

/// Indices of the points in the order of Morton's curve through their bounding box.
pub(crate) fn along_a_curve<const D: usize>(points: &[[f64; D]]) -> Vec<u32> {
    let mut low = [f64::INFINITY; D];
    let mut high = [f64::NEG_INFINITY; D];
    for p in points {
        for d in 0..D {
            low[d] = low[d].min(p[d]);
            high[d] = high[d].max(p[d]);
        }
    }
    let bits = BITS / D as u32;
    let steps = f64::from(1u32 << bits);
    let scale: [f64; D] = std::array::from_fn(|d| if high[d] > low[d] { steps / (high[d] - low[d]) } else { 0.0 });
    let key = |p: &[f64; D]| {
        let cell: [u32; D] = std::array::from_fn(|d| ((p[d] - low[d]) * scale[d]).min(steps - 1.0) as u32);
        (0..bits).rev().fold(0u32, |key, bit| cell.iter().fold(key, |key, c| key << 1 | (c >> bit & 1)))
    };
    let keys: Vec<u32> = points.par_iter().with_min_len(4096).map(key).collect();
    by_counting(&keys, 1 << (bits * D as u32)).1
}

/// A stable order by small keys, and where the run of each key begins, with the total at the end.
pub(super) fn by_counting(keys: &[u32], size: usize) -> (Vec<u32>, Vec<u32>) {
    // Counted two places above, so that the places from one above on become the ends of the runs while these fill.
    let mut starts: Vec<u32> = fresh(size + 2);
    for &key in keys {
        starts[key as usize + 2] += 1;
    }
    for i in 2..size + 2 {
        starts[i] += starts[i - 1];
    }
    let mut order: Vec<u32> = fresh(keys.len());
    for (i, &key) in keys.iter().enumerate() {
        let place = &mut starts[key as usize + 1];
        order[*place as usize] = i as u32;
        *place += 1;
    }
    starts.truncate(size + 1);
    (starts, order)
}

/// Rows of `width` from the given order back to that of the queries.
pub(super) fn back<T: Copy + Send + Sync + Zeroed>(order: &[u32], rows: &[T], width: usize) -> Vec<T> {
    let mut place: Vec<u32> = fresh(order.len());
    for (sorted, &original) in order.iter().enumerate() {
        place[original as usize] = sorted as u32;
    }
    let mut out: Vec<T> = fresh(rows.len());
    if width == 1 {
        out.par_iter_mut().zip(&place).with_min_len(4096).for_each(|(out, &p)| *out = rows[p as usize]);
    } else {
        let row = |(out, &p): (&mut [T], &u32)| out.copy_from_slice(&rows[p as usize * width..][..width]);
        out.par_chunks_exact_mut(width).zip(&place).with_min_len(1024).for_each(row);
    }
    out
}
