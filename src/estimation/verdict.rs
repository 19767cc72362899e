//! Whether a view may be trusted: every doubt by name, with its figure and the limit that it crossed.
//!
//! A wrong registration called right is the worst that can happen, so whatever could let one pass is looked at: support
//! that chance would give, a second view that explains the points as well, points behind the camera, control in one corner
//! only, parameters that cannot be told apart.

use nalgebra::DMatrix;

use super::parameters::{FreeSet, MAX_FREE};
use crate::geometry::{Model, View};

/// A doubt.
#[derive(Debug, Clone, PartialEq)]
pub struct Warning {
    /// A short name that programs can look for.
    pub code: &'static str,
    /// Whether the view must not be used without a person's look.
    pub fatal: bool,
    /// In words, with the figure, and what to do.
    pub message: String,
    /// The figure.
    pub value: f64,
    /// What it should have stayed below, or reached.
    pub limit: f64,
}

/// All doubts about a view.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Verdict {
    /// In the order in which they were looked for.
    pub warnings: Vec<Warning>,
}

impl Verdict {
    /// Whether no doubt is fatal.
    pub fn ok(&self) -> bool {
        !self.warnings.iter().any(|w| w.fatal)
    }

    pub(super) fn add(&mut self, code: &'static str, fatal: bool, (value, limit): (f64, f64), message: String) {
        self.warnings.push(Warning { code, fatal, message, value, limit });
    }
}

/// Parameters whose correlation exceeds this cannot be told apart well.
pub const HIGH_CORRELATION: f64 = 0.95;
/// The part of the photo that control points should enclose.
pub const SMALL_EXTENT: f64 = 0.1;
/// The position error at the border, in units of the measuring error, above which control is too concentrated.
pub const LARGE_BORDER_ERROR: f64 = 5.0;
/// Residuals, as part of the photo's diagonal, that careful pointing does not leave; five times that is fatal, and
/// with fewer than 9 points or so any excess.
pub const LARGE_RESIDUALS: f64 = 0.001;
/// The degrees of freedom below which nothing checks the view.
pub const FEW_FREEDOMS: f64 = 4.0;

/// What a verdict looks at.
pub(super) struct Evidence<'a> {
    pub view: &'a View,
    pub free: &'a FreeSet,
    /// A posteriori.
    pub covariance: &'a DMatrix<f64>,
    pub sigma0: f64,
    pub dof: f64,
    /// Pixels of the points in use, and their places in the local frame.
    pub xy: &'a [[f64; 2]],
    pub xyz: &'a [[f64; 3]],
    /// The geometric mean of the given sigmas, px.
    pub typical_sigma: f64,
    /// Whether points were rejected.
    pub selected: bool,
    /// Whether the sigmas were given.
    pub sigma_known: bool,
}

/// The area that points enclose over the photo's, by their extent in 32 directions.
pub fn extent(xy: &[[f64; 2]], width: u32, height: u32) -> f64 {
    const DIRECTIONS: usize = 32;
    // Some thousands of points show the extent as well as all of them.
    const ENOUGH: usize = 2048;
    if xy.len() < 3 {
        return 0.0;
    }
    let far = |k: usize| {
        let angle = std::f64::consts::TAU * k as f64 / DIRECTIONS as f64;
        let (s, c) = angle.sin_cos();
        let reach = |p: &[f64; 2]| c * p[0] + s * p[1];
        let some = xy.iter().step_by(xy.len().div_ceil(ENOUGH));
        some.fold((f64::NEG_INFINITY, [0.0; 2]), |best, p| if reach(p) > best.0 { (reach(p), *p) } else { best }).1
    };
    let hull: Vec<[f64; 2]> = (0..DIRECTIONS).map(far).collect();
    let o = hull[0];
    let twice: f64 = (1..DIRECTIONS - 1)
        .map(|i| (hull[i][0] - o[0]) * (hull[i + 1][1] - o[1]) - (hull[i][1] - o[1]) * (hull[i + 1][0] - o[0]))
        .sum();
    0.5 * twice / (f64::from(width) * f64::from(height))
}

/// The predicted error, px per coordinate, of projecting a point of median distance to the photo's border and middle:
/// the largest of eight places on the border, and the middle's. NaN where the lens sees none of them.
pub(super) fn predicted_errors(e: &Evidence<'_>) -> (f64, f64) {
    let camera = &e.view.camera;
    let (w, h) = (f64::from(camera.width), f64::from(camera.height));
    let mut ranges: Vec<f64> = e.xyz.iter().map(|p| e.view.pose.transform(p).norm()).collect();
    let range = super::blunders::median(&mut ranges);
    // A panorama's upper and lower borders are its poles, where x means nothing.
    let (low, high) = if camera.model() == Model::Equirectangular { (0.2, 0.8) } else { (0.01, 0.99) };
    let at = |fx: f64, fy: f64| -> f64 {
        let pixel = [fx * w - 0.5, fy * h - 0.5];
        let Some(ray) = e.view.ray(&pixel) else { return f64::NAN };
        let point = e.view.pose.centre + ray * range;
        let Some(j) = e.view.project_with_jacobian(&point.into()) else { return f64::NAN };
        let mut rows = [[0.0; MAX_FREE]; 2];
        e.free.columns(e.view, &j, &mut rows);
        let u = e.free.len();
        let variance: f64 = rows
            .iter()
            .map(|row| (0..u).map(|k| row[k] * (0..u).map(|l| e.covariance[(k, l)] * row[l]).sum::<f64>()).sum::<f64>())
            .sum();
        (0.5 * variance).max(0.0).sqrt()
    };
    let border =
        [(0.01, low), (0.5, low), (0.99, low), (0.01, 0.5), (0.99, 0.5), (0.01, high), (0.5, high), (0.99, high)];
    let largest = border.iter().map(|&(x, y)| at(x, y)).fold(f64::NAN, f64::max);
    (largest, at(0.5, 0.5))
}

/// The doubts that the fit itself raises.
pub(super) fn judge_fit(e: &Evidence<'_>, predicted: (f64, f64), verdict: &mut Verdict) {
    if e.dof < 1.0 {
        let message = "the points determine the view, but none is left to check it: add control points".into();
        verdict.add("no_redundancy", true, (e.dof, 1.0), message);
    } else if e.dof < FEW_FREEDOMS {
        let message = format!("only {:.0} redundant coordinates check the view: add control points", e.dof);
        // Where points were rejected, so few may agree by chance.
        verdict.add("few_points", e.selected, (e.dof, FEW_FREEDOMS), message);
    }
    if e.sigma_known && e.dof >= 1.0 {
        // The square root of χ²/r at 99.9 %, by Wilson and Hilferty.
        let k = 2.0 / (9.0 * e.dof);
        let limit = (1.0 - k + 3.0902 * k.sqrt()).powf(1.5);
        if e.sigma0 > limit {
            let message = format!(
                "the residuals are {:.1} times what the given sigmas promise (limit {limit:.2}): look for blunders, or for \
                 a camera that does not fit",
                e.sigma0
            );
            verdict.add("variance_factor", e.sigma0 > 3.0 * limit, (e.sigma0, limit), message);
        }
    }
    let camera = &e.view.camera;
    let diagonal = f64::from(camera.width).hypot(f64::from(camera.height));
    let residual = e.sigma0 * e.typical_sigma;
    if residual > LARGE_RESIDUALS * diagonal {
        let message = format!(
            "the residuals of {residual:.1} px are {:.2} % of the photo's diagonal: points were measured badly or paired \
             wrongly, or the camera does not fit",
            100.0 * residual / diagonal
        );
        let limit = LARGE_RESIDUALS * diagonal;
        // With few points a wrong view can leave no larger ones.
        verdict.add("large_residuals", residual > 5.0 * limit || e.dof < 12.0, (residual, limit), message);
    }
    let extent = extent(e.xy, camera.width, camera.height);
    if extent < SMALL_EXTENT {
        let message = format!(
            "the control points enclose {:.1} % of the photo (below {:.0} %): spread them to the borders",
            100.0 * extent,
            100.0 * SMALL_EXTENT
        );
        verdict.add("small_extent", false, (extent, SMALL_EXTENT), message);
    }
    let unit = e.typical_sigma * if e.dof >= 1.0 && e.sigma0 > 0.0 { e.sigma0 } else { 1.0 };
    if predicted.0 > LARGE_BORDER_ERROR * unit {
        let message = format!(
            "at the photo's border the position error is {:.3} px, {:.0} times the measuring error: add control points there",
            predicted.0,
            predicted.0 / unit
        );
        verdict.add("border_error", false, (predicted.0 / unit, LARGE_BORDER_ERROR), message);
    }
    if let Some((names, rho)) = highest_correlation(e.free, e.covariance)
        && rho.abs() > HIGH_CORRELATION
    {
        let message = format!(
            "{} and {} are correlated by {rho:.3}: the points hardly tell them apart; their own sigmas say how well",
            names.0, names.1
        );
        verdict.add("correlation", false, (rho.abs(), HIGH_CORRELATION), message);
    }
}

/// The pair of parameters with the highest correlation.
pub fn highest_correlation(free: &FreeSet, covariance: &DMatrix<f64>) -> Option<((&'static str, &'static str), f64)> {
    let names = free.names();
    let mut highest: Option<((&str, &str), f64)> = None;
    for i in 0..free.len() {
        for j in i + 1..free.len() {
            let rho = covariance[(i, j)] / (covariance[(i, i)] * covariance[(j, j)]).sqrt();
            if rho.is_finite() && highest.is_none_or(|h| rho.abs() > h.1.abs()) {
                highest = Some(((names[i], names[j]), rho));
            }
        }
    }
    highest
}

/// log10 of how many views chance would give, among `n` points thrown at random over the photo, that leave `k` of them
/// residuals within a radius: the a-contrario number, with the sample that determines `free` parameters.
pub fn log10_false_alarms(n: usize, k: usize, radius: f64, free: usize, area: f64) -> f64 {
    /// Views that a sample can have, times radii that a search tries.
    const TRIES: f64 = 4.0 * 24.0;
    let sample = free.div_ceil(2).min(k);
    let choose = |n: usize, k: usize| -> f64 {
        (0..k.min(n - k)).map(|i| ((n - i) as f64).log10() - ((i + 1) as f64).log10()).sum()
    };
    // Half coordinates of the sample that the parameters do not need are left over for checking.
    let checking = k as f64 - 0.5 * free as f64;
    if checking <= 0.0 {
        return choose(n, k);
    }
    // A fit draws its points closer than a view through the sample alone would have them.
    let drawn = k as f64 / checking;
    let chance = (std::f64::consts::PI * radius * radius * drawn / area).clamp(1e-300, 1.0);
    TRIES.log10() + choose(n, k) + choose(k, sample) + checking * chance.log10()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_extent_of_the_corners_is_the_photo_and_of_a_line_nothing() {
        let corners = [[0.0, 0.0], [999.0, 0.0], [999.0, 799.0], [0.0, 799.0]];
        assert!((extent(&corners, 1000, 800) - 0.9978).abs() < 1e-3);
        let line: Vec<[f64; 2]> = (0..10).map(|i| [50.0 + 80.0 * i as f64, 20.0 + 70.0 * i as f64]).collect();
        assert!(extent(&line, 1000, 800).abs() < 1e-9);
        assert_eq!(extent(&corners[..2], 1000, 800), 0.0);
    }

    #[test]
    fn false_alarms_tell_chance_from_a_find() {
        let area = 3e6;
        assert!(log10_false_alarms(12, 5, 60.0, 6, area) > -1.0);
        assert!(log10_false_alarms(12, 9, 3.0, 6, area) < -20.0);
        assert!(log10_false_alarms(100_000, 40_000, 5.0, 6, area) < -1000.0);
    }
}
