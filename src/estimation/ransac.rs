//! Views from points of which many may be blunders: locally optimised RANSAC.
//!
//! Hypotheses come from P3P, or, where the focal length is unknown, from four points over a grid of focal lengths; each
//! new best one is refined on its inliers. Points beyond a few thousand add nothing to the search, so it runs on a random
//! part of them; what was found is refined on all. Samples follow from the seed and the number of the iteration alone.
//!
//! Sources: M. Fischler and R. Bolles 1981; O. Chum, J. Matas and J. Kittler, Locally optimized RANSAC, 2003.

use nalgebra::Vector3;

use super::fit::fit_plainly;
use super::levenberg::Limits;
use super::observations::Observations;
use super::p3p::{UpToFour, p3p};
use super::parameters::FreeSet;
use super::sampling::Random;
use super::score::{Score, Scorer};
use super::start::focal_grid;
use crate::error::{Error, Result};
use crate::geometry::{Camera, Model, Pose, View};

/// Points that take part in the search.
const SEARCHED: usize = 4096;
/// Points that a local optimisation uses at most.
const OPTIMISED: usize = 256;
/// Searches within the supporters, and the samples of each.
const FINER: usize = 3;
const FINER_ITERATIONS: usize = 500;
/// log10 of the false alarms below which a closer agreement is no chance.
const NO_CHANCE: f64 = -1.0;
/// Iterations before the first thought of stopping.
const FIRST_ITERATIONS: usize = 48;

/// How to search.
#[derive(Debug, Clone, Copy)]
pub struct RansacOptions {
    /// The radius within which a point supports a view, pixels; `None` finds it by the a-contrario score.
    pub threshold: Option<f64>,
    /// The probability with which a sample without blunders is drawn.
    pub confidence: f64,
    /// The largest number of samples.
    pub max_iterations: usize,
    /// The same seed gives the same result at any number of threads.
    pub seed: u64,
    /// Whether the camera's focal length is a mere placeholder.
    pub unknown_focal: bool,
}

impl Default for RansacOptions {
    fn default() -> Self {
        Self { threshold: None, confidence: 0.9999, max_iterations: 100_000, seed: 0, unknown_focal: false }
    }
}

impl RansacOptions {
    /// Checks the values.
    pub fn new(
        threshold: Option<f64>,
        confidence: f64,
        max_iterations: usize,
        seed: u64,
        unknown_focal: bool,
    ) -> Result<Self> {
        if !(confidence > 0.0 && confidence < 1.0) {
            return Err(Error::invalid(format!("confidence = {confidence}: it lies between 0 and 1")));
        }
        if max_iterations == 0 {
            return Err(Error::invalid("max_iterations = 0: at least one sample is needed"));
        }
        Ok(Self { threshold, confidence, max_iterations, seed, unknown_focal })
    }
}

/// What the search found.
#[derive(Debug, Clone)]
pub(super) struct Consensus {
    pub view: View,
    /// Radius, px.
    pub threshold: f64,
    /// Samples drawn.
    pub iterations: usize,
}

/// Searches for the view that most points agree with.
pub(super) fn search(o: &Observations, camera: &Camera, options: &RansacOptions) -> Result<Consensus> {
    let sample = if options.unknown_focal { 4 } else { 3 };
    if o.len() <= sample {
        return Err(Error::invalid(format!(
            "{} points leave none to judge a view by: a robust estimate needs {} or more",
            o.len(),
            sample + 1
        )));
    }
    let mut random = Random::new(options.seed);
    // In random order, so that the first points of a score are a fair part of all.
    let mut order = random.permutation(o.len());
    order.truncate(SEARCHED);
    let searched = o.select(&order);
    let area = f64::from(camera.width) * f64::from(camera.height);
    let (cameras, free) = if options.unknown_focal {
        (unknown_focal_cameras(camera), FreeSet::parse(camera.model(), &["pose", "f"])?)
    } else {
        (vec![*camera], FreeSet::pose(camera.model()))
    };
    let mut run = Search::new(&searched, cameras, free, Scorer::new(&searched, options.threshold, sample, area));
    let iterations = run.run(options);
    let Some((mut score, mut view)) = run.best else {
        return Err(Error::NotConverged {
            what: "the search for a view among blunders",
            iterations,
            detail: "no sample of points gave a view that others agree with; check the pairing of the points".into(),
        });
    };
    if options.threshold.is_none() {
        // Against the whole photo, a blunder of a few sigmas looks like support. Against the disc of the supporters
        // themselves it does not: search in it for something closer, as long as there is.
        for _ in 0..FINER {
            let Some(finer) = closer(&searched, &score, &view, options) else { break };
            (score, view) = finer;
        }
    }
    Ok(Consensus { view, threshold: score.threshold2.sqrt(), iterations })
}

/// A view that part of the supporters agree on far more closely than chance would have it among them.
fn closer(o: &Observations, found: &Score, view: &View, options: &RansacOptions) -> Option<(Score, View)> {
    let radius2 = found.threshold2;
    let sigma = o.precision.typical_sigma();
    let squares = o.squares(view);
    let inside: Vec<usize> = (0..o.len()).filter(|&i| squares[i] * sigma * sigma <= radius2).collect();
    if inside.len() < 5 {
        return None;
    }
    let supporters = o.select(&inside);
    let scorer = Scorer::new(&supporters, None, 3, std::f64::consts::PI * radius2);
    let mut run = Search::new(&supporters, vec![view.camera], FreeSet::pose(view.camera.model()), scorer);
    run.run(&RansacOptions { max_iterations: options.max_iterations.min(FINER_ITERATIONS), ..*options });
    run.best.filter(|(score, _)| score.value < NO_CHANCE && score.threshold2 <= 0.25 * radius2)
}

fn unknown_focal_cameras(camera: &Camera) -> Vec<Camera> {
    let (from, to) = if camera.model() == Model::OpenCvFisheye { (0.12, 3.0) } else { (0.2, 8.0) };
    focal_grid(camera, from, to, 16)
}

/// Samples until one is free of blunders with the given probability; half of those are taken to be spoilt by noise.
fn iterations_needed(inliers: usize, n: usize, sample: usize, confidence: f64) -> usize {
    let clean: f64 = (0..sample).map(|i| inliers.saturating_sub(i) as f64 / (n - i) as f64).product();
    if clean >= 1.0 - 1e-9 {
        return 0;
    }
    let needed = (1.0 - confidence).max(1e-12).ln() / (1.0 - 0.5 * clean).ln();
    if needed.is_finite() { needed.ceil() as usize } else { usize::MAX }
}

/// The direction of a pixel, found when it is first asked for: undoing a distortion is an iteration.
#[derive(Clone, Copy)]
enum Seen {
    Unasked,
    Nowhere,
    Towards(Vector3<f64>),
}

struct Search<'a> {
    o: &'a Observations,
    /// The camera, or those with its possible focal lengths.
    cameras: Vec<Camera>,
    /// For each camera and point.
    seen: Vec<Vec<Seen>>,
    scorer: Scorer<'a>,
    free: FreeSet,
    best: Option<(Score, View)>,
}

impl<'a> Search<'a> {
    fn new(o: &'a Observations, cameras: Vec<Camera>, free: FreeSet, scorer: Scorer<'a>) -> Self {
        Self { o, seen: vec![vec![Seen::Unasked; o.len()]; cameras.len()], cameras, scorer, free, best: None }
    }

    /// Draws samples until a better one is unlikely; how many.
    fn run(&mut self, options: &RansacOptions) -> usize {
        let n = self.o.len();
        let mut needed = options.max_iterations;
        let mut iterations = 0;
        while iterations < needed.max(FIRST_ITERATIONS).min(options.max_iterations) {
            let mut random = Random::of_task(options.seed, iterations as u64);
            iterations += 1;
            let improved = if self.sample() == 4 {
                self.try_four(random.distinct::<4>(n))
            } else {
                self.try_three(random.distinct::<3>(n))
            };
            if improved && let Some((score, _)) = &self.best {
                needed = iterations_needed(score.inliers, n, self.sample(), options.confidence);
            }
        }
        iterations
    }

    fn towards(&mut self, camera: usize, point: usize) -> Option<Vector3<f64>> {
        let seen = &mut self.seen[camera][point];
        if let Seen::Unasked = seen {
            *seen = self.cameras[camera].unproject(&self.o.xy[point]).map_or(Seen::Nowhere, Seen::Towards);
        }
        if let Seen::Towards(direction) = seen { Some(*direction) } else { None }
    }

    /// The views of a camera that see three points where they were measured.
    fn through(&mut self, camera: usize, sample: [usize; 3]) -> Option<UpToFour<Pose>> {
        let [a, b, c] = sample;
        let directions = [self.towards(camera, a)?, self.towards(camera, b)?, self.towards(camera, c)?];
        Some(p3p(&sample.map(|i| self.o.xyz[i]), &directions))
    }

    fn try_three(&mut self, sample: [usize; 3]) -> bool {
        let Some(poses) = self.through(0, sample) else { return false };
        let mut improved = false;
        for pose in poses.iter() {
            improved |= self.offer(&View::new(self.cameras[0], *pose));
        }
        improved
    }

    /// Each focal length gives poses through three points; the fourth chooses among them, and the four together fix the
    /// focal length (eight equations, seven unknowns).
    fn try_four(&mut self, sample: [usize; 4]) -> bool {
        let mut found: Vec<(f64, View)> = Vec::new();
        for k in 0..self.cameras.len() {
            let Some(poses) = self.through(k, [sample[0], sample[1], sample[2]]) else { continue };
            for pose in poses.iter() {
                let view = View::new(self.cameras[k], *pose);
                found.push((self.scorer.square(&view, sample[3]), view));
            }
        }
        found.sort_by(|a, b| a.0.total_cmp(&b.0));
        let four = self.o.select(&sample);
        let limits = Limits { iterations: 8, step: 1e-3, ..Limits::default() };
        let mut improved = false;
        for (_, view) in found.iter().take(2) {
            if let Some(fitted) = fit_plainly(&four, &self.free, view, &limits) {
                improved |= self.offer(&fitted.state);
            }
        }
        improved
    }

    /// Takes a hypothesis that beats the best, after refining it.
    fn offer(&mut self, view: &View) -> bool {
        let Some(score) = self.scorer.score(view, self.best.as_ref().map(|b| &b.0)) else { return false };
        if self.best.as_ref().is_some_and(|b| score.value >= b.0.value) || score.inliers <= self.sample() {
            return false;
        }
        self.best = Some((score, *view));
        self.optimise(score, *view);
        true
    }

    fn sample(&self) -> usize {
        if self.free.is_pose() { 3 } else { 4 }
    }

    /// Fits to the inliers, of a widened threshold first, as long as the score improves.
    fn optimise(&mut self, mut score: Score, mut view: View) {
        let limits = Limits { iterations: 6, step: 1e-3, ..Limits::default() };
        for round in 0..4 {
            let widened = score.threshold2 * [4.0, 2.0, 1.0, 1.0][round];
            let mut inliers = self.scorer.within(&view, widened, OPTIMISED);
            if inliers.len() < self.sample() + 1 {
                inliers = self.scorer.within(&view, score.threshold2, OPTIMISED);
            }
            let Some(fitted) = fit_plainly(&self.o.select(&inliers), &self.free, &view, &limits) else { return };
            view = fitted.state;
            let Some((best, _)) = &self.best else { return };
            if let Some(better) = self.scorer.score(&view, Some(best)) {
                score = better;
                self.best = Some((better, view));
            } else if round >= 2 {
                return;
            }
        }
    }
}
