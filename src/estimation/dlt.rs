//! Direct Linear Transformation: a camera without any knowledge of it, from six control points or more.
//!
//! ```text
//! x = (h11 X + h12 Y + h13 Z + h14) / (h31 X + h32 Y + h33 Z + h34),  y alike
//! ```
//! Scaled to ‖(h31 h32 h33)‖ = 1 and det M > 0 the third row is the optical axis, and the denominator *is the depth*: the
//! matrix is a metric camera with a skew, `K [R | −R C]`, and as such it is refined on the image residuals, alone or with
//! distortion terms, and gets its covariance.
//!
//! Sources: Abdel-Aziz and Karara 1971; Hartley and Zisserman, Multiple View Geometry, chapter 7.

use nalgebra::{DMatrix, DVector, Matrix3, Vector3};

use super::collinearity::Collinearity;
use super::dlt_linear::{NO_GAP, Normalised, dynamic};
use super::fit::{cofactor, fit_plainly, residuals};
use super::levenberg::{Limits, Stop};
use super::loss::Loss;
use super::observations::{Observations, Precision};
use super::parameters::FreeSet;
use super::priors::Priors;
use super::resection::Status;
use super::residuals::Rms;
use super::verdict::{Evidence, Verdict, judge_fit, predicted_errors};
use crate::error::{Error, Result};
use crate::geometry::{View, skew_matrix};

/// A skew or an aspect that differs from an ordinary camera's by more than this part, and by three sigmas, is a doubt.
const ODD_CAMERA: f64 = 0.02;

/// How the matrix is found.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DltMethod {
    /// h34 = 1 in the frame of the centroid, iterated, then Levenberg–Marquardt on the image residuals.
    Eleven,
    /// The smallest singular vector of the normalised equations: the algebraic error's minimum, as it is. Distortion
    /// terms ask for the image residuals all the same.
    Twelve,
}

/// How to estimate.
#[derive(Debug, Clone)]
pub struct DltOptions {
    /// Eleven or twelve parameters.
    pub method: DltMethod,
    /// Any of k1 k2 p1 p2 k3.
    pub distortion: Vec<String>,
    /// Of the measured pixels; `None` is 1 px, and a scale that the residuals decide.
    pub precision: Option<Precision>,
    /// Points that take no part, only get their residuals.
    pub check: Vec<bool>,
    /// Width and height of the photo, pixels.
    pub size: (u32, u32),
}

/// An estimated matrix.
#[derive(Debug, Clone)]
pub struct Dlt {
    /// The same as camera (with skew and distortion) and pose.
    pub view: View,
    /// Scaled so that its third row gives the depth.
    pub matrix: [[f64; 4]; 3],
    /// h11 … h34, then the distortion terms.
    pub names: Vec<String>,
    /// Of these, a posteriori; singular in the direction of the scale.
    pub covariance: DMatrix<f64>,
    /// Names of what the matrix means: pose, fx fy cx cy, skew, distortion.
    pub part_names: Vec<&'static str>,
    /// Of these, a posteriori.
    pub part_covariance: DMatrix<f64>,
    /// √ of the variance factor.
    pub sigma0: f64,
    /// Observations less free parameters.
    pub dof: f64,
    /// Projected − measured of every point, pixels; NaN where not visible.
    pub residuals: Vec<[f64; 2]>,
    /// Of every point.
    pub status: Vec<Status>,
    /// Of the points in use.
    pub rms: Rms,
    /// Of the check points; NaN where there are none.
    pub rms_check: Rms,
    /// Steps of the refinement.
    pub iterations: usize,
    /// Why it stopped; `None` for twelve parameters, which are not refined.
    pub stop: Option<Stop>,
    /// Smallest extent of the control points over the largest.
    pub thickness: f64,
    /// Last singular value over the last but one: 0 is exact, 1 undetermined.
    pub gap: f64,
    /// The predicted error at the photo's border (the largest) and in its middle, px per coordinate.
    pub predicted_errors: (f64, f64),
    /// Every doubt.
    pub verdict: Verdict,
}

/// The matrix of the points.
pub fn estimate_dlt(xyz: &[[f64; 3]], xy: &[[f64; 2]], options: &DltOptions) -> Result<Dlt> {
    let all = Observations::new(xyz, xy, options.precision.clone())?;
    if !options.check.is_empty() && options.check.len() != xyz.len() {
        return Err(Error::invalid(format!("{} points, but {} check marks", xyz.len(), options.check.len())));
    }
    let control: Vec<usize> = (0..xyz.len()).filter(|&i| !options.check.get(i).copied().unwrap_or(false)).collect();
    let free = FreeSet::dlt(&options.distortion)?;
    let needed = free.len().div_ceil(2);
    if control.len() < needed {
        return Err(Error::invalid(format!(
            "{} control points are too few for the {} parameters of a DLT: at least {needed} are needed",
            control.len(),
            free.len()
        )));
    }
    let o = all.select(&control);
    let normalised = Normalised::new(&o.xyz, &o.xy)?;
    let linear = normalised.twelve()?;
    if linear.gap > NO_GAP {
        return Err(Error::Degenerate {
            what: "the control points hardly determine a DLT, noise would decide".into(),
            quantity: "the last singular value over the last but one",
            value: linear.gap,
            limit: NO_GAP,
            remedy: "add control points that differ in depth, or use resection with a known camera",
        });
    }
    let h = match options.method {
        DltMethod::Eleven => normalised.eleven(&linear),
        DltMethod::Twelve => linear.h,
    };
    let behind = normalised.behind(&h);
    if 2 * behind > o.len() {
        return Err(Error::invalid(format!(
            "{behind} of {} control points come to lie behind the camera: is the object frame left-handed, or does the \
             photo's y axis point up? Both must be right-handed, with y down in the photo",
            o.len()
        )));
    }
    let start = View::from_dlt(&normalised.matrix(&h), options.size.0, options.size.1, &[0.0; 5])?;
    let refine = options.method == DltMethod::Eleven || !options.distortion.is_empty();
    let (local, cofactors, iterations, stop) = if refine {
        let fitted = refined(&o, &free, &start)?;
        let none = Priors::default();
        let problem = Collinearity { free: &free, observations: &o, priors: &none, loss: Loss::Squares, scale: 1.0 };
        let cofactors = cofactor(&problem, &fitted)?;
        (fitted.state, cofactors, fitted.iterations, Some(fitted.stop))
    } else {
        let by_h = normalised
            .covariance(&h, |i| o.precision.covariance(i))
            .ok_or_else(|| Error::Internal("equal eigenvalues after their check".into()))?;
        (start, part_covariance(&free, &start, &normalised, &h, &by_h)?, 0, None)
    };
    result(&all, &control, (&free, &local), cofactors, (iterations, stop), (normalised.thickness, linear.gap), options)
}

/// Eleven parameters first, then the distortion terms with them: together from a rough start they may fold the photo.
fn refined(o: &Observations, free: &FreeSet, start: &View) -> Result<super::levenberg::Outcome<View>> {
    let failed = |what: &str| Error::NotConverged {
        what: "the DLT",
        iterations: Limits::default().iterations,
        detail: format!("{what}; check the pairing of the points for blunders"),
    };
    let plain = FreeSet::dlt::<&str>(&[])?;
    let first = fit_plainly(o, &plain, start, &Limits::default())
        .ok_or_else(|| failed("a control point lies behind the camera of the linear solution"))?;
    let outcome = if free.len() == plain.len() {
        first
    } else {
        fit_plainly(o, free, &first.state, &Limits::default())
            .ok_or_else(|| failed("a control point left the valid field of the distortion"))?
    };
    if outcome.stop.converged() {
        Ok(outcome)
    } else {
        Err(failed(&format!("the last steps still changed the residuals ({})", outcome.stop.name())))
    }
}

/// Covariance of pose and camera from that of the normalised matrix.
fn part_covariance(
    free: &FreeSet,
    view: &View,
    normalised: &Normalised,
    h: &nalgebra::SVector<f64, 12>,
    by_h: &super::dlt_linear::Matrix12,
) -> Result<DMatrix<f64>> {
    // The matrix of any scale, then of the metric scale: g = p / (± ‖p3‖).
    let matrix = normalised.matrix(h);
    let p = DVector::from_iterator(12, matrix.iter().flatten().copied());
    let length = Vector3::new(p[8], p[9], p[10]).norm();
    let scaled = view.matrix().ok_or_else(|| Error::Internal("a DLT that is no matrix".into()))?;
    let sign = if scaled.iter().flatten().zip(p.iter()).map(|(a, b)| a * b).sum::<f64>() < 0.0 { -1.0 } else { 1.0 };
    let scale = sign / length;
    let metric = DMatrix::from_fn(12, 12, |i, j| {
        let own = if i == j { scale } else { 0.0 };
        let shared = if (8..11).contains(&j) { p[i] * scale * p[j] / (length * length) } else { 0.0 };
        own - shared
    }) * dynamic(&normalised.matrix_by_h());
    let covariance = &metric * dynamic(by_h) * metric.transpose();
    // The columns differ in size by the pixels of a focal length: balanced before they are inverted.
    let j = matrix_by_parts(free, view);
    let balance = DVector::from_fn(j.ncols(), |k, _| 1.0 / j.column(k).norm());
    let balanced = &j * DMatrix::from_diagonal(&balance);
    let inverse = balanced
        .pseudo_inverse(1e-13)
        .map_err(|e| Error::Internal(format!("the matrix does not determine its camera: {e}")))?;
    let back = DMatrix::from_diagonal(&balance) * inverse.columns(0, 12);
    Ok(&back * covariance * back.transpose())
}

/// d(h11 … h34)/d(parts): the matrix is `K R [I | −C]`. Distortion terms have columns of zeros.
fn matrix_by_parts(free: &FreeSet, view: &View) -> DMatrix<f64> {
    let p = view.camera.params();
    let k = Matrix3::new(p[0], view.camera.skew(), p[2], 0.0, p[1], p[3], 0.0, 0.0, 1.0);
    let (r, c) = (view.pose.rotation, view.pose.centre);
    let names = free.names();
    let mut d = DMatrix::zeros(12, names.len());
    for (column, name) in names.iter().enumerate() {
        let mut by_k = Matrix3::zeros();
        let (mut d_m, mut d_p4) = (Matrix3::zeros(), Vector3::zeros());
        match *name {
            "rx" | "ry" | "rz" => {
                let axis = Vector3::ith(["rx", "ry", "rz"].iter().position(|n| n == name).unwrap_or(0), 1.0);
                d_m = k * skew_matrix(&axis) * r;
            }
            "cx_world" => d_p4 = -(k * r).column(0).into_owned(),
            "cy_world" => d_p4 = -(k * r).column(1).into_owned(),
            "cz_world" => d_p4 = -(k * r).column(2).into_owned(),
            "fx" => by_k[(0, 0)] = 1.0,
            "fy" => by_k[(1, 1)] = 1.0,
            "cx" => by_k[(0, 2)] = 1.0,
            "cy" => by_k[(1, 2)] = 1.0,
            "skew" => by_k[(0, 1)] = 1.0,
            _ => {}
        }
        d_m += by_k * r;
        d_p4 -= d_m * c;
        for i in 0..3 {
            for j in 0..3 {
                d[(4 * i + j, column)] = d_m[(i, j)];
            }
            d[(4 * i + 3, column)] = d_p4[i];
        }
    }
    d
}

fn result(
    all: &Observations,
    control: &[usize],
    (free, local): (&FreeSet, &View),
    cofactors: DMatrix<f64>,
    (iterations, stop): (usize, Option<Stop>),
    (thickness, gap): (f64, f64),
    options: &DltOptions,
) -> Result<Dlt> {
    let vectors = residuals(all, local);
    let mut status = vec![Status::Check; vectors.len()];
    for &i in control {
        status[i] = Status::Used;
    }
    for (s, v) in status.iter_mut().zip(&vectors) {
        if v[0].is_nan() {
            *s = Status::NotVisible;
        }
    }
    let of = |wanted: Status| vectors.iter().zip(&status).filter(move |(_, s)| **s == wanted).map(|(v, _)| v);
    let cost: f64 =
        control.iter().map(|&i| all.precision.whiten(i, vectors[i])).map(|w| w[0] * w[0] + w[1] * w[1]).sum();
    let dof = (2 * control.len() - free.len()) as f64;
    let sigma0 = if dof > 0.0 { (cost / dof).sqrt() } else { f64::NAN };
    let part_covariance = if dof > 0.0 { cofactors * (sigma0 * sigma0) } else { cofactors };

    let mut view = *local;
    view.pose.centre += all.origin;
    let by_parts = matrix_by_parts(free, &view);
    let part_names = free.names();
    let terms: Vec<usize> =
        (0..part_names.len()).filter(|&i| options.distortion.iter().any(|d| d == part_names[i])).collect();
    let mut full = DMatrix::zeros(12 + terms.len(), part_names.len());
    full.view_mut((0, 0), (12, part_names.len())).copy_from(&by_parts);
    for (row, &i) in terms.iter().enumerate() {
        full[(12 + row, i)] = 1.0;
    }
    let covariance = &full * &part_covariance * full.transpose();
    let mut names: Vec<String> = (1..=3).flat_map(|i| (1..=4).map(move |j| format!("h{i}{j}"))).collect();
    names.extend(terms.iter().map(|&i| part_names[i].to_owned()));

    let used = all.select(control);
    let evidence = Evidence {
        view: local,
        free,
        covariance: &part_covariance,
        sigma0,
        dof,
        xy: &used.xy,
        xyz: &used.xyz,
        typical_sigma: used.precision.typical_sigma(),
        sigma_known: options.precision.is_some(),
        selected: false,
    };
    let predicted = predicted_errors(&evidence);
    let mut verdict = Verdict::default();
    judge_fit(&evidence, predicted, &mut verdict);
    judge_camera(&view, free, &part_covariance, &mut verdict);
    let matrix = view.matrix().ok_or_else(|| Error::Internal("a DLT that is no matrix".into()))?;
    Ok(Dlt {
        view,
        matrix,
        names,
        covariance,
        part_names,
        rms: Rms::of(of(Status::Used)),
        rms_check: Rms::of(of(Status::Check)),
        part_covariance,
        sigma0,
        dof,
        residuals: vectors,
        status,
        iterations,
        stop,
        thickness,
        gap,
        predicted_errors: predicted,
        verdict,
    })
}

/// Skew and aspect are signs of health: a camera has none of the one and about 1 of the other.
fn judge_camera(view: &View, free: &FreeSet, covariance: &DMatrix<f64>, verdict: &mut Verdict) {
    let p = view.camera.params();
    let sigma = |name: &str| free.position(name).map_or(f64::NAN, |i| covariance[(i, i)].sqrt());
    let skew = (view.camera.skew() / p[0], sigma("skew") / p[0]);
    let aspect = (p[1] / p[0] - 1.0, sigma("fx").hypot(sigma("fy")) / p[0]);
    for (code, word, (value, sigma)) in
        [("skew", "skew over the focal length", skew), ("aspect", "aspect less one", aspect)]
    {
        if value.abs() > ODD_CAMERA && value.abs() > 3.0 * sigma {
            let message = format!(
                "the {word} is {value:.3} ± {sigma:.3}, an ordinary camera has 0: a sign of blunders or of distortion"
            );
            verdict.add(code, false, (value.abs(), ODD_CAMERA), message);
        }
    }
    let focal = sigma("fx") / p[0];
    if focal > 0.1 {
        let message = format!(
            "the focal length is known to {:.0} % only: the control points differ too little in depth",
            100.0 * focal
        );
        verdict.add("focal_length", true, (focal, 0.1), message);
    }
}
