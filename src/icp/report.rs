//! What came out, and what speaks against it.
//!
//! A closest-point iteration always ends somewhere. Whether it is the right place is judged by figures that a wrong
//! place cannot easily reach, each with its limit; every one that fails is a [`Finding`].

use std::fmt;

use nalgebra::{DMatrix, DVector, Matrix3};

use super::fit::{self, MOST, Motion, UNDETERMINED, Units, apply};
use super::matching::{Matcher, Pairs, Residuals};
use crate::error::Result;

/// The smallest over the largest eigenvalue of the information about the parameters, below which they are ambiguous.
const AMBIGUOUS: f64 = 3e-3;
/// The part of the source that matches at its place and not beside it.
const DISTINCT: f64 = 0.3;
/// Different target points over pairs.
const DIFFERENT: f64 = 0.25;
/// Pairs from which the information is formed: its relative error is below two percent.
const LARGEST: usize = 8_000;
/// Source points that the test beside the place looks at.
const SAMPLE: usize = 4000;

/// Why the iteration ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Reason {
    /// The change and the residuals are small.
    Converged,
    /// The change is small, the residuals are not.
    ResidualsLarge,
    /// It was still moving, or the threshold still falling.
    IterationLimit,
}

impl Reason {
    /// In one word.
    pub fn name(self) -> &'static str {
        match self {
            Self::Converged => "converged",
            Self::ResidualsLarge => "residuals large",
            Self::IterationLimit => "iteration limit",
        }
    }
}

/// One iteration.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Step {
    /// The largest distance of a pair.
    pub threshold: f64,
    /// How many there were.
    pub pairs: usize,
    /// Of their residuals after the fit, per coordinate; across the lines for point to line.
    pub rms: f64,
    /// The largest shift of a corner of the source by this iteration.
    pub change: f64,
}

/// What can speak against a result.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FindingKind {
    /// It did not end with a small change and small residuals.
    NotConverged,
    /// Some change of the transformation costs nothing.
    Ambiguous,
    /// Few source points have a partner.
    FewPaired,
    /// Many source points share few target points.
    ManyToOne,
    /// The sets match as well, or nearly, when the source is shifted aside.
    NotDistinct,
    /// The scale went far from where it began.
    Scale,
    /// Left and right are exchanged.
    Mirrored,
}

impl FindingKind {
    /// In one word.
    pub fn name(self) -> &'static str {
        match self {
            Self::NotConverged => "not converged",
            Self::Ambiguous => "ambiguous",
            Self::FewPaired => "few paired",
            Self::ManyToOne => "many to one",
            Self::NotDistinct => "not distinct",
            Self::Scale => "scale",
            Self::Mirrored => "mirrored",
        }
    }
}

/// Something that speaks against the result, with the figure that says so.
#[derive(Debug, Clone, PartialEq)]
pub struct Finding {
    /// What it is.
    pub kind: FindingKind,
    /// In a sentence.
    pub text: String,
    /// The figure.
    pub value: f64,
    /// What it should have reached, or not exceeded.
    pub limit: f64,
}

impl fmt::Display for Finding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.text)
    }
}

/// The transformation from source to target and everything that is known about it.
#[derive(Debug, Clone)]
pub struct Report {
    /// Homogeneous, its last element 1.
    pub transform: Matrix3<f64>,
    /// Its family.
    pub motion: Motion,
    /// Values in the order of [`Motion::names`].
    pub parameters: Vec<f64>,
    /// Of these parameters, a posteriori. Lines count across their direction alone.
    pub covariance: DMatrix<f64>,
    /// Source and target index of the pairs of the last iteration.
    pub pairs: Vec<[u32; 2]>,
    /// Target minus transformed source, of each pair.
    pub residuals: Vec<[f64; 2]>,
    /// √(Σ(vx² + vy²) / 2n)
    pub rms: f64,
    /// √(Σ(vx² + vy²) / n)
    pub rmse: f64,
    /// A posteriori standard deviation of unit weight: of a coordinate, unless covariances were given.
    pub sigma0: f64,
    /// Part of the source that matches here and not aside, see [`FindingKind::NotDistinct`].
    pub distinctness: f64,
    /// One per iteration.
    pub history: Vec<Step>,
    /// Why it ended.
    pub reason: Reason,
    /// What speaks against it; empty for a result that can be used.
    pub findings: Vec<Finding>,
    units: Units,
    /// Of the increment's parameters, in the units of the pairs.
    local: DMatrix<f64>,
}

impl Report {
    /// Whether it converged and nothing speaks against it.
    pub fn accepted(&self) -> bool {
        self.reason == Reason::Converged && self.findings.is_empty()
    }

    /// Covariance of where source points go, by the covariance of the transformation.
    pub fn covariance_at(&self, source: &[[f64; 2]]) -> Vec<[[f64; 2]; 2]> {
        let square = self.units.spread * self.units.spread;
        let one = |p: &[f64; 2]| {
            let j = fit::derivatives(&self.units.local(&apply(&self.transform, p)));
            let n = self.local.nrows();
            let form = |a: &[f64; MOST], b: &[f64; MOST]| {
                let terms = (0..n).flat_map(|i| (0..n).map(move |k| (i, k)));
                terms.map(|(i, k)| a[i] * self.local[(i, k)] * b[k]).sum::<f64>() * square
            };
            let xy = form(&j[0], &j[1]);
            [[form(&j[0], &j[0]), xy], [xy, form(&j[1], &j[1])]]
        };
        source.iter().map(one).collect()
    }
}

/// Judges the transformation that the iteration ended with.
pub(super) fn assess(
    matcher: &Matcher,
    transform: &Matrix3<f64>,
    pairs: &Pairs,
    residuals: Residuals,
    history: Vec<Step>,
    reason: Reason,
) -> Result<Report> {
    let motion = matcher.options.motion;
    let n = pairs.len() as f64;

    // Information is a sum over pairs: a part of very many tells it well enough.
    let stride = pairs.len().div_ceil(LARGEST);
    let which: Vec<usize> = (0..pairs.len()).step_by(stride).collect();
    let factor = n / which.len() as f64;
    let here: Vec<[f64; 2]> =
        which.iter().map(|&k| apply(transform, &matcher.source.points[pairs.source[k] as usize])).collect();
    let units = Units::of(&here)?;
    let (weights, observations) = matcher.information_weights(pairs, &which);
    let rows: Vec<_> = here.iter().zip(&weights).map(|(p, w)| (units.local(p), *w)).collect();
    let information = fit::information(&rows, motion.parameters()) * factor;
    let form = |v: &[f64; 2], w: &[f64; 3]| w[0] * v[0] * v[0] + 2.0 * w[1] * v[0] * v[1] + w[2] * v[1] * v[1];
    let misfit: f64 = which.iter().zip(&weights).map(|(&k, w)| form(&residuals.vectors[k], w)).sum();
    let dof = observations * factor - motion.parameters() as f64;
    let variance = if dof > 0.0 { misfit * factor / dof } else { f64::NAN };

    let eigen = information.symmetric_eigen();
    let strongest = eigen.eigenvalues.amax();
    let inverse = eigen.eigenvalues.map(|v| 1.0 / v.max(UNDETERMINED * strongest));
    let local = &eigen.eigenvectors
        * DMatrix::from_diagonal(&inverse)
        * eigen.eigenvectors.transpose()
        * (variance / (units.spread * units.spread));
    let weakest = eigen.eigenvalues.imin();
    let strength = eigen.eigenvalues[weakest] / strongest;

    let beside = Beside::of(matcher, transform, 3.0 * residuals.robust_sigma());
    let jacobian = reported_by_increment(transform, motion, &units);
    let mut report = Report {
        transform: *transform,
        motion,
        parameters: parameters(transform, motion),
        covariance: &jacobian * &local * jacobian.transpose(),
        pairs: pairs.source.iter().zip(&pairs.target).map(|(&i, &j)| [i, j]).collect(),
        rms: (residuals.squares / (2.0 * n)).sqrt(),
        rmse: (residuals.squares / n).sqrt(),
        sigma0: variance.sqrt(),
        distinctness: beside.distinctness(),
        residuals: residuals.vectors,
        history,
        reason,
        findings: Vec::new(),
        units,
        local,
    };
    let mut findings = Findings { report: &report, matcher, beside, found: Vec::new() };
    findings.convergence(residuals.rms);
    findings.ambiguity(strength, &eigen.eigenvectors.column(weakest).into_owned());
    findings.pairing();
    findings.shape();
    report.findings = findings.found;
    for [i, j] in &mut report.pairs {
        (*i, *j) = (matcher.source.id[*i as usize], matcher.target.id[*j as usize]);
    }
    Ok(report)
}

struct Findings<'a> {
    report: &'a Report,
    matcher: &'a Matcher<'a>,
    beside: Beside,
    found: Vec<Finding>,
}

impl Findings<'_> {
    fn add(&mut self, kind: FindingKind, value: f64, limit: f64, text: String) {
        self.found.push(Finding { kind, text, value, limit });
    }

    fn convergence(&mut self, rms: f64) {
        let options = self.matcher.options;
        match self.report.reason {
            Reason::Converged => {}
            Reason::ResidualsLarge => {
                let limit = options.residual_limit;
                let text =
                    format!("it stands still with residuals of {} (root mean square), above {}", px(rms), px(limit));
                self.add(FindingKind::NotConverged, rms, limit, text);
            }
            Reason::IterationLimit => {
                let (n, limit) = (self.report.history.len(), options.change_tolerance);
                let (change, threshold) =
                    self.report.history.last().map_or((f64::NAN, f64::NAN), |s| (s.change, s.threshold));
                let text = if change <= limit {
                    format!("after {n} iterations its threshold, {}, had not yet reached its end", px(threshold))
                } else {
                    format!("after {n} iterations it still moved by {}, more than {}", px(change), px(limit))
                };
                self.add(FindingKind::NotConverged, change, limit, text);
            }
        }
    }

    fn ambiguity(&mut self, strength: f64, direction: &DVector<f64>) {
        if strength >= AMBIGUOUS {
            return;
        }
        let what = name_of_change(direction, &self.report.units);
        let text = format!(
            "the pairs hardly determine {what}: their information on it is {strength:.1e} of that on the best \
             determined change"
        );
        self.add(FindingKind::Ambiguous, strength, AMBIGUOUS, text);
    }

    fn pairing(&mut self) {
        let options = self.matcher.options;
        let (paired, all) = (self.report.pairs.len() as f64, self.matcher.source.points.len() as f64);
        let (share, limit) = (paired / all, options.min_share * options.keep);
        if share < limit {
            let text =
                format!("only {paired} of {all} source points have a partner, {:.0} % are asked for", 100.0 * limit);
            self.add(FindingKind::FewPaired, share, limit, text);
        }
        let different = self.different_targets() as f64;
        // As many target points as there would be in the source's place if its scale had stayed.
        let room = self.targets_in_reach() as f64 / self.scale_change().powi(2).min(1.0);
        let part = different / paired.min(room).max(1.0);
        if part < DIFFERENT {
            let text = format!("{paired} pairs share {different} target points: the source has collapsed onto them");
            self.add(FindingKind::ManyToOne, part, DIFFERENT, text);
        }
        let (distinctness, limit) = (self.report.distinctness, DISTINCT * options.keep);
        if distinctness < limit || distinctness.is_nan() {
            let Beside { here, aside, shift } = self.beside;
            let how = if aside >= here { "at least as well" } else { "nearly as well" };
            let text = format!(
                "the sets match {how} when the source is shifted aside: {:.0} % of it have a partner here, {:.0} % when it \
                 is shifted by {}",
                100.0 * here,
                100.0 * aside,
                px(shift)
            );
            self.add(FindingKind::NotDistinct, distinctness, limit, text);
        }
    }

    fn shape(&mut self) {
        let change = self.scale_change();
        if change.is_nan() {
            let text = "the transformation exchanges left and right".into();
            self.add(FindingKind::Mirrored, -1.0, 0.0, text);
            return;
        }
        let (factor, limit) = (change.max(1.0 / change), self.matcher.options.scale_limit);
        if factor > limit {
            let text = format!("the scale became {change:.3} of the initial one, more than a factor of {limit} away");
            self.add(FindingKind::Scale, change, limit, text);
        }
    }

    /// Linear scale at the pairs' centroid, of the initial one; NaN for a mirrored one.
    fn scale_change(&self) -> f64 {
        let area = |h: &Matrix3<f64>, p: &[f64; 2]| {
            let w = h[(2, 0)] * p[0] + h[(2, 1)] * p[1] + h[(2, 2)];
            h.determinant() / (w * w * w)
        };
        let sources = self.report.pairs.iter().map(|pair| self.matcher.source.points[pair[0] as usize]);
        let n = self.report.pairs.len() as f64;
        let centre = sources.fold([0.0; 2], |s, p| [s[0] + p[0] / n, s[1] + p[1] / n]);
        (area(&self.report.transform, &centre) / area(&self.matcher.options.initial, &centre)).sqrt()
    }

    fn different_targets(&self) -> usize {
        let mut used = vec![false; self.matcher.target.points.len()];
        self.report.pairs.iter().filter(|pair| !std::mem::replace(&mut used[pair[1] as usize], true)).count()
    }

    /// Target points in the bounding box of the moved source.
    fn targets_in_reach(&self) -> usize {
        let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        for p in &self.matcher.source.points {
            let q = apply(&self.report.transform, p);
            for d in 0..2 {
                low[d] = low[d].min(q[d]);
                high[d] = high[d].max(q[d]);
            }
        }
        let inside = |p: &&[f64; 2]| (0..2).all(|d| p[d] >= low[d] && p[d] <= high[d]);
        self.matcher.target.points.iter().filter(inside).count()
    }
}

/// How well the source matches at its place and beside it.
#[derive(Debug, Clone, Copy)]
struct Beside {
    /// Part of the source that has a partner within reach here, and at most when shifted aside.
    here: f64,
    aside: f64,
    /// How far aside.
    shift: f64,
}

impl Beside {
    fn of(matcher: &Matcher, transform: &Matrix3<f64>, reach: f64) -> Self {
        let source = &matcher.source.points;
        let stride = source.len().div_ceil(SAMPLE);
        let here: Vec<[f64; 2]> = source.iter().step_by(stride).map(|p| apply(transform, p)).collect();
        let size = here.iter().flatten().fold(0.0, |m: f64, v| m.max(v.abs()));
        let reach = reach.max(1e-9 * size);
        let shift = 4.0 * reach;
        let matched = |by: [f64; 2]| {
            let moved: Vec<[f64; 2]> = here.iter().map(|p| [p[0] + by[0], p[1] + by[1]]).collect();
            let found = matcher.index.nearest_in_order(&moved, reach);
            found.iter().filter(|n| n.found().is_some()).count() as f64 / here.len() as f64
        };
        let aside = (0..8).map(|k| f64::from(k) * std::f64::consts::FRAC_PI_4).map(|a| {
            let (s, c) = a.sin_cos();
            matched([shift * c, shift * s])
        });
        Self { aside: aside.fold(0.0, f64::max), here: matched([0.0; 2]), shift }
    }

    /// How much better it matches here than aside, of how much better it could: 1 when every point has a partner here
    /// and none aside, 0 when the place makes no difference, negative when it matches better aside.
    fn distinctness(&self) -> f64 {
        (self.here - self.aside) / (1.0 - self.aside)
    }
}

/// A length for people: three decimals, or, where these would be zero, two digits and their power of ten.
fn px(length: f64) -> String {
    if length == 0.0 || length.abs() >= 5e-4 { format!("{length:.3} px") } else { format!("{length:.1e} px") }
}

/// The change of the transformation that an eigenvector stands for, in words.
fn name_of_change(direction: &DVector<f64>, units: &Units) -> String {
    let part = |i: usize| direction.get(i).map_or(0.0, |v| v * v);
    let at = |i: usize| direction.get(i).copied().unwrap_or(0.0);
    let (shift, turn, scale) = (part(0) + part(1), part(2), part(3));
    let place = |x: f64, y: f64| {
        let [cx, cy] = units.centre;
        format!("({:.1}, {:.1})", cx + units.spread * x, cy + units.spread * y)
    };
    if shift > 0.8 {
        // A line has no sense of direction: the larger component counts as positive.
        let larger = if at(0).abs() >= at(1).abs() { at(0) } else { at(1) };
        let length = shift.sqrt().copysign(larger);
        format!("a slide along the direction ({:.3}, {:.3})", at(0) / length, at(1) / length)
    } else if shift + turn > 0.8 {
        format!("a turn about {}", place(-at(1) / at(2), at(0) / at(2)))
    } else if shift + scale > 0.8 {
        format!("the scale about {}", place(-at(0) / at(3), -at(1) / at(3)))
    } else if part(6) + part(7) > 0.5 {
        "the perspective".into()
    } else {
        "a combination of shift, turn, scale and shear".into()
    }
}

fn parameters(h: &Matrix3<f64>, motion: Motion) -> Vec<f64> {
    let (scale, angle) = (h[(0, 0)].hypot(h[(1, 0)]), h[(1, 0)].atan2(h[(0, 0)]));
    let (tx, ty) = (h[(0, 2)], h[(1, 2)]);
    match motion {
        Motion::Translation => vec![tx, ty],
        Motion::Rigid => vec![angle, tx, ty],
        Motion::Similarity => vec![scale, angle, tx, ty],
        Motion::Affine => vec![h[(0, 0)], h[(0, 1)], tx, h[(1, 0)], h[(1, 1)], ty],
        Motion::Projective => vec![h[(0, 0)], h[(0, 1)], tx, h[(1, 0)], h[(1, 1)], ty, h[(2, 0)], h[(2, 1)]],
    }
}

/// Derivatives of the reported parameters by those of the increment.
fn reported_by_increment(h: &Matrix3<f64>, motion: Motion, units: &Units) -> DMatrix<f64> {
    let generators = [
        Matrix3::new(0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        Matrix3::new(0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0),
        Matrix3::new(0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        Matrix3::new(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0),
        Matrix3::new(1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0),
        Matrix3::new(0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        Matrix3::new(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0),
        Matrix3::new(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0),
    ];
    let n = motion.parameters();
    let mut jacobian = DMatrix::zeros(n, n);
    for (k, generator) in generators.iter().take(n).enumerate() {
        let d = units.global(generator) * h;
        // The last element stays 1.
        let d = d - h * d[(2, 2)];
        let square = h[(0, 0)] * h[(0, 0)] + h[(1, 0)] * h[(1, 0)];
        let scale = (h[(0, 0)] * d[(0, 0)] + h[(1, 0)] * d[(1, 0)]) / square.sqrt();
        let angle = (h[(0, 0)] * d[(1, 0)] - h[(1, 0)] * d[(0, 0)]) / square;
        let column = match motion {
            Motion::Translation => vec![d[(0, 2)], d[(1, 2)]],
            Motion::Rigid => vec![angle, d[(0, 2)], d[(1, 2)]],
            Motion::Similarity => vec![scale, angle, d[(0, 2)], d[(1, 2)]],
            _ => parameters(&d, motion),
        };
        jacobian.set_column(k, &DVector::from_vec(column));
    }
    jacobian
}
