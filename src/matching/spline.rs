//! Cubic B-splines, by which pictures are read between their pixels with a derivative that fits.

use super::plane::Plane;

/// The pole of the filter that undoes the splines' sum, and how soon its powers are below a float's resolution.
const POLE: f32 = -0.267_949_2;
const HORIZON: usize = 14;

/// The four cubic B-spline weights around t in [0, 1], and their derivatives.
pub(super) fn spline(t: f64) -> ([f64; 4], [f64; 4]) {
    let (s, t2) = (1.0 - t, t * t);
    let t3 = t2 * t;
    (
        [s * s * s / 6.0, (4.0 - 6.0 * t2 + 3.0 * t3) / 6.0, (1.0 + 3.0 * t + 3.0 * t2 - 3.0 * t3) / 6.0, t3 / 6.0],
        [-0.5 * s * s, (-12.0 * t + 9.0 * t2) / 6.0, (3.0 + 6.0 * t - 9.0 * t2) / 6.0, 0.5 * t2],
    )
}

/// The coefficients whose splines go through the plane's samples, mirrored about the outermost: Unser, Aldroubi and Eden,
/// IEEE Trans. Signal Processing 41(2), 1993. First along the rows, then along the columns.
pub(super) fn interpolating(plane: &Plane) -> Plane {
    let (width, height) = (plane.width, plane.height);
    let mut out = Plane::by_rows(width, height, |y, row| {
        row.copy_from_slice(plane.row(y));
        filtered(row, 1);
    });
    filtered(&mut out.values, width);
    out
}

/// Both passes of the filter over samples of `stride` numbers that are filtered side by side.
fn filtered(values: &mut [f32], stride: usize) {
    let count = values.len() / stride;
    if count < 2 {
        return;
    }
    let mut first = values[..stride].to_vec();
    let mut power = 1.0;
    for sample in values.chunks_exact(stride).take(HORIZON).skip(1) {
        power *= POLE;
        first.iter_mut().zip(sample).for_each(|(f, s)| *f += power * s);
    }
    values[..stride].copy_from_slice(&first);
    for k in 1..count {
        let (before, here) = values[(k - 1) * stride..(k + 1) * stride].split_at_mut(stride);
        here.iter_mut().zip(before).for_each(|(h, b)| *h += POLE * *b);
    }
    let (before, last) = values[(count - 2) * stride..].split_at_mut(stride);
    last.iter_mut().zip(before).for_each(|(l, b)| *l = POLE / (POLE * POLE - 1.0) * (*l + POLE * *b));
    for k in (0..count - 1).rev() {
        let (here, after) = values[k * stride..(k + 2) * stride].split_at_mut(stride);
        here.iter_mut().zip(after).for_each(|(h, a)| *h = POLE * (*a - *h));
    }
    values.iter_mut().for_each(|v| *v *= 6.0);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn splines_go_through_the_samples() {
        let plane = Plane::by_rows(37, 29, |y, row| {
            for (x, v) in row.iter_mut().enumerate() {
                *v = ((x * 7919 + y * 104_729) % 101) as f32 / 101.0;
            }
        });
        let coefficients = interpolating(&plane);
        let (w, _) = spline(0.0);
        for y in 1..27 {
            for x in 1..35 {
                let read: f64 = (0..3)
                    .flat_map(|j| (0..3).map(move |i| (i, j)))
                    .map(|(i, j)| w[i] * w[j] * f64::from(coefficients.at(x + i - 1, y + j - 1)))
                    .sum();
                assert!((read - f64::from(plane.at(x, y))).abs() < 1e-5, "{x} {y}: {read} {}", plane.at(x, y));
            }
        }
    }

    #[test]
    fn a_constant_stays_one() {
        for (width, height) in [(40, 30), (1, 1)] {
            let out = interpolating(&Plane::filled(width, height, 0.7));
            assert!(out.values.iter().all(|v| (v - 0.7).abs() < 1e-5), "{:?}", out.values);
        }
    }
}
