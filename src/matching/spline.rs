//! Cubic B-splines, by which pictures are read between their pixels with a derivative that fits.

/// The four cubic B-spline weights around t in [0, 1], and their derivatives.
pub(super) fn spline(t: f64) -> ([f64; 4], [f64; 4]) {
    let (s, t2) = (1.0 - t, t * t);
    let t3 = t2 * t;
    (
        [s * s * s / 6.0, (4.0 - 6.0 * t2 + 3.0 * t3) / 6.0, (1.0 + 3.0 * t + 3.0 * t2 - 3.0 * t3) / 6.0, t3 / 6.0],
        [-0.5 * s * s, (-12.0 * t + 9.0 * t2) / 6.0, (3.0 + 6.0 * t - 9.0 * t2) / 6.0, 0.5 * t2],
    )
}
