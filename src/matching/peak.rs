//! The peak of a score surface: where it is to a fraction of a pixel, how sure that is, and whether it stands alone.

use super::correlation::Surface;

/// A local maximum of a surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Peak {
    /// Shift in x and y, px, sub-pixel.
    pub shift: [f64; 2],
    /// The score at the pixel of the maximum.
    pub score: f32,
    /// −H, the negative second derivatives of the score: xx, xy, yy, per px².
    pub curvature: [f64; 3],
    column: usize,
    row: usize,
}

impl Peak {
    /// Covariance of the shift (xx, xy, yy; px²) for `samples` independent pixels: that of least squares matching,
    /// written with the correlation ρ and its curvature, (1 − ρ²) / (n ρ) (−H)⁻¹. `None` where the surface is a ridge.
    pub fn covariance(&self, samples: f64) -> Option<[f64; 3]> {
        let [a, b, c] = self.curvature;
        let determinant = a * c - b * b;
        let rho = f64::from(self.score);
        if !(a > 0.0 && c > 0.0 && determinant > 1e-6 * (a + c) * (a + c) && rho > 0.0) {
            return None;
        }
        let scale = (1.0 - rho * rho).max(1e-4) / (samples.max(1.0) * rho * determinant);
        Some([scale * c, -scale * b, scale * a])
    }
}

/// The highest local maxima, best first, no two nearer than `apart` in both x and y. Maxima at the border of the window
/// are none: the true one may lie outside.
pub(super) fn highest(surface: &Surface, most: usize, apart: usize) -> Vec<Peak> {
    let side = surface.side();
    let at = |x: usize, y: usize| surface.scores[y * side + x];
    let mut peaks: Vec<(f32, usize, usize)> = Vec::new();
    for y in 1..side.saturating_sub(1) {
        for x in 1..side - 1 {
            let v = at(x, y);
            let mut is_peak = v.is_finite();
            for (u, w) in neighbours(x, y) {
                let n = at(u, w);
                let before = (w, u) < (y, x);
                is_peak &= n.is_finite() && (n < v || (n == v && !before));
            }
            if is_peak {
                peaks.push((v, x, y));
            }
        }
    }
    peaks.sort_by(|a, b| b.0.total_cmp(&a.0).then((a.2, a.1).cmp(&(b.2, b.1))));
    let mut kept: Vec<Peak> = Vec::new();
    for (score, x, y) in peaks {
        if kept.iter().all(|p| p.column.abs_diff(x).max(p.row.abs_diff(y)) > apart) {
            kept.push(fitted(surface, x, y, score));
            if kept.len() == most {
                break;
            }
        }
    }
    kept
}

/// Whether the highest value of all lies on the border or beside something unknown.
pub(super) fn best_is_at_the_border(surface: &Surface) -> bool {
    let side = surface.side();
    let best = (0..surface.scores.len())
        .filter(|&i| surface.scores[i].is_finite())
        .max_by(|&a, &b| surface.scores[a].total_cmp(&surface.scores[b]).then(b.cmp(&a)));
    best.is_none_or(|i| {
        let (x, y) = (i % side, i / side);
        x == 0
            || y == 0
            || x + 1 == side
            || y + 1 == side
            || neighbours(x, y).any(|(u, v)| !surface.scores[v * side + u].is_finite())
    })
}

fn neighbours(x: usize, y: usize) -> impl Iterator<Item = (usize, usize)> {
    (0..9).filter(|i| *i != 4).map(move |i| (x + i % 3 - 1, y + i / 3 - 1))
}

/// The quadric through the 3 × 3 scores around a maximum, by least squares.
fn fitted(surface: &Surface, x: usize, y: usize, score: f32) -> Peak {
    let side = surface.side();
    let f = |dx: usize, dy: usize| f64::from(surface.scores[(y + dy - 1) * side + x + dx - 1]);
    let column = |dx: usize| f(dx, 0) + f(dx, 1) + f(dx, 2);
    let row = |dy: usize| f(0, dy) + f(1, dy) + f(2, dy);
    let gradient = [(column(2) - column(0)) / 6.0, (row(2) - row(0)) / 6.0];
    let xx = -(column(0) - 2.0 * column(1) + column(2)) / 3.0;
    let yy = -(row(0) - 2.0 * row(1) + row(2)) / 3.0;
    let xy = -(f(0, 0) - f(2, 0) - f(0, 2) + f(2, 2)) / 4.0;
    let determinant = xx * yy - xy * xy;
    let mut offset = [0.0; 2];
    if xx > 0.0 && yy > 0.0 && determinant > 0.0 {
        offset =
            [(yy * gradient[0] - xy * gradient[1]) / determinant, (xx * gradient[1] - xy * gradient[0]) / determinant];
        // Far along a ridge the quadric says nothing: stay where the scores are.
        let longest = offset[0].abs().max(offset[1].abs());
        if longest > 1.0 {
            offset = offset.map(|v| v / longest);
        }
    }
    let centre = surface.radius as f64;
    Peak {
        shift: [x as f64 - centre + offset[0], y as f64 - centre + offset[1]],
        score,
        curvature: [xx, xy, yy],
        column: x,
        row: y,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn surface(radius: usize, f: impl Fn(f64, f64) -> f64) -> Surface {
        let r = radius as i32;
        let scores = (-r..=r).flat_map(|y| (-r..=r).map(move |x| (x, y))).map(|(x, y)| f(x.into(), y.into()) as f32);
        Surface { radius, scores: scores.collect() }
    }

    #[test]
    fn a_quadric_is_found_exactly() {
        let s = surface(6, |x, y| {
            let (u, v) = (x - 1.3, y + 2.4);
            0.9 - 0.02 * u * u - 0.01 * v * v + 0.008 * u * v
        });
        let peaks = highest(&s, 2, 2);
        assert_eq!(peaks.len(), 1);
        assert!((peaks[0].shift[0] - 1.3).abs() < 1e-4 && (peaks[0].shift[1] + 2.4).abs() < 1e-4);
        assert!((peaks[0].curvature[0] - 0.04).abs() < 1e-5 && (peaks[0].curvature[1] + 0.008).abs() < 1e-5);
        let [a, b, c] = peaks[0].covariance(100.0).unwrap();
        assert!(a > 0.0 && c > a && b > 0.0);
    }

    #[test]
    fn a_second_peak_is_listed_and_a_border_is_no_peak() {
        let two = |x: f64, y: f64| {
            0.8 * (-((x - 3.0).powi(2) + y * y) / 4.0).exp() + 0.7 * (-((x + 3.0).powi(2) + y * y) / 4.0).exp()
        };
        let peaks = highest(&surface(7, two), 3, 2);
        assert_eq!(peaks.len(), 2);
        assert!(peaks[0].shift[0] > 2.5 && peaks[1].shift[0] < -2.5);
        let slope = surface(5, |x, _| 0.1 * x);
        assert!(best_is_at_the_border(&slope) && highest(&slope, 1, 2).is_empty());
        assert!(!best_is_at_the_border(&surface(7, two)));
    }

    #[test]
    fn a_ridge_has_no_covariance() {
        let ridge = surface(5, |x, y| 0.9 - 0.02 * (x - y).powi(2) - 1e-9 * (x + y).powi(2));
        let peaks = highest(&ridge, 1, 2);
        assert!(peaks.iter().all(|p| p.covariance(100.0).is_none()));
    }
}
