//! Brown's distortion in OpenCV's form, polynomial or rational, on the normalised image plane.
//!
//! ```text
//! g  = (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶)
//! xd = x g + 2 p1 x y + p2 (r² + 2 x²)
//! yd = y g + p1 (r² + 2 y²) + 2 p2 x y
//! ```
//! Source: D. C. Brown, Close-range camera calibration, 1971; the OpenCV documentation for the rational form.

use super::roots::first_positive_crossing;

/// The terms and the field in which they are valid.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Polynomial {
    /// In the order k1 k2 p1 p2 k3 k4 k5 k6.
    pub k: [f64; 8],
    /// r² up to which r·g(r²) grows: beyond it the model folds back.
    pub max_r2: f64,
    /// r·g at that limit.
    max_rd: f64,
}

/// Derivatives of the distorted coordinates.
pub(super) struct Derivatives {
    /// d(xd, yd)/d(x, y)
    pub d_xy: [[f64; 2]; 2],
    /// d(xd, yd)/d(k1 k2 p1 p2 k3 k4 k5 k6)
    pub d_k: [[f64; 8]; 2],
}

impl Polynomial {
    pub fn new(k: [f64; 8]) -> Self {
        let [k1, k2, _, _, k3, k4, k5, k6] = k;
        let pole = first_positive_crossing(&[1.0, k4, k5, k6]);
        // With N and D the numerator and denominator in s = r²: d(r N/D)/dr · D² = N D + 2 s (N' D − N D').
        let n = [1.0, k1, k2, k3];
        let d = [1.0, k4, k5, k6];
        let mut slope = [0.0; 7];
        for (i, a) in n.iter().enumerate() {
            for (j, b) in d.iter().enumerate() {
                slope[i + j] += a * b * (1.0 + 2.0 * i as f64 - 2.0 * j as f64);
            }
        }
        let fold = first_positive_crossing(&slope);
        let max_r2 = fold.unwrap_or(f64::INFINITY).min(pole.unwrap_or(f64::INFINITY));
        let mut this = Self { k, max_r2, max_rd: f64::INFINITY };
        if max_r2.is_finite() {
            this.max_rd = max_r2.sqrt() * this.radial(max_r2 * (1.0 - 1e-12));
        }
        this
    }

    #[inline(always)]
    fn radial(&self, r2: f64) -> f64 {
        let [k1, k2, _, _, k3, k4, k5, k6] = self.k;
        (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    }

    /// (x, y) → (xd, yd); `None` beyond the valid field.
    #[inline(always)]
    pub fn distort(&self, x: f64, y: f64) -> Option<[f64; 2]> {
        let r2 = x * x + y * y;
        (r2 <= self.max_r2).then(|| self.distort_unchecked(x, y, r2))
    }

    #[inline(always)]
    pub fn distort_unchecked(&self, x: f64, y: f64, r2: f64) -> [f64; 2] {
        let [_, _, p1, p2, ..] = self.k;
        let g = self.radial(r2);
        let xy2 = 2.0 * x * y;
        [x * g + p1 * xy2 + p2 * (r2 + 2.0 * x * x), y * g + p1 * (r2 + 2.0 * y * y) + p2 * xy2]
    }

    /// As [`Polynomial::distort`], with d(xd, yd)/d(x, y), which is symmetric: (xx, xy, yy).
    #[inline(always)]
    pub fn distort_with_slope(&self, x: f64, y: f64) -> Option<([f64; 2], [f64; 3])> {
        self.distort(x, y).map(|distorted| (distorted, self.slope_unchecked(x, y)))
    }

    #[inline(always)]
    fn slope_unchecked(&self, x: f64, y: f64) -> [f64; 3] {
        let [k1, k2, p1, p2, k3, k4, k5, k6] = self.k;
        let r2 = x * x + y * y;
        let per_denominator = 1.0 / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)));
        let g = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) * per_denominator;
        let dg = (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3) - g * (k4 + r2 * (2.0 * k5 + r2 * 3.0 * k6))) * per_denominator;
        let (px, py) = (2.0 * (p1 * x + p2 * y), 2.0 * (p1 * y + p2 * x));
        [g + 2.0 * x * x * dg + py + 4.0 * p2 * x, 2.0 * x * y * dg + px, g + 2.0 * y * y * dg + py + 4.0 * p1 * y]
    }

    pub fn derivatives(&self, x: f64, y: f64) -> Derivatives {
        let [k1, k2, p1, p2, k3, k4, k5, k6] = self.k;
        let r2 = x * x + y * y;
        let (r4, r6) = (r2 * r2, r2 * r2 * r2);
        let denominator = 1.0 + k4 * r2 + k5 * r4 + k6 * r6;
        let g = (1.0 + k1 * r2 + k2 * r4 + k3 * r6) / denominator;
        let dg = (k1 + 2.0 * k2 * r2 + 3.0 * k3 * r4 - g * (k4 + 2.0 * k5 * r2 + 3.0 * k6 * r4)) / denominator;
        let cross = 2.0 * x * y * dg + 2.0 * p1 * x + 2.0 * p2 * y;
        let d_xy = [
            [g + 2.0 * x * x * dg + 2.0 * p1 * y + 6.0 * p2 * x, cross],
            [cross, g + 2.0 * y * y * dg + 6.0 * p1 * y + 2.0 * p2 * x],
        ];
        let dn = 1.0 / denominator;
        let dd = -g / denominator;
        let row = |c: f64, dp1: f64, dp2: f64| {
            [c * r2 * dn, c * r4 * dn, dp1, dp2, c * r6 * dn, c * r2 * dd, c * r4 * dd, c * r6 * dd]
        };
        let d_k = [row(x, 2.0 * x * y, r2 + 2.0 * x * x), row(y, r2 + 2.0 * y * y, 2.0 * x * y)];
        Derivatives { d_xy, d_k }
    }

    /// (xd, yd) → (x, y) by a safeguarded Newton iteration; `None` where no point of the valid field maps there.
    ///
    /// The radial part alone is monotone inside the valid field and gives the start; the fixed-point iteration that is
    /// common elsewhere diverges at the corners of wide lenses.
    pub fn undistort(&self, xd: f64, yd: f64) -> Option<[f64; 2]> {
        if self.k == [0.0; 8] {
            return Some([xd, yd]);
        }
        let rd = xd.hypot(yd);
        if !rd.is_finite() {
            return None;
        }
        let scale = if rd > 0.0 { self.undo_radial(rd) / rd } else { 1.0 };
        let (mut x, mut y) = (xd * scale, yd * scale);
        let miss = |x: f64, y: f64| {
            let [a, b] = self.distort_unchecked(x, y, x * x + y * y);
            [a - xd, b - yd]
        };
        let mut error = miss(x, y);
        for _ in 0..50 {
            let size = error[0].hypot(error[1]);
            let [a, b, d] = self.slope_unchecked(x, y);
            let det = a * d - b * b;
            if size == 0.0 || det.abs() < 1e-14 {
                break;
            }
            let (dx, dy) = ((d * error[0] - b * error[1]) / det, (a * error[1] - b * error[0]) / det);
            let mut step = 1.0;
            let better = loop {
                let (nx, ny) = (x - step * dx, y - step * dy);
                let e = miss(nx, ny);
                if e[0].hypot(e[1]) < size && nx * nx + ny * ny <= self.max_r2 {
                    break Some((nx, ny, e));
                }
                step *= 0.5;
                if step < 1e-6 {
                    break None;
                }
            };
            // No descent is left: at the last digit, or at the border of the field. The test below tells which.
            let Some(next) = better else { break };
            (x, y, error) = next;
        }
        let inside = x * x + y * y <= self.max_r2;
        (inside && error[0].hypot(error[1]) < 1e-11 * (1.0 + rd)).then_some([x, y])
    }

    /// The radius whose radial image is `rd`, or the edge of the valid field where there is none.
    fn undo_radial(&self, rd: f64) -> f64 {
        if rd >= self.max_rd {
            return self.max_r2.sqrt() * (1.0 - 1e-9);
        }
        let mut low = 0.0;
        let mut high = if self.max_r2.is_finite() { self.max_r2.sqrt() } else { rd.max(1.0) };
        if !self.max_r2.is_finite() {
            // Monotone everywhere, but a rational model may level off below rd.
            while high * self.radial(high * high) < rd {
                high *= 2.0;
                if high > 1e8 {
                    return rd;
                }
            }
        }
        let mut r = rd.min(high);
        for _ in 0..60 {
            let value = r * self.radial(r * r) - rd;
            if value > 0.0 {
                high = r
            } else {
                low = r
            }
            let slope = self.slope_unchecked(r, 0.0)[0] - 6.0 * self.k[3] * r;
            let newton = r - value / slope;
            let next = if slope > 0.0 && newton > low && newton < high { newton } else { 0.5 * (low + high) };
            // A start for the iteration in the plane, which has its own end.
            if (next - r).abs() <= 1e-7 * (1.0 + r) {
                return next;
            }
            r = next;
        }
        r
    }
}
