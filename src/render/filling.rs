//! Holes of a synthetic camera image, filled between neighbours on one surface only.
//!
//! A hole is filled from two measured pixels that lie opposite each other about it. They are on one surface if the
//! inverse depth, which a plane makes an affine function of the pixel position, goes on from the one to the other as it
//! came: the slope across the hole lies between the slopes on its two sides, up to a tolerance. So a façade seen at a
//! grazing angle is closed, an inner corner is closed, and the step from a kiosk to the façade behind it is not. Where
//! several pairs agree, the nearer surface wins.

use rayon::prelude::*;

/// How holes are filled.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Filling {
    /// The widest hole, pixels between two measured ones; 0 fills nothing.
    pub width: usize,
    /// How far, relative to the depth, a surface may depart across a hole from its slopes beside it.
    pub tolerance: f32,
}

impl Default for Filling {
    fn default() -> Self {
        Self { width: 8, tolerance: 0.006 }
    }
}

/// A picture's measured depths.
pub struct Samples<'a> {
    /// Pixels in a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Inverse depths, 0 where nothing was measured.
    pub inverse_depth: &'a [f32],
    /// Of each pixel the inverse depth that hides what lies behind, 0 where nothing does: a hole is not filled behind
    /// it. Empty for "nowhere".
    pub limit: &'a [f32],
    /// Whether the left and the right border are the same place.
    pub wraps: bool,
}

/// Half of the directions; the other half is opposite.
const DIRECTIONS: [(isize, isize); 4] = [(1, 0), (0, 1), (1, 1), (1, -1)];

/// One measured pixel on one side of a hole.
#[derive(Clone, Copy)]
struct Side {
    steps: usize,
    value: f32,
    /// Change of the inverse depth per step, away from the hole, from the next measured pixel beyond.
    slope: Option<f32>,
}

/// The inverse depths with holes filled; where nothing fits they stay 0.
pub fn filled(samples: &Samples, filling: &Filling) -> Vec<f32> {
    let mut known = samples.inverse_depth.to_vec();
    if filling.width == 0 {
        return known;
    }
    // The second pass reaches the middle of a lattice's meshes, from which no measured pixel lies straight ahead.
    for _ in 0..2 {
        let mut out = known.clone();
        let samples = Samples { inverse_depth: &known, ..*samples };
        out.par_chunks_mut(samples.width).enumerate().for_each(|(y, row)| {
            for (x, value) in row.iter_mut().enumerate() {
                if *value == 0.0 {
                    *value = bridge(&samples, filling, x, y).unwrap_or(0.0);
                }
            }
        });
        known = out;
    }
    known
}

fn bridge(samples: &Samples, filling: &Filling, x: usize, y: usize) -> Option<f32> {
    let limit = samples.limit.get(y * samples.width + x).copied().unwrap_or(0.0);
    let mut found: [Option<(f32, usize)>; 4] = [None; 4];
    for (slot, (dx, dy)) in found.iter_mut().zip(DIRECTIONS) {
        let Some(ahead) = look(samples, filling.width, x, y, dx, dy) else { continue };
        let Some(behind) = look(samples, filling.width + 1 - ahead.steps, x, y, -dx, -dy) else { continue };
        if let Some(value) = across(&ahead, &behind, filling.tolerance)
            && value >= limit
        {
            *slot = Some((value, ahead.steps + behind.steps));
        }
    }
    let front = found.iter().flatten().fold(0.0_f32, |a, (v, _)| a.max(*v));
    if front == 0.0 {
        return None;
    }
    // Pairs that see the front surface, the closer ones counting more. A wide gap needs two of them: one alone also
    // bridges what lies beside a concave outline.
    let (mut sum, mut weight, mut pairs, mut closest) = (0.0, 0.0, 0, usize::MAX);
    for (value, span) in found.iter().flatten() {
        if front - value <= 2.0 * filling.tolerance * front {
            let w = 1.0 / (span * span) as f32;
            sum += w * value;
            weight += w;
            pairs += 1;
            closest = closest.min(*span);
        }
    }
    (pairs >= 2 || closest <= filling.width / 2 + 1).then(|| sum / weight)
}

/// The inverse depth between two sides of a hole, if they are one surface.
fn across(a: &Side, b: &Side, tolerance: f32) -> Option<f32> {
    let span = (a.steps + b.steps) as f32;
    // From b through the hole to a.
    let slope = (a.value - b.value) / span;
    let near = a.value.max(b.value);
    let slack = tolerance * near / span;
    let (from_a, from_b) = match (a.slope, b.slope) {
        (Some(a), Some(b)) => (a, -b),
        (Some(a), None) => (a, a),
        (None, Some(b)) => (-b, -b),
        (None, None) => (0.0, 0.0),
    };
    let one_surface = slope >= from_a.min(from_b) - slack && slope <= from_a.max(from_b) + slack;
    one_surface.then_some(b.value + slope * b.steps as f32)
}

/// The first measured pixel in a direction, within `most` steps, and the slope beyond it.
fn look(samples: &Samples, most: usize, x: usize, y: usize, dx: isize, dy: isize) -> Option<Side> {
    let (w, h) = (samples.width as isize, samples.height as isize);
    let at = |step: usize| {
        let (mut u, v) = (x as isize + dx * step as isize, y as isize + dy * step as isize);
        if samples.wraps {
            u = u.rem_euclid(w);
        }
        ((0..w).contains(&u) && (0..h).contains(&v)).then(|| samples.inverse_depth[(v * w + u) as usize])
    };
    for step in 1..=most {
        let value = at(step)?;
        if value > 0.0 {
            let beyond = (step + 1..=step + 1 + most).find_map(|s| match at(s) {
                Some(v) if v > 0.0 => Some((v, s)),
                _ => None,
            });
            let slope = beyond.map(|(v, s)| (v - value) / (s - step) as f32);
            return Some(Side { steps: step, value, slope });
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    const W: usize = 60;
    const H: usize = 40;

    fn run(depth: impl Fn(usize, usize) -> f32, measured: impl Fn(usize, usize) -> bool, wraps: bool) -> Vec<f32> {
        let inverse_depth: Vec<f32> =
            (0..W * H).map(|i| if measured(i % W, i / W) { 1.0 / depth(i % W, i / W) } else { 0.0 }).collect();
        let samples = Samples { width: W, height: H, inverse_depth: &inverse_depth, limit: &[], wraps };
        filled(&samples, &Filling::default())
    }

    #[test]
    fn a_plane_is_closed_exactly_however_slanted() {
        // Inverse depth affine in the pixel: a wall whose depth doubles across the picture.
        let depth = |x: usize, y: usize| 1.0 / (0.1 - 0.0008 * x as f32 + 0.0003 * y as f32);
        let values = run(depth, |x, y| x % 4 == 0 && y % 3 == 0, false);
        for y in 3..H - 4 {
            for x in 4..W - 4 {
                let expected = 1.0 / depth(x, y);
                assert!((values[y * W + x] - expected).abs() < 1e-6, "{x} {y}");
            }
        }
    }

    #[test]
    fn a_depth_edge_is_not_bridged() {
        // A kiosk at 8 m before a façade at 20 m, its columns 30 … 33 missing.
        let depth = |x: usize, _: usize| if x < 32 { 8.0 } else { 20.0 };
        let values = run(depth, |x, _| !(30..34).contains(&x), false);
        for y in 0..H {
            for x in 30..34 {
                assert_eq!(values[y * W + x], 0.0, "{x} {y}");
            }
        }
    }

    #[test]
    fn an_inner_corner_is_closed() {
        let depth = |x: usize, _: usize| 1.0 / if x < 30 { 0.1 - 0.001 * x as f32 } else { 0.04 + 0.001 * x as f32 };
        let values = run(depth, |x, y| (x + 2 * y) % 5 == 0, false);
        let holes = (2..H - 2).flat_map(|y| (4..W - 4).map(move |x| y * W + x)).filter(|i| values[*i] == 0.0).count();
        assert_eq!(holes, 0);
    }

    #[test]
    fn wide_holes_stay_and_nothing_is_filled_behind_what_hides() {
        let values = run(|_, _| 10.0, |x, _| !(20..45).contains(&x), false);
        assert!(values[H / 2 * W + 32] == 0.0);
        let inverse_depth: Vec<f32> = (0..W * H).map(|i| if i % 3 == 0 { 0.1 } else { 0.0 }).collect();
        let limit = vec![0.15; W * H];
        let samples = Samples { width: W, height: H, inverse_depth: &inverse_depth, limit: &limit, wraps: false };
        assert_eq!(filled(&samples, &Filling::default()), inverse_depth);
    }

    #[test]
    fn a_panorama_is_closed_across_its_border() {
        let open = run(|_, _| 10.0, |x, _| x > 2 && x < W - 2, false);
        let closed = run(|_, _| 10.0, |x, _| x > 2 && x < W - 2, true);
        assert_eq!(open[10 * W], 0.0);
        assert!((closed[10 * W] - 0.1).abs() < 1e-6);
    }
}
