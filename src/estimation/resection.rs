//! Space resection: the view of a photo from control points, by the collinearity equations.
//!
//! Pose, and what else is free, by least squares or a robust loss, with prior knowledge of any parameter; started from the
//! given view, from nothing (P3P on spread points), or, where blunders are expected, by RANSAC. The result carries its
//! covariance, its residuals, and a verdict.

use nalgebra::{DMatrix, Vector3};

use super::blunders::{Criterion, critical_f2, select};
use super::collinearity::Collinearity;
use super::fit::{cofactor, fit, residuals};
use super::levenberg::{LeastSquares, Limits, Outcome, Stop};
use super::loss::Loss;
use super::observations::{Observations, Precision};
use super::parameters::{FreeSet, POSE_NAMES};
use super::priors::{Prior, PriorTerm, Priors, resolve, set_values};
use super::ransac::{self, RansacOptions};
use super::residuals::Rms;
use super::robust::{robust_scale, sandwich};
use super::start::{self, Candidate, alike};
use super::verdict::{Evidence, Verdict, judge_fit, log10_false_alarms, predicted_errors};
use crate::error::{Error, Result};
use crate::geometry::{Pose, View};

/// A second view is as good as the first when the first is not at least this much more likely (log-likelihood ratio
/// times two; 1 in 100).
const AMBIGUOUS: f64 = 9.21;

/// log10 of the false alarms from which on a view may be chance.
const CHANCE: f64 = -3.0;

/// Where the iteration starts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Start {
    /// From nothing where the whole pose is free and the points suffice, otherwise from the given view.
    #[default]
    Auto,
    /// From the given view.
    Given,
    /// From nothing.
    Search,
}

/// How to estimate.
#[derive(Debug, Clone, Default)]
pub struct ResectionOptions {
    /// Names as in [`FreeSet::parse`]; empty is the pose.
    pub free: Vec<String>,
    /// Prior knowledge.
    pub priors: Vec<Prior>,
    /// Robust loss.
    pub loss: Loss,
    /// Of the measured pixels; `None` is 1 px, and a scale that the residuals decide.
    pub precision: Option<Precision>,
    /// Where to start.
    pub start: Start,
    /// Points that take no part, only get their residuals.
    pub check: Vec<bool>,
}

/// What an estimate made of a point.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Status {
    /// Took part.
    Used,
    /// Is a blunder.
    Rejected,
    /// Was kept out for checking.
    Check,
    /// The camera cannot see it: behind it, or beyond its valid field.
    NotVisible,
}

impl Status {
    /// Its name in files.
    pub fn name(self) -> &'static str {
        match self {
            Self::Used => "used",
            Self::Rejected => "rejected",
            Self::Check => "check",
            Self::NotVisible => "not visible",
        }
    }
}

/// An estimated view.
#[derive(Debug, Clone)]
pub struct Resection {
    /// The view.
    pub view: View,
    /// Names of the free parameters, in the order of the covariances.
    pub names: Vec<&'static str>,
    /// A posteriori: scaled by the variance factor (with a robust loss the sandwich estimate).
    pub covariance: DMatrix<f64>,
    /// A priori: with the sigmas as given.
    pub covariance_apriori: DMatrix<f64>,
    /// √ of the variance factor; NaN without redundancy.
    pub sigma0: f64,
    /// Observations and priors less free parameters.
    pub dof: f64,
    /// Projected − measured of every point, pixels; NaN where not visible.
    pub residuals: Vec<[f64; 2]>,
    /// Of every point.
    pub status: Vec<Status>,
    /// Of the points in use.
    pub rms: Rms,
    /// Of the check points; NaN where there are none.
    pub rms_check: Rms,
    /// Steps of the last fit.
    pub iterations: usize,
    /// Why it stopped.
    pub stop: Stop,
    /// The test statistic of each point over its critical value, of a robust estimate; above 1 is a blunder.
    pub test_ratios: Option<Vec<f64>>,
    /// Radius of the consensus and number of samples, of a robust estimate.
    pub search: Option<(f64, usize)>,
    /// log10 of the number of such views that chance would give.
    pub log10_false_alarms: f64,
    /// The predicted error at the photo's border (the largest) and in its middle, px per coordinate.
    pub predicted_errors: (f64, f64),
    /// Another view that explains the points nearly as well.
    pub second: Option<View>,
    /// Every doubt.
    pub verdict: Verdict,
}

/// The parts of a task that both estimates share.
struct Task {
    all: Observations,
    /// Places of the points that may take part.
    control: Vec<usize>,
    free: FreeSet,
    priors: Priors,
    /// The given view in the local frame, with held values set.
    given: View,
    options: ResectionOptions,
}

/// The view of the points, none of which is taken for a blunder.
pub fn resect(view: &View, xyz: &[[f64; 3]], xy: &[[f64; 2]], options: &ResectionOptions) -> Result<Resection> {
    let task = Task::new(view, xyz, xy, options)?;
    let o = task.all.part(&task.control);
    let candidates = task.starts(&o)?;
    let mut fits: Vec<(Outcome<View>, Vec<usize>)> =
        start::plausible(&candidates, o.len()).filter_map(|c| task.fit_visible(&o, &c.view)).take(2).collect();
    if task.options.start == Start::Given {
        // The start decides, but a view that explains the points as well must not go unseen.
        fits.truncate(1);
        if let Some((first, _)) = fits.first() {
            let rival = task.rival(&o, &first.state);
            fits.extend(rival.map(|r| (r, (0..o.len()).collect())));
        }
    } else {
        // More points first, then the smaller cost.
        fits.sort_by(|a, b| b.1.len().cmp(&a.1.len()).then(a.0.normal.cost.total_cmp(&b.0.normal.cost)));
    }
    let mut fits = fits.into_iter();
    let Some((outcome, used)) = fits.next() else { return Err(task.no_fit(&o)) };
    let second = fits.next().filter(|s| s.1.len() >= used.len()).map(|s| s.0);
    let used: Vec<usize> = used.iter().map(|&i| task.control[i]).collect();
    task.result(outcome, &used, second, None)
}

/// The view of those points that agree, and the names of those that do not.
///
/// `criterion` decides what a blunder is, at the level `significance` for all points together.
pub fn resect_robust(
    view: &View,
    xyz: &[[f64; 3]],
    xy: &[[f64; 2]],
    options: &ResectionOptions,
    search: &RansacOptions,
    (criterion, significance): (Criterion, f64),
) -> Result<Resection> {
    let task = Task::new(view, xyz, xy, options)?;
    task.check_whole_pose()?;
    let o = task.all.part(&task.control);
    let radius = match criterion {
        Criterion::Threshold(t) => Some(t),
        // A view through three noisy points misses the others by more than their own noise.
        Criterion::KnownSigma => {
            Some(1.5 * o.precision.typical_sigma() * (2.0 * critical_f2(0.01, f64::INFINITY)).sqrt())
        }
        Criterion::EstimatedSigma => None,
    };
    let search = RansacOptions { threshold: search.threshold.or(radius), ..*search };
    let found = ransac::search(&o, &task.given.camera, &search)?;
    let start = task.with_held(&found.view)?;
    let selection = select(&o, (&task.free, &task.priors), (&start, found.threshold), criterion, significance)?;
    task.check_redundancy(selection.used.len())?;
    let supporters = o.part(&selection.used);
    let outcome = task.fit(&supporters, &selection.outcome.state).ok_or_else(|| task.no_fit(&o))?;
    let used: Vec<usize> = selection.used.iter().map(|&i| task.control[i]).collect();
    let second = task.rival(&supporters, &outcome.state);
    let mut result = task.result(outcome, &used, second, Some(found.threshold))?;
    let mut ratios = vec![f64::NAN; xyz.len()];
    for (&place, ratio) in task.control.iter().zip(&selection.ratios) {
        ratios[place] = *ratio;
    }
    result.test_ratios = Some(ratios);
    result.search = Some((found.threshold, found.iterations));
    let share = used.len() as f64 / task.control.len() as f64;
    if share < 0.5 {
        let message = format!(
            "only {} of {} points agree on the view ({:.0} %): check the pairing of the points and the camera",
            used.len(),
            task.control.len(),
            100.0 * share
        );
        result.verdict.add("few_inliers", false, (share, 0.5), message);
    }
    Ok(result)
}

/// What is estimated, what is held, and what is known of it before.
struct Unknowns {
    free: FreeSet,
    terms: Vec<PriorTerm>,
    held: Vec<(String, f64)>,
    /// The view with the held values.
    given: View,
}

/// Free parameters and priors against each other, in the frame whose origin lies at `origin`.
fn unknowns(local: &View, free: &[String], priors: &[Prior], origin: &Vector3<f64>) -> Result<Unknowns> {
    let model = local.camera.model();
    let named = if free.is_empty() { FreeSet::pose(model) } else { FreeSet::parse(model, free)? };
    let mut terms = Vec::new();
    let mut held = Vec::new();
    for prior in priors {
        let resolved = resolve(prior, &named, local, origin)?;
        if prior.sigma > 0.0 {
            terms.push(resolved);
        } else {
            held.push((prior.name.clone(), resolved.value));
        }
    }
    let places: Vec<usize> = held.iter().filter_map(|(name, _)| named.position(name)).collect();
    let free = named.without(&places);
    // Terms were placed in the set before the held ones left it.
    let names = named.names();
    for term in &mut terms {
        term.place = free
            .position(names[term.place])
            .ok_or_else(|| Error::invalid(format!("`{}` has two priors, one of which holds it", names[term.place])))?;
    }
    let given = set_values(local, &held, &local.pose.rotation)?;
    Ok(Unknowns { free, terms, held, given })
}

/// Whether these parameters can be free in this view, and these priors go with them: to be asked before points are read.
pub fn check_parameters(view: &View, free: &[String], priors: &[Prior]) -> Result<()> {
    unknowns(view, free, priors, &Vector3::zeros()).map(|_| ())
}

impl Task {
    fn new(view: &View, xyz: &[[f64; 3]], xy: &[[f64; 2]], options: &ResectionOptions) -> Result<Self> {
        let all = Observations::new(xyz, xy, options.precision.clone())?;
        if !options.check.is_empty() && options.check.len() != xyz.len() {
            return Err(Error::invalid(format!("{} points, but {} check marks", xyz.len(), options.check.len())));
        }
        let control = (0..xyz.len()).filter(|&i| !options.check.get(i).copied().unwrap_or(false)).collect();
        let local = View {
            camera: view.camera,
            pose: Pose { rotation: view.pose.rotation, centre: view.pose.centre - all.origin },
        };
        let Unknowns { free, terms, held, given } = unknowns(&local, &options.free, &options.priors, &all.origin)?;
        let reference = view.pose.rotation;
        let options = ResectionOptions {
            priors: held.into_iter().map(|(name, value)| Prior { name, value, sigma: 0.0 }).collect(),
            ..options.clone()
        };
        let task = Self { all, control, free, priors: Priors { terms, reference }, given, options };
        task.check_redundancy(task.control.len())?;
        Ok(task)
    }

    fn check_redundancy(&self, points: usize) -> Result<()> {
        let equations = 2 * points + self.priors.terms.len();
        if self.free.is_empty() {
            return Err(Error::invalid("nothing is free: every parameter is held"));
        }
        if equations < self.free.len() {
            let needed = self.free.len().saturating_sub(self.priors.terms.len()).div_ceil(2);
            return Err(Error::invalid(format!(
                "{points} control points give {equations} equations for {} free parameters ({}): at least {needed} points \
                 are needed, or fewer free parameters",
                self.free.len(),
                self.free.names().join(" ")
            )));
        }
        Ok(())
    }

    /// A search among blunders gives a whole pose: what of it is neither free nor held would be taken from the same points
    /// and then counted as known.
    fn check_whole_pose(&self) -> Result<()> {
        let held = |name: &str| self.options.priors.iter().any(|p| p.name == name);
        match POSE_NAMES.iter().find(|name| self.free.position(name).is_none() && !held(name)) {
            None => Ok(()),
            Some(name) => Err(Error::invalid(format!(
                "`{name}` is neither free nor held, and the search for a view among blunders gives the whole pose: free \
                 `pose`, and hold what is known of it by priors with sigma 0"
            ))),
        }
    }

    /// A view found without regard to held values, with them.
    fn with_held(&self, view: &View) -> Result<View> {
        let held: Vec<(String, f64)> = self.options.priors.iter().map(|p| (p.name.clone(), p.value)).collect();
        set_values(view, &held, &self.priors.reference)
    }

    fn starts(&self, o: &Observations) -> Result<Vec<Candidate>> {
        let given = || vec![Candidate { view: self.given, cost: f64::NAN }];
        let pose_is_free = (0..3).all(|k| self.free.rotation_place(k).is_some());
        let centre_is_held = ["cx_world", "cy_world", "cz_world"].iter().all(|name| self.free.position(name).is_none());
        let search = match self.options.start {
            Start::Given => false,
            Start::Search => true,
            Start::Auto => pose_is_free && o.len() >= if centre_is_held { 2 } else { 4 },
        };
        if !search {
            return Ok(given());
        }
        if centre_is_held {
            let found = start::turn_about(&self.given, o);
            return Ok(found.map_or_else(given, |view| vec![Candidate { view, cost: f64::NAN }]));
        }
        let found = start::search(o, &self.given.camera, &self.free);
        let mut held = Vec::with_capacity(found.len());
        for c in found {
            held.push(Candidate { view: self.with_held(&c.view)?, cost: c.cost });
        }
        Ok(if held.is_empty() && self.options.start == Start::Auto { given() } else { held })
    }

    fn fit(&self, o: &Observations, start: &View) -> Option<Outcome<View>> {
        // What a search found is close.
        let damping = if self.options.start == Start::Given { Limits::default().damping } else { 1e-8 };
        let limits = Limits { damping, ..Limits::default() };
        let one = |loss: Loss, scale: f64, from: &View| {
            fit(o, &self.free, &self.priors, (loss, scale), from, &limits).filter(|f| f.stop.converged())
        };
        if self.options.loss == Loss::Squares {
            return one(Loss::Squares, 1.0, start);
        }
        if self.options.precision.is_some() {
            return one(self.options.loss, 1.0, start);
        }
        // The scale follows the residuals: a few alternations, then it stays.
        let mut at = *start;
        let mut scale = robust_scale(o, &at, 0);
        for _ in 0..20 {
            let outcome = one(self.options.loss, scale, &at)?;
            at = outcome.state;
            let next = robust_scale(o, &at, self.free.len());
            let settled = (next / scale - 1.0).abs() < 1e-3;
            if settled {
                return Some(outcome);
            }
            scale = next;
        }
        one(self.options.loss, scale, &at)
    }

    /// Fits the points that the start sees, then those that come into view. The places that were used.
    fn fit_visible(&self, o: &Observations, start: &View) -> Option<(Outcome<View>, Vec<usize>)> {
        let seen = |view: &View| -> Vec<usize> {
            o.squares(view).iter().enumerate().filter(|(_, s)| s.is_finite()).map(|(i, _)| i).collect()
        };
        let mut used = seen(start);
        let mut at = *start;
        for _ in 0..10 {
            if 2 * used.len() + self.priors.terms.len() < self.free.len() {
                return None;
            }
            let outcome = self.fit(&o.part(&used), &at)?;
            at = outcome.state;
            let now = seen(&at);
            if now == used {
                return Some((outcome, used));
            }
            used = now;
        }
        None
    }

    /// The best fit to the points that is another view than this one.
    fn rival(&self, o: &Observations, view: &View) -> Option<Outcome<View>> {
        let pose_is_free = POSE_NAMES.iter().all(|name| self.free.position(name).is_some());
        if !pose_is_free || o.len() < 4 {
            return None;
        }
        start::plausible(&start::search(o, &view.camera, &FreeSet::pose(self.free.model())), o.len())
            .filter(|c| !alike(&c.view.pose, &view.pose, 0.01))
            .find_map(|c| self.fit(o, &c.view))
    }

    fn no_fit(&self, o: &Observations) -> Error {
        let behind = o.xyz.iter().filter(|p| self.given.project(p).is_none()).count();
        let detail = if self.options.start == Start::Given && behind > 0 {
            format!(
                "the start sees {} of {} points, the others are behind it or beyond its valid field; start without it, or \
                 give a better one",
                o.len() - behind,
                o.len()
            )
        } else {
            format!("no view of the {} points was found; check their pairing and the camera", o.len())
        };
        Error::NotConverged { what: "the resection", iterations: Limits::default().iterations, detail }
    }

    fn result(
        &self,
        outcome: Outcome<View>,
        used: &[usize],
        second: Option<Outcome<View>>,
        radius: Option<f64>,
    ) -> Result<Resection> {
        let o = self.all.part(used);
        let local = outcome.state;
        let dof = (2 * o.len() + self.priors.terms.len()) as f64 - self.free.len() as f64;
        let scale = if self.options.loss == Loss::Squares || self.options.precision.is_some() {
            1.0
        } else {
            robust_scale(&o, &local, self.free.len())
        };
        let problem =
            Collinearity { free: &self.free, observations: &o, priors: &self.priors, loss: self.options.loss, scale };
        let q = cofactor(&problem, &outcome)?;
        let (sigma0, covariance) = if dof < 1.0 {
            (f64::NAN, q.clone())
        } else if self.options.loss == Loss::Squares {
            let variance = outcome.normal.cost / dof;
            (variance.sqrt(), &q * variance)
        } else {
            (robust_scale(&o, &local, self.free.len()), sandwich(&problem, &outcome, &q)?)
        };
        let residuals = residuals(&self.all, &local);
        let mut status = vec![Status::Rejected; self.all.len()];
        for (i, s) in status.iter_mut().enumerate() {
            if self.options.check.get(i).copied().unwrap_or(false) {
                *s = Status::Check;
            } else if residuals[i][0].is_nan() {
                *s = Status::NotVisible;
            }
        }
        used.iter().for_each(|&i| status[i] = Status::Used);
        let of = |wanted: Status| {
            Rms::of(residuals.iter().zip(&status).filter(|(v, s)| **s == wanted && v[0].is_finite()).map(|(v, _)| v))
        };
        let mut verdict = Verdict::default();
        let evidence = Evidence {
            view: &local,
            free: &self.free,
            covariance: &covariance,
            sigma0,
            dof,
            xy: &o.xy,
            xyz: &o.xyz,
            typical_sigma: o.precision.typical_sigma(),
            sigma_known: self.options.precision.is_some(),
            selected: used.len() < self.control.len(),
        };
        let predicted_errors = predicted_errors(&evidence);
        judge_fit(&evidence, predicted_errors, &mut verdict);
        let unseen = status.iter().filter(|s| **s == Status::NotVisible).count();
        if unseen > 0 {
            let message = format!(
                "{unseen} control points lie behind the camera or beyond its valid field: they are paired wrongly, or the \
                 view is wrong"
            );
            verdict.add("not_visible", radius.is_none(), (unseen as f64, 0.0), message);
        }
        let camera = &local.camera;
        let largest = used.iter().map(|&i| residuals[i][0].hypot(residuals[i][1])).fold(0.0, f64::max);
        let area = f64::from(camera.width) * f64::from(camera.height);
        let alarms = log10_false_alarms(
            self.control.len(),
            used.len(),
            radius.unwrap_or(largest).max(largest),
            self.free.len(),
            area,
        );
        if dof >= 1.0 && alarms > CHANCE {
            let message = format!(
                "{} of {} points within {largest:.1} px is what chance gives (10^{alarms:.1} such views expected): check the \
                 pairing of the points",
                used.len(),
                self.control.len()
            );
            verdict.add("chance", true, (alarms, CHANCE), message);
        }
        let second = second.filter(|s| !alike(&s.state.pose, &local.pose, 1e-3)).filter(|s| {
            let (a, b) = (outcome.normal.cost.max(problem.rounding()), s.normal.cost);
            let known = self.options.precision.is_some();
            let evidence = if known { b - a } else { dof.max(1.0) * (b / a).ln() };
            let doubtful = evidence < AMBIGUOUS;
            if doubtful {
                let ratio = (b / a).sqrt();
                let message = format!(
                    "a second view explains the points nearly as well (residuals {ratio:.2} times as large): points in one \
                     plane seen from afar leave two; add points off the plane, or tell the approximate view"
                );
                verdict.add("ambiguous", true, (evidence, AMBIGUOUS), message);
            }
            doubtful
        });
        let global = |view: &View| View {
            camera: view.camera,
            pose: Pose { rotation: view.pose.rotation, centre: view.pose.centre + self.all.origin }.orthonormalised(),
        };
        Ok(Resection {
            view: global(&local),
            names: self.free.names(),
            covariance,
            covariance_apriori: q,
            sigma0,
            dof,
            rms: of(Status::Used),
            rms_check: of(Status::Check),
            residuals,
            status,
            iterations: outcome.iterations,
            stop: outcome.stop,
            test_ratios: None,
            search: None,
            log10_false_alarms: alarms,
            predicted_errors,
            second: second.map(|s| global(&s.state)),
            verdict,
        })
    }
}
