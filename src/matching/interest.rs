//! Interest points of the SCI: where a template can be placed in both directions.
//!
//! Harris' corner measure in Shi and Tomasi's form, the smaller eigenvalue of the gradient's structure tensor, on
//! saturated gradients, so that one bright sign does not take all points. The best of each cell of a grid is taken:
//! points spread over the whole picture determine a view, points in a heap do not.

use rayon::prelude::*;

use super::channels::{gradient, masked_blur};
use super::plane::Plane;
use crate::error::Result;

/// How interest points are chosen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InterestOptions {
    /// Side of a cell, px.
    pub cell: usize,
    /// Points in a cell at most.
    pub per_cell: usize,
    /// No point nearer to the border than this, px.
    pub border: usize,
    /// Blur before differences, px.
    pub sigma_gradient: f32,
    /// Size of the neighbourhood of the structure tensor, px.
    pub sigma_window: f32,
    /// Smallest strength, as a multiple of the picture's median strength.
    pub floor: f32,
}

impl Default for InterestOptions {
    fn default() -> Self {
        Self { cell: 32, per_cell: 2, border: 8, sigma_gradient: 0.8, sigma_window: 4.0, floor: 0.5 }
    }
}

/// An interest point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Interest {
    /// Column.
    pub x: usize,
    /// Row.
    pub y: usize,
    /// The smaller eigenvalue of the structure tensor, of gradients saturated to at most 1.
    pub strength: f32,
}

/// Interest points in the order of cells, row by row, the strongest of a cell first.
pub fn interest_points(image: &Plane, known: Option<&Plane>, options: &InterestOptions) -> Result<Vec<Interest>> {
    let g = gradient(image, known, options.sigma_gradient)?;
    let strength = corner_strength(&g.x, &g.y, &g.weight, options.sigma_window);
    let (w, h) = (image.width, image.height);
    let mut positive: Vec<f32> = strength.values.iter().copied().filter(|s| *s > 0.0).collect();
    if positive.is_empty() {
        return Ok(Vec::new());
    }
    let middle = positive.len() / 2;
    let floor = options.floor * *positive.select_nth_unstable_by(middle, f32::total_cmp).1;
    let cell = options.cell.max(1);
    let border = options.border.max(1);
    let cells: Vec<(usize, usize)> =
        (0..h.div_ceil(cell)).flat_map(|j| (0..w.div_ceil(cell)).map(move |i| (i, j))).collect();
    let found: Vec<Vec<Interest>> = cells
        .par_iter()
        .map(|&(i, j)| {
            let mut candidates = Vec::new();
            for y in (j * cell).max(border)..((j + 1) * cell).min(h.saturating_sub(border)) {
                for x in (i * cell).max(border)..((i + 1) * cell).min(w.saturating_sub(border)) {
                    let s = strength.at(x, y);
                    if s > floor && is_peak(&strength, x, y) {
                        candidates.push(Interest { x, y, strength: s });
                    }
                }
            }
            candidates.sort_by(|a, b| b.strength.total_cmp(&a.strength).then((a.y, a.x).cmp(&(b.y, b.x))));
            candidates.truncate(options.per_cell);
            candidates
        })
        .collect();
    Ok(found.into_iter().flatten().collect())
}

fn is_peak(s: &Plane, x: usize, y: usize) -> bool {
    let v = s.at(x, y);
    // Strictly above what comes before and not below what comes after: of equal neighbours one remains.
    for dy in [-1i32, 0, 1] {
        for dx in [-1i32, 0, 1] {
            let before = (dy, dx) < (0, 0);
            let n = s.at((x as i32 + dx) as usize, (y as i32 + dy) as usize);
            if (dy, dx) != (0, 0) && (n > v || (before && n == v)) {
                return false;
            }
        }
    }
    true
}

fn corner_strength(gx: &Plane, gy: &Plane, weight: &Plane, sigma: f32) -> Plane {
    let mean_square = {
        let sum: f64 = gx.values.iter().zip(&gy.values).map(|(a, b)| f64::from(a * a + b * b)).sum();
        let count: f64 = weight.values.iter().map(|w| f64::from(*w)).sum();
        (sum / count.max(1.0)) as f32
    };
    let saturated = |a: f32, b: f32, product: f32| product / (a * a + b * b + mean_square.max(f32::MIN_POSITIVE));
    let blur = |p: Plane| masked_blur(&p, Some(weight), sigma);
    let xx = blur(gx.zip(gy, |a, b| saturated(a, b, a * a)));
    let xy = blur(gx.zip(gy, |a, b| saturated(a, b, a * b)));
    let yy = blur(gx.zip(gy, |a, b| saturated(a, b, b * b)));
    Plane::by_rows(gx.width, gx.height, |y, out| {
        for (x, o) in out.iter_mut().enumerate() {
            if weight.at(x, y) > 0.0 {
                let (a, b, c) = (xx.at(x, y), xy.at(x, y), yy.at(x, y));
                *o = 0.5 * (a + c) - (0.25 * (a - c) * (a - c) + b * b).sqrt();
            }
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn corners_are_found_and_edges_are_not() {
        let image = Plane::by_rows(96, 96, |y, row| {
            for (x, v) in row.iter_mut().enumerate() {
                *v = if (30..66).contains(&x) && (30..66).contains(&y) { 1.0 } else { 0.0 };
            }
        });
        let options =
            InterestOptions { cell: 48, per_cell: 1, sigma_window: 2.0, floor: 5.0, ..InterestOptions::default() };
        let points = interest_points(&image, None, &options).unwrap();
        assert_eq!(points.len(), 4, "{points:?}");
        for p in points {
            let near = |v: usize| (v as f32 - 29.5).abs().min((v as f32 - 65.5).abs());
            assert!(near(p.x) < 4.0 && near(p.y) < 4.0, "{p:?}");
        }
    }

    #[test]
    fn nothing_is_found_where_nothing_is_known() {
        let image = Plane::by_rows(64, 64, |y, row| {
            for (x, v) in row.iter_mut().enumerate() {
                *v = ((x * 7 + y * 13) % 11) as f32;
            }
        });
        let known = Plane::by_rows(64, 64, |_, row| row.iter_mut().take(32).for_each(|v| *v = 1.0));
        let points = interest_points(&image, Some(&known), &InterestOptions::default()).unwrap();
        assert!(!points.is_empty() && points.iter().all(|p| p.x < 31));
        let none = Plane::filled(64, 64, 0.0);
        assert!(interest_points(&image, Some(&none), &InterestOptions::default()).unwrap().is_empty());
    }
}
