//! Intensities of the scan's points against the photo's channels where the points are: patch by patch, a linear
//! regression whose remainder says how the view has to move.
//!
//! No picture is made of the scan. An edge of the scan lies somewhere between two rows of points, which are farther
//! apart than the photo's pixels; a picture has to put it somewhere, in the middle, and along a kerb that follows the
//! rows all of it is wrong by the same. Here the photo, which is sampled finely enough, is read at the points' own places;
//! where in the gap the edge lies is left open, and the many gaps of a scene settle it together.
//!
//! Reflectance in near infrared is no function of colour, but among the few materials of a patch it is very nearly a
//! linear one, with coefficients of the patch's own. These are eliminated (variable projection: Golub and Pereyra 1973,
//! in Kaufman's form of 1975); what is left of a patch's n points is normal with an unknown variance, so that its
//! log-likelihood is `-n/2 log(1 - R²)`: a patch in which nothing of the intensity is explained has no say.

use rayon::prelude::*;

use super::plane::Plane;
use super::spline::{interpolating, spline};
use crate::error::{Error, Result};

/// Most channels of a photo.
const CHANNELS: usize = 4;

/// The channels, and a polynomial of second order in x and y without its constant.
const REGRESSORS: usize = CHANNELS + 5;

/// A photo's channels as spline coefficients, ready to be read between pixels.
#[derive(Debug, Clone)]
pub struct RegressionPhoto {
    planes: Vec<Plane>,
}

/// How patches are regressed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RegressionOptions {
    /// Patches with fewer points have no say.
    pub least_points: usize,
    /// Points beyond this many standard deviations of their patch are left out, nearer ones weighted by Tukey's
    /// biweight; infinite takes all alike.
    pub cut: f64,
    /// The order of the polynomial in x and y that goes into the regression, 0 to 2: what changes slowly over a patch,
    /// lamplight in the photo, the angle of incidence in the scan, is not the same in both and would be taken for a shift.
    pub order: usize,
    /// What is added to the channels' variances, as a share of their sum: channels are nearly alike in grey patches.
    pub ridge: f64,
}

impl Default for RegressionOptions {
    fn default() -> Self {
        Self { least_points: 40, cut: f64::INFINITY, order: 2, ridge: 1e-3 }
    }
}

/// What one patch says of U parameters.
#[derive(Debug, Clone, PartialEq)]
pub struct Patch {
    /// (U,): of the log-likelihood.
    pub gradient: Vec<f64>,
    /// (U, U), row by row: the Gauss–Newton information.
    pub information: Vec<f64>,
    /// `-n/2 log(1 - R²)`.
    pub value: f64,
    /// The share of the intensities' variance that the photo explains.
    pub explained: f64,
    /// The sum of the points' weights.
    pub points: f64,
}

impl RegressionPhoto {
    /// From planes of equal size.
    pub fn new(planes: &[Plane]) -> Result<Self> {
        if planes.is_empty() || planes.len() > CHANNELS {
            return Err(Error::invalid(format!("a photo has 1 to {CHANNELS} channels, not {}", planes.len())));
        }
        Ok(Self { planes: planes.par_iter().map(interpolating).collect() })
    }

    /// Values and derivatives by x and y of all channels; `None` within two pixels of the border. The splines go
    /// through the samples: read through a blur, an edge says of every column of points that it reaches how far the
    /// column is from it, and is pushed to the middle between two.
    fn read(&self, x: f64, y: f64) -> Option<[[f64; 3]; CHANNELS]> {
        let first = self.planes.first()?;
        let (fx, fy) = (x.floor(), y.floor());
        if !(fx >= 1.0 && fy >= 1.0 && fx + 2.0 < first.width as f64 && fy + 2.0 < first.height as f64) {
            return None;
        }
        let (column, row) = (fx as usize - 1, fy as usize - 1);
        let (wx, dx) = spline(x - fx);
        let (wy, dy) = spline(y - fy);
        let mut out = [[0.0; 3]; CHANNELS];
        for (plane, out) in self.planes.iter().zip(&mut out) {
            for j in 0..4 {
                let line = &plane.row(row + j)[column..column + 4];
                let (mut sum, mut slope) = (0.0, 0.0);
                for i in 0..4 {
                    sum += wx[i] * f64::from(line[i]);
                    slope += dx[i] * f64::from(line[i]);
                }
                out[0] += wy[j] * sum;
                out[1] += wy[j] * slope;
                out[2] += dy[j] * sum;
            }
        }
        Some(out)
    }
}

/// Regresses every patch. Rows of `xy` (photo, px) and `values` (intensities) go together; `design` has 2 U numbers for
/// each point, the derivatives of x by the U parameters, then of y. `patches` lists each patch's points.
pub fn regress_patches(
    photo: &RegressionPhoto,
    xy: &[[f64; 2]],
    design: &[f64],
    values: &[f32],
    patches: &[&[i64]],
    options: &RegressionOptions,
) -> Result<Vec<Patch>> {
    if xy.is_empty() || values.len() != xy.len() || !design.len().is_multiple_of(2 * xy.len()) || design.is_empty() {
        return Err(Error::invalid(format!(
            "{} places, {} intensities and {} derivatives do not go together",
            xy.len(),
            values.len(),
            design.len()
        )));
    }
    let parameters = design.len() / (2 * xy.len());
    let known = |i: &i64| usize::try_from(*i).is_ok_and(|i| i < xy.len());
    if !patches.iter().all(|p| p.iter().all(known)) {
        return Err(Error::invalid(format!("a patch names a point that is none of the {}", xy.len())));
    }
    // Patches of several layouts share their points.
    let read: Vec<_> = xy.par_iter().map(|[x, y]| photo.read(*x, *y)).collect();
    let channels = photo.planes.len();
    Ok(patches
        .par_iter()
        .map(|members| {
            let mut points: Vec<Point> = members
                .iter()
                .filter_map(|&i| {
                    let i = i as usize;
                    let [x, y] = xy[i];
                    let value = f64::from(values[i]);
                    let design = &design[2 * parameters * i..2 * parameters * (i + 1)];
                    if !(x.is_finite() && y.is_finite() && value.is_finite() && design.iter().all(|d| d.is_finite())) {
                        return None;
                    }
                    let mut terms = [[0.0; 3]; REGRESSORS];
                    terms[..CHANNELS].copy_from_slice(&read[i]?);
                    Some(Point { at: [x, y], terms, value, design })
                })
                .collect();
            let terms = add_polynomial(&mut points, channels, options.order);
            // Loops of known lengths take half the time.
            match terms {
                1 => regress::<1>(&points, parameters, channels, options),
                2 => regress::<2>(&points, parameters, channels, options),
                3 => regress::<3>(&points, parameters, channels, options),
                4 => regress::<4>(&points, parameters, channels, options),
                5 => regress::<5>(&points, parameters, channels, options),
                6 => regress::<6>(&points, parameters, channels, options),
                7 => regress::<7>(&points, parameters, channels, options),
                8 => regress::<8>(&points, parameters, channels, options),
                _ => regress::<REGRESSORS>(&points, parameters, channels, options),
            }
        })
        .collect())
}

/// Puts the polynomial's terms, of coordinates -1 to 1, behind the channels. Returns the number of regressors.
fn add_polynomial(points: &mut [Point], channels: usize, order: usize) -> usize {
    let mut bounds = [f64::INFINITY, f64::NEG_INFINITY, f64::INFINITY, f64::NEG_INFINITY];
    for p in points.iter() {
        bounds = [bounds[0].min(p.at[0]), bounds[1].max(p.at[0]), bounds[2].min(p.at[1]), bounds[3].max(p.at[1])];
    }
    let unit = |v: f64, low: f64, high: f64| (2.0 * v - low - high) / (high - low).max(1.0);
    let count = [0, 2, 5][order.min(2)];
    for p in points {
        let (x, y) = (unit(p.at[0], bounds[0], bounds[1]), unit(p.at[1], bounds[2], bounds[3]));
        for (term, value) in p.terms[channels..].iter_mut().zip([x, y, x * x, x * y, y * y]).take(count) {
            // These do not move with the view.
            *term = [value, 0.0, 0.0];
        }
    }
    channels + count
}

struct Point<'a> {
    at: [f64; 2],
    /// Value and derivatives by x and y, for each regressor.
    terms: [[f64; 3]; REGRESSORS],
    value: f64,
    design: &'a [f64],
}

impl Point<'_> {
    /// The values of the first T regressors less their means.
    fn centred<const T: usize>(&self, mean: &[f64; T]) -> [f64; T] {
        std::array::from_fn(|c| self.terms[c][0] - mean[c])
    }
}

/// The regression of a patch at given weights.
struct Fit<const T: usize> {
    count: f64,
    mean: [f64; T],
    coefficients: [f64; T],
    inverse: [[f64; T]; T],
    residuals: Vec<f64>,
    /// Σ w r², and Σ w (I - mean)².
    left: f64,
    whole: f64,
}

/// Of the T regressors in use the first are the photo's `channels`.
fn regress<const T: usize>(points: &[Point], parameters: usize, channels: usize, options: &RegressionOptions) -> Patch {
    let silent = |points: f64| Patch {
        gradient: vec![0.0; parameters],
        information: vec![0.0; parameters * parameters],
        value: 0.0,
        explained: 0.0,
        points,
    };
    if points.len() < options.least_points.max(T + 2) {
        return silent(points.len() as f64);
    }
    let mut weights = vec![1.0; points.len()];
    let mut fit = fitted::<T>(points, &weights, channels, options.ridge);
    if options.cut.is_finite() {
        for _ in 0..3 {
            let Some(found) = &fit else { break };
            let scale = options.cut * robust_sigma(&found.residuals);
            if scale <= 0.0 {
                break;
            }
            for (w, r) in weights.iter_mut().zip(&found.residuals) {
                let t = (r / scale).powi(2);
                *w = if t < 1.0 { (1.0 - t).powi(2) } else { 0.0 };
            }
            fit = fitted::<T>(points, &weights, channels, options.ridge);
        }
    }
    let Some(fit) = fit else { return silent(points.len() as f64) };
    let explained = 1.0 - fit.left / fit.whole;
    // Rounding must not make a perfect patch outvote all others.
    let variance = (fit.left / fit.count).max(1e-6 * fit.whole / fit.count);
    if !(explained > 0.0 && fit.count >= options.least_points as f64) {
        return silent(fit.count);
    }
    // The derivative of what is predicted, by the parameters, less what mean and coefficients take of it.
    let mut slopes: Vec<f64> = Vec::with_capacity(points.len() * parameters);
    let mut mean = vec![0.0; parameters];
    for (p, w) in points.iter().zip(&weights) {
        let (mut by_x, mut by_y) = (0.0, 0.0);
        for (c, b) in p.terms.iter().zip(&fit.coefficients) {
            by_x += b * c[1];
            by_y += b * c[2];
        }
        let (x, y) = p.design.split_at(parameters);
        for ((m, dx), dy) in mean.iter_mut().zip(x).zip(y) {
            let s = by_x * dx + by_y * dy;
            slopes.push(s);
            *m += w * s / fit.count;
        }
    }
    let mut with_terms = vec![[0.0; T]; parameters];
    for ((p, w), s) in points.iter().zip(&weights).zip(slopes.chunks_exact_mut(parameters)) {
        let centred: [f64; T] = p.centred(&fit.mean);
        for ((s, m), sum) in s.iter_mut().zip(&mean).zip(&mut with_terms) {
            *s -= m;
            for c in 0..T {
                sum[c] += w * *s * centred[c];
            }
        }
    }
    let taken: Vec<[f64; T]> = with_terms.iter().map(|sum| times(&fit.inverse, sum)).collect();
    let mut gradient = vec![0.0; parameters];
    let mut information = vec![0.0; parameters * parameters];
    for (i, (p, w)) in points.iter().zip(&weights).enumerate() {
        let s = &mut slopes[i * parameters..(i + 1) * parameters];
        let centred: [f64; T] = p.centred(&fit.mean);
        for (s, t) in s.iter_mut().zip(&taken) {
            for c in 0..T {
                *s -= t[c] * centred[c];
            }
        }
        let weight = w / variance;
        for (a, sa) in s.iter().enumerate() {
            gradient[a] += weight * sa * fit.residuals[i];
            for (b, sb) in s.iter().enumerate().take(a + 1) {
                information[a * parameters + b] += weight * sa * sb;
            }
        }
    }
    for a in 0..parameters {
        for b in 0..a {
            information[b * parameters + a] = information[a * parameters + b];
        }
    }
    let value = -0.5 * fit.count * (variance * fit.count / fit.whole).ln();
    Patch { gradient, information, value, explained, points: fit.count }
}

fn fitted<const T: usize>(points: &[Point], weights: &[f64], channels: usize, ridge: f64) -> Option<Fit<T>> {
    let count: f64 = weights.iter().sum();
    if count <= T as f64 + 1.0 {
        return None;
    }
    let (mut mean, mut middle) = ([0.0; T], 0.0);
    for (p, w) in points.iter().zip(weights) {
        middle += w * p.value / count;
        for c in 0..T {
            mean[c] += w * p.terms[c][0] / count;
        }
    }
    let (mut normal, mut right, mut whole) = ([[0.0; T]; T], [0.0; T], 0.0);
    for (p, w) in points.iter().zip(weights) {
        let value = p.value - middle;
        whole += w * value * value;
        let centred: [f64; T] = p.centred(&mean);
        for a in 0..T {
            let weighted = w * centred[a];
            right[a] += weighted * value;
            for b in 0..T {
                normal[a][b] += weighted * centred[b];
            }
        }
    }
    let trace: f64 = (0..channels).map(|c| normal[c][c]).sum();
    if !(trace > 0.0 && whole > 0.0) {
        return None;
    }
    for a in 0..T {
        for b in 0..a {
            normal[b][a] = normal[a][b];
        }
        normal[a][a] = if a < channels { normal[a][a] + ridge * trace } else { (1.0 + 1e-6) * normal[a][a] + 1e-6 };
    }
    let inverse = inverted(normal)?;
    let coefficients = times(&inverse, &right);
    let residuals: Vec<f64> = points
        .iter()
        .map(|p| {
            let centred: [f64; T] = p.centred(&mean);
            let explained: f64 = coefficients.iter().zip(centred).map(|(b, c)| b * c).sum();
            p.value - middle - explained
        })
        .collect();
    let left = residuals.iter().zip(weights).map(|(r, w)| w * r * r).sum();
    Some(Fit { count, mean, coefficients, inverse, residuals, left, whole })
}

/// 1.4826 times the median of the absolute values.
fn robust_sigma(residuals: &[f64]) -> f64 {
    let mut sizes: Vec<f64> = residuals.iter().map(|r| r.abs()).collect();
    let middle = sizes.len() / 2;
    if sizes.is_empty() { 0.0 } else { 1.4826 * *sizes.select_nth_unstable_by(middle, f64::total_cmp).1 }
}

fn times<const T: usize>(m: &[[f64; T]; T], v: &[f64; T]) -> [f64; T] {
    std::array::from_fn(|a| m[a].iter().zip(v).map(|(m, v)| m * v).sum())
}

/// Inverse of a symmetric positive definite matrix by Gauss–Jordan elimination; `None` where it is none.
fn inverted<const T: usize>(mut m: [[f64; T]; T]) -> Option<[[f64; T]; T]> {
    let mut out: [[f64; T]; T] = std::array::from_fn(|a| std::array::from_fn(|b| f64::from(a == b)));
    for a in 0..T {
        let pivot = m[a][a];
        if !(pivot > 0.0 && pivot.is_finite()) {
            return None;
        }
        for b in 0..T {
            m[a][b] /= pivot;
            out[a][b] /= pivot;
        }
        for r in (0..T).filter(|r| *r != a) {
            let factor = m[r][a];
            for b in 0..T {
                m[r][b] -= factor * m[a][b];
                out[r][b] -= factor * out[a][b];
            }
        }
    }
    Some(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Smooth textures of three channels, and an intensity that is linear in them.
    fn photo() -> RegressionPhoto {
        let plane = |k: f32| {
            Plane::by_rows(120, 100, move |y, row| {
                for (x, v) in row.iter_mut().enumerate() {
                    let (x, y) = (x as f32, y as f32);
                    *v = (0.31 * x + 0.12 * k * y + k).sin() + (0.23 * y - 0.17 * k * x).cos();
                }
            })
        };
        RegressionPhoto::new(&[plane(1.0), plane(2.0), plane(3.0)]).unwrap()
    }

    fn scattered(n: usize) -> Vec<[f64; 2]> {
        (0..n)
            .map(|i| {
                let t = i as f64;
                [10.0 + 90.0 * (t * 0.754_877_666).fract(), 10.0 + 75.0 * (t * 0.569_840_29).fract()]
            })
            .collect()
    }

    /// Intensities at the places, which the view sees `shift` px beside them.
    fn case(shift: [f64; 2], spoilt: usize) -> (RegressionPhoto, Vec<[f64; 2]>, Vec<f32>) {
        let photo = photo();
        let xy = scattered(600);
        let values = xy
            .iter()
            .enumerate()
            .map(|(i, [x, y])| {
                let c = photo.read(*x, *y).unwrap();
                let noise = 0.02 * ((i as f64 * 12.9898).sin() * 43_758.545_3).fract();
                let blunder = if i % 20 < spoilt { 3.0 } else { 0.0 };
                (2.0 + 0.8 * c[0][0] - 0.3 * c[1][0] + 0.1 * c[2][0] + noise + blunder) as f32
            })
            .collect();
        let seen = xy.iter().map(|[x, y]| [x + shift[0], y + shift[1]]).collect();
        (photo, seen, values)
    }

    fn shift_found(mut xy: Vec<[f64; 2]>, photo: &RegressionPhoto, values: &[f32], cut: f64) -> [f64; 2] {
        let design: Vec<f64> = xy.iter().flat_map(|_| [1.0, 0.0, 0.0, 1.0]).collect();
        let (first, second): (Vec<i64>, Vec<i64>) = (0..600).partition(|i| xy[*i as usize][0] < 55.0);
        let options = RegressionOptions { cut, ..RegressionOptions::default() };
        let mut total = [0.0; 2];
        for _ in 0..20 {
            let found = regress_patches(photo, &xy, &design, values, &[&first, &second], &options).unwrap();
            let (mut g, mut h) = ([0.0; 2], [0.0; 4]);
            for p in &found {
                (0..2).for_each(|a| g[a] += p.gradient[a]);
                (0..4).for_each(|a| h[a] += p.information[a]);
            }
            let determinant = h[0] * h[3] - h[1] * h[2];
            let step = [(h[3] * g[0] - h[1] * g[1]) / determinant, (h[0] * g[1] - h[2] * g[0]) / determinant];
            for p in &mut xy {
                p[0] += step[0];
                p[1] += step[1];
            }
            total[0] += step[0];
            total[1] += step[1];
        }
        total
    }

    #[test]
    fn a_shift_is_found_to_a_hundredth_of_a_pixel() {
        let (photo, xy, values) = case([0.9, -0.6], 0);
        let found = shift_found(xy, &photo, &values, f64::INFINITY);
        assert!((found[0] + 0.9).abs() < 0.01 && (found[1] - 0.6).abs() < 0.01, "{found:?}");
    }

    #[test]
    fn points_that_do_not_belong_are_left_out() {
        let (photo, xy, values) = case([0.4, 0.3], 2);
        let cut = shift_found(xy, &photo, &values, 4.0);
        assert!((cut[0] + 0.4).abs() < 0.01 && (cut[1] + 0.3).abs() < 0.01, "{cut:?}");
    }

    #[test]
    fn the_gradient_is_the_derivative_of_the_value() {
        let (photo, xy, values) = case([0.3, 0.2], 0);
        let design: Vec<f64> = xy.iter().flat_map(|_| [1.0, 0.0, 0.0, 1.0]).collect();
        let all: Vec<i64> = (0..600).collect();
        let options = RegressionOptions { ridge: 0.0, ..RegressionOptions::default() };
        let at = |dx: f64, dy: f64| {
            let moved: Vec<[f64; 2]> = xy.iter().map(|[x, y]| [x + dx, y + dy]).collect();
            regress_patches(&photo, &moved, &design, &values, &[&all], &options).unwrap().remove(0)
        };
        let (here, h) = (at(0.0, 0.0), 1e-4);
        let numeric =
            [(at(h, 0.0).value - at(-h, 0.0).value) / (2.0 * h), (at(0.0, h).value - at(0.0, -h).value) / (2.0 * h)];
        for (a, n) in here.gradient.iter().zip(numeric) {
            assert!((a - n).abs() < 1e-3 * n.abs(), "{a} {n}");
        }
    }

    #[test]
    fn patches_without_likeness_or_points_are_silent_and_nonsense_is_refused() {
        let (photo, xy, values) = case([0.0; 2], 0);
        let design = vec![1.0; 4 * 600];
        let few: Vec<i64> = (0..10).collect();
        let all: Vec<i64> = (0..600).collect();
        let options = RegressionOptions::default();
        let constant = vec![1.0; 600];
        let found = regress_patches(&photo, &xy, &design, &constant, &[&few, &all], &options).unwrap();
        assert!(found.iter().all(|p| p.value == 0.0 && p.gradient == [0.0, 0.0]), "{found:?}");
        assert!(regress_patches(&photo, &xy, &design, &values, &[&[600]], &options).is_err());
        assert!(regress_patches(&photo, &xy, &design[1..], &values, &[&all], &options).is_err());
        assert!(RegressionPhoto::new(&[]).is_err());
    }
}
