//! Pairs of closest points, and which of them count.

use std::cell::{OnceCell, RefCell};

use nalgebra::Matrix3;
use rayon::prelude::*;
use statrs::distribution::{ChiSquared, ContinuousCDF};

use super::fit::{apply, chunked};
use super::schedule::Schedule;
use super::sorted::{self, Sorted};
use super::{Metric, Options, Sets};
use crate::error::{Error, Result};
use crate::neighbours::{NONE, Neighbour, Neighbours};

/// Among so many nearest points the one with the smallest Mahalanobis distance is looked for.
const CANDIDATES: usize = 4;

/// Points per task when pairs are gathered.
const PIECE: usize = 4096;

/// Variance across over variance along a neighbourhood: below the first it is a line, above the second it is none.
const LINE: [f64; 2] = [0.05, 0.25];

/// The direction of a point's neighbourhood.
#[derive(Debug, Clone, Copy)]
struct Shape {
    normal: [f64; 2],
    /// How much the place along the line counts: 0 in a line, 1 where there is none.
    along: f64,
}

impl Shape {
    /// `n nᵀ + along · t tᵀ` as xx, xy, yy.
    fn weight(&self) -> [f64; 3] {
        let [nx, ny] = self.normal;
        let a = self.along;
        [nx * nx + a * ny * ny, (1.0 - a) * nx * ny, ny * ny + a * nx * nx]
    }

    /// A weight with what it says along the line scaled down.
    fn restricted(&self, w: &[f64; 3]) -> [f64; 3] {
        let [nx, ny] = self.normal;
        let [tx, ty] = [-ny, nx];
        let form = |ax: f64, ay: f64, bx: f64, by: f64| ax * (w[0] * bx + w[1] * by) + ay * (w[1] * bx + w[2] * by);
        let nn = form(nx, ny, nx, ny);
        let nt = self.along.sqrt() * form(nx, ny, tx, ty);
        let tt = self.along * form(tx, ty, tx, ty);
        [
            nn * nx * nx + 2.0 * nt * nx * tx + tt * tx * tx,
            nn * nx * ny + nt * (nx * ty + tx * ny) + tt * tx * ty,
            nn * ny * ny + 2.0 * nt * ny * ty + tt * ty * ty,
        ]
    }
}

/// Everything that stays the same through the iterations.
pub(super) struct Matcher<'a> {
    pub source: Sorted,
    pub target: Sorted,
    pub options: &'a Options,
    /// Of the target.
    pub index: Neighbours<2>,
    /// Of the target's points; only where lines are what is minimised.
    shapes: Option<Vec<Shape>>,
    /// χ² of the gate.
    gate2: f64,
    corners: [[f64; 2]; 4],
}

/// The pairs of one iteration, side by side. Kept from iteration to iteration: fresh memory costs more than the search.
#[derive(Default)]
pub(super) struct Pairs {
    pub source: Vec<u32>,
    pub target: Vec<u32>,
    /// The source points as they lie at present.
    pub moved: Vec<[f64; 2]>,
    /// The target points.
    pub goals: Vec<[f64; 2]>,
    /// xx, xy, yy; empty where all pairs weigh the same.
    weights: Vec<[f64; 3]>,
    /// Of the whole source, in the order of work.
    all: Vec<[f64; 2]>,
    found: Vec<Neighbour>,
    held: Vec<Held>,
}

/// What the last search for a source point's partner found, and how far the point may move until it has to be repeated.
#[derive(Clone, Copy)]
struct Held {
    /// Where the point was.
    place: [f64; 2],
    /// Its nearest target point, whether or not it was within the threshold, or [`NONE`] where it is not known.
    index: u32,
    /// No other target point was nearer to it.
    rest: f64,
}

impl Held {
    const NOTHING: Self = Self { place: [0.0; 2], index: NONE, rest: 0.0 };

    /// The partner within `limit2` of the point at its present place.
    #[inline(always)]
    fn partner(&mut self, p: &[f64; 2], targets: &[[f64; 2]], index: &Neighbours<2>, limit2: f64) -> Neighbour {
        let moved = ((p[0] - self.place[0]).powi(2) + (p[1] - self.place[1]).powi(2)).sqrt();
        // What rounding does to lengths is far less than this.
        let rest = self.rest * (1.0 - 1e-9) - moved;
        let mut known = Neighbour { index: NONE, distance2: limit2 };
        if let Some(y) = targets.get(self.index as usize) {
            let distance2 = (p[0] - y[0]).powi(2) + (p[1] - y[1]).powi(2);
            let near = distance2 <= limit2;
            if rest > 0.0 && distance2 < rest * rest {
                return if near { Neighbour { index: self.index, distance2 } } else { Neighbour::NONE };
            }
            if near {
                known = Neighbour { index: self.index, distance2 };
            }
        } else if rest > 0.0 && limit2 < rest * rest {
            return Neighbour::NONE;
        }
        let (found, rest2) = index.nearest_and_rest(p, known);
        *self = Self { place: *p, index: found.index, rest: rest2.sqrt() };
        found
    }
}

impl Pairs {
    pub fn len(&self) -> usize {
        self.source.len()
    }

    /// Makes pairs of the points that found a partner, in their order.
    fn gather(&mut self, targets: &[[f64; 2]]) {
        let Self { source, target, moved, goals, all, found, .. } = self;
        let paired = |piece: &[Neighbour]| piece.iter().filter(|n| n.found().is_some()).count();
        let counts: Vec<usize> = found.par_chunks(PIECE).map(paired).collect();
        let total = counts.iter().sum();
        source.resize(total, 0);
        target.resize(total, 0);
        moved.resize(total, [0.0; 2]);
        goals.resize(total, [0.0; 2]);
        let indices = cut(source, &counts).into_par_iter().zip(cut(target, &counts));
        let places = cut(moved, &counts).into_par_iter().zip(cut(goals, &counts));
        let pieces = all.par_chunks(PIECE).zip(found.par_chunks(PIECE)).enumerate();
        pieces.zip(indices.zip(places)).for_each(|((piece, (all, found)), ((source, target), (moved, goals)))| {
            let mine = all.iter().zip(found).enumerate().filter_map(|(i, (p, n))| Some((i, p, n.found()?)));
            for (k, (i, p, j)) in mine.enumerate() {
                source[k] = (piece * PIECE + i) as u32;
                target[k] = j as u32;
                moved[k] = *p;
                goals[k] = targets[j];
            }
        });
    }

    /// xx, xy, yy of each pair; empty where all weigh the same.
    pub fn weights(&self) -> &[[f64; 3]] {
        &self.weights
    }

    /// The weight of a pair.
    #[inline(always)]
    pub fn weight(&self, k: usize) -> [f64; 3] {
        self.weights.get(k).copied().unwrap_or([1.0, 0.0, 1.0])
    }
}

/// What the pairs leave. Kept from iteration to iteration, as they are.
#[derive(Default)]
pub(super) struct Residuals {
    /// Target minus transformed source.
    pub vectors: Vec<[f64; 2]>,
    /// The sum of their squared lengths.
    pub squares: f64,
    /// Per coordinate; across the lines where these are what is minimised.
    pub rms: f64,
    /// The largest length.
    pub largest: f64,
    lengths2: RefCell<Vec<f64>>,
    robust_sigma: OnceCell<f64>,
}

impl Residuals {
    /// Those of pairs under a transformation.
    pub fn take(&mut self, pairs: &Pairs, transform: &Matrix3<f64>, matcher: &Matcher) {
        let source = &matcher.source.points;
        let vector = |(&i, y): (&u32, &[f64; 2])| {
            let p = apply(transform, &source[i as usize]);
            [y[0] - p[0], y[1] - p[1]]
        };
        let vectors = &mut self.vectors;
        pairs.source.par_iter().zip(&pairs.goals).with_min_len(4096).map(vector).collect_into_vec(vectors);
        let square = |v: &[f64; 2]| v[0] * v[0] + v[1] * v[1];
        let lengths2 = self.lengths2.get_mut();
        vectors.par_iter().with_min_len(4096).map(square).collect_into_vec(lengths2);
        let join = |a: (f64, f64), b: (f64, f64)| (a.0 + b.0, a.1.max(b.1));
        let (sum, largest2) = chunked(lengths2, (0.0, 0.0), |t, &l2| join(t, (l2, l2)), join);
        let n = vectors.len() as f64;
        self.rms = match &matcher.shapes {
            None => (sum / (2.0 * n)).sqrt(),
            Some(shapes) => {
                let across = |(v, &j): (&[f64; 2], &u32)| {
                    let normal = shapes[j as usize].normal;
                    (normal[0] * v[0] + normal[1] * v[1]).powi(2)
                };
                (vectors.iter().zip(&pairs.target).map(across).sum::<f64>() / n).sqrt()
            }
        };
        self.squares = sum;
        self.largest = largest2.sqrt();
        self.robust_sigma = OnceCell::new();
    }

    /// Per coordinate, from the median length. Found when it is asked for: a fixed threshold needs it once.
    pub fn robust_sigma(&self) -> f64 {
        *self.robust_sigma.get_or_init(|| {
            let mut lengths2 = self.lengths2.borrow_mut();
            let middle = lengths2.len() / 2;
            let (_, median2, _) = lengths2.select_nth_unstable_by(middle, f64::total_cmp);
            // The median length of normally distributed vectors is 1.1774 σ.
            median2.sqrt() / 1.1774
        })
    }
}

impl<'a> Matcher<'a> {
    pub fn new(sets: &Sets, options: &'a Options) -> Result<Self> {
        let (source, target, index) = sorted::sort(sets, &options.initial)?;
        let gate = ChiSquared::new(2.0).map_err(|e| Error::Internal(format!("χ² distribution: {e}")))?;
        let mut this = Self {
            corners: corners(&source.points),
            source,
            target,
            options,
            index,
            shapes: None,
            gate2: gate.inverse_cdf(options.gate_probability),
        };
        if options.metric == Metric::PointToLine {
            let all: Vec<u32> = (0..this.target.points.len() as u32).collect();
            this.shapes = Some(this.shapes_of(&all));
        }
        Ok(this)
    }

    /// The largest coordinate and the diagonal of the target, whichever is larger: what rounding is measured by.
    pub fn extent(&self) -> f64 {
        let [low, _, high, _] = corners(&self.target.points);
        let coordinate = low.iter().chain(&high).fold(0.0, |m: f64, v| m.max(v.abs()));
        coordinate.max((high[0] - low[0]).hypot(high[1] - low[1]))
    }

    /// The distance that the largest of the covariances allows a pair.
    pub fn reach(&self) -> f64 {
        let largest =
            |all: &Option<Vec<[[f64; 2]; 2]>>| all.iter().flatten().map(|c| c[0][0] + c[1][1]).fold(0.0, f64::max);
        (self.gate2 * (largest(&self.source.covariance) + largest(&self.target.covariance))).sqrt()
    }

    /// Distances of the first pairs, unlimited.
    pub fn first_distances(&self, transform: &Matrix3<f64>) -> Vec<f64> {
        let mut moved = Vec::new();
        self.moved(transform, &mut moved);
        self.index.nearest_in_order(&moved, f64::INFINITY).iter().map(|n| n.distance2.sqrt()).collect()
    }

    /// The largest shift of the corners of the source's bounding box between two transformations.
    pub fn largest_shift(&self, a: &Matrix3<f64>, b: &Matrix3<f64>) -> f64 {
        let shift = |p: &[f64; 2]| {
            let (p, q) = (apply(a, p), apply(b, p));
            (p[0] - q[0]).hypot(p[1] - q[1])
        };
        self.corners.iter().map(shift).fold(0.0, f64::max)
    }

    /// The transformed source, in the order of work.
    fn moved(&self, transform: &Matrix3<f64>, out: &mut Vec<[f64; 2]>) {
        let one = |p: &[f64; 2]| apply(transform, p);
        self.source.points.par_iter().with_min_len(4096).map(one).collect_into_vec(out);
    }

    /// Makes `pairs` those that count under a transformation and the present threshold.
    pub fn find(&self, pairs: &mut Pairs, transform: &Matrix3<f64>, schedule: &Schedule) -> Result<()> {
        let Pairs { all, found, held, .. } = pairs;
        if self.has_covariances() {
            self.moved(transform, all);
            self.likeliest(transform, all, schedule, found);
        } else {
            let n = self.source.points.len();
            all.resize(n, [0.0; 2]);
            found.resize(n, Neighbour::NONE);
            held.resize(n, Held::NOTHING);
            let limit2 = schedule.threshold * schedule.threshold;
            let points = self.source.points.par_iter().zip(all.par_iter_mut());
            let partners = found.par_iter_mut().zip(held.par_iter_mut());
            points.zip(partners).with_min_len(1024).for_each(|((source, p), (n, held))| {
                *p = apply(transform, source);
                *n = held.partner(p, &self.target.points, &self.index, limit2);
            });
        }
        if self.options.mutual {
            self.keep_mutual(all, found)?;
        }
        if self.options.keep < 1.0 {
            trim(found, self.options.keep);
        }
        pairs.gather(&self.target.points);
        if self.shapes.is_some() || self.has_covariances() {
            pairs.weights = self.weights(transform, pairs, schedule.slack);
        }
        Ok(())
    }

    fn has_covariances(&self) -> bool {
        self.source.covariance.is_some() || self.target.covariance.is_some()
    }

    /// Of the difference of a pair, widened by what the transformation may be off: xx, xy, yy.
    fn covariance(&self, transform: &Matrix3<f64>, i: usize, j: usize, slack: f64) -> [f64; 3] {
        let mut c = self.target.covariance.as_ref().map_or([0.0; 3], |t| [t[j][0][0], t[j][0][1], t[j][1][1]]);
        if let Some(s) = &self.source.covariance {
            let [a, b] = linear_part(transform, &self.source.points[i]);
            let form = |u: &[f64; 2], v: &[f64; 2]| {
                u[0] * (s[i][0][0] * v[0] + s[i][0][1] * v[1]) + u[1] * (s[i][1][0] * v[0] + s[i][1][1] * v[1])
            };
            c = [c[0] + form(&a, &a), c[1] + form(&a, &b), c[2] + form(&b, &b)];
        }
        [c[0] + slack * slack, c[1], c[2] + slack * slack]
    }

    /// The candidates with the smallest Mahalanobis distance that pass the gate.
    fn likeliest(&self, transform: &Matrix3<f64>, moved: &[[f64; 2]], schedule: &Schedule, out: &mut Vec<Neighbour>) {
        let one = |(i, p): (usize, &[f64; 2])| {
            let mut candidates = [Neighbour::NONE; CANDIDATES];
            self.index.k_nearest_one(p, schedule.threshold, &mut candidates);
            let mut best = (self.gate2, Neighbour::NONE);
            for n in candidates {
                let Some(j) = n.found() else { break };
                let y = self.target.points[j];
                let c = self.covariance(transform, i, j, schedule.slack);
                let m2 = mahalanobis2(&[y[0] - p[0], y[1] - p[1]], &c);
                if m2 < best.0 {
                    best = (m2, n);
                }
            }
            best.1
        };
        moved.par_iter().enumerate().with_min_len(256).map(one).collect_into_vec(out);
    }

    /// Drops pairs whose target point has a closer source point.
    fn keep_mutual(&self, moved: &[[f64; 2]], found: &mut [Neighbour]) -> Result<()> {
        let back = Neighbours::new(moved)?;
        found.par_iter_mut().with_min_len(256).for_each(|n| {
            if let Some(j) = n.found()
                && back.nearest_one(&self.target.points[j], f64::INFINITY).distance2 < n.distance2
            {
                *n = Neighbour::NONE;
            }
        });
        Ok(())
    }

    fn weights(&self, transform: &Matrix3<f64>, pairs: &Pairs, slack: f64) -> Vec<[f64; 3]> {
        let one = |k: usize| {
            let (i, j) = (pairs.source[k] as usize, pairs.target[k] as usize);
            let covariance = self.has_covariances().then(|| self.covariance(transform, i, j, slack));
            match (&self.shapes, covariance) {
                (None, None) => [1.0, 0.0, 1.0],
                (None, Some(c)) => inverse(&c),
                (Some(shapes), None) => shapes[j].weight(),
                (Some(shapes), Some(c)) => {
                    // The weight of each direction is one over the variance in it.
                    let Shape { normal: [nx, ny], along } = shapes[j];
                    let variance = |x: f64, y: f64| c[0] * x * x + 2.0 * c[1] * x * y + c[2] * y * y;
                    let (wn, wt) = (1.0 / variance(nx, ny), along / variance(-ny, nx));
                    [wn * nx * nx + wt * ny * ny, (wn - wt) * nx * ny, wn * ny * ny + wt * nx * nx]
                }
            }
        };
        (0..pairs.len()).into_par_iter().with_min_len(256).map(one).collect()
    }

    /// What each of some pairs' place really says, and how many observations that makes: nothing along the line in which
    /// the target point lies, because the closest point slides along with the source.
    pub fn information_weights(&self, pairs: &Pairs, which: &[usize]) -> (Vec<[f64; 3]>, f64) {
        let targets: Vec<u32> = which.iter().map(|&k| pairs.target[k]).collect();
        let shapes = match &self.shapes {
            Some(shapes) => targets.iter().map(|&j| shapes[j as usize]).collect(),
            None => self.shapes_of(&targets),
        };
        let observations = shapes.iter().map(|s| 1.0 + s.along).sum();
        let weights = match self.options.metric {
            Metric::PointToLine => which.iter().map(|&k| pairs.weight(k)).collect(),
            Metric::PointToPoint => which.iter().zip(&shapes).map(|(&k, s)| s.restricted(&pairs.weight(k))).collect(),
        };
        (weights, observations)
    }

    /// The direction of the neighbourhoods of target points.
    fn shapes_of(&self, which: &[u32]) -> Vec<Shape> {
        let k = self.options.neighbours.min(self.target.points.len());
        which
            .par_iter()
            .with_min_len(128)
            .map_init(
                || vec![Neighbour::NONE; k],
                |near, &j| {
                    let p = &self.target.points[j as usize];
                    self.index.k_nearest_one(p, f64::INFINITY, near);
                    shape(near.iter().filter_map(Neighbour::found).map(|i| &self.target.points[i]))
                },
            )
            .collect()
    }
}

/// Consecutive parts of the given lengths.
fn cut<'v, T>(mut rest: &'v mut [T], lengths: &[usize]) -> Vec<&'v mut [T]> {
    let mut part = |&n: &usize| {
        let (part, after) = std::mem::take(&mut rest).split_at_mut(n);
        rest = after;
        part
    };
    lengths.iter().map(&mut part).collect()
}

/// Principal directions of some points.
fn shape<'p>(points: impl Iterator<Item = &'p [f64; 2]> + Clone) -> Shape {
    let (n, sum) = points.clone().fold((0.0, [0.0; 2]), |(n, s), p| (n + 1.0, [s[0] + p[0], s[1] + p[1]]));
    let mean = [sum[0] / n, sum[1] / n];
    let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
    for p in points {
        let (dx, dy) = (p[0] - mean[0], p[1] - mean[1]);
        xx += dx * dx;
        xy += dx * dy;
        yy += dy * dy;
    }
    let (half, root) = (0.5 * (xx + yy), (0.25 * (xx - yy).powi(2) + xy * xy).sqrt());
    let (large, small) = (half + root, (half - root).max(0.0));
    let angle = 0.5 * (2.0 * xy).atan2(xx - yy);
    let (s, c) = angle.sin_cos();
    let ratio = if large > 0.0 { small / large } else { 1.0 };
    Shape { normal: [-s, c], along: ((ratio - LINE[0]) / (LINE[1] - LINE[0])).clamp(0.0, 1.0) }
}

/// Rows of the derivative of a transformed point by the point.
fn linear_part(h: &Matrix3<f64>, p: &[f64; 2]) -> [[f64; 2]; 2] {
    let w = h[(2, 0)] * p[0] + h[(2, 1)] * p[1] + h[(2, 2)];
    let q = apply(h, p);
    let row = |i: usize| [(h[(i, 0)] - q[i] * h[(2, 0)]) / w, (h[(i, 1)] - q[i] * h[(2, 1)]) / w];
    [row(0), row(1)]
}

/// Of a symmetric matrix given as xx, xy, yy; a singular one is widened a little.
fn inverse(c: &[f64; 3]) -> [f64; 3] {
    let tiny = 1e-9 * (c[0] + c[2]) + f64::MIN_POSITIVE;
    let [xx, xy, yy] = [c[0] + tiny, c[1], c[2] + tiny];
    let determinant = xx * yy - xy * xy;
    [yy / determinant, -xy / determinant, xx / determinant]
}

fn mahalanobis2(d: &[f64; 2], c: &[f64; 3]) -> f64 {
    let [xx, xy, yy] = inverse(c);
    xx * d[0] * d[0] + 2.0 * xy * d[0] * d[1] + yy * d[1] * d[1]
}

/// Drops all but the given part of the pairs, the closest ones.
fn trim(found: &mut [Neighbour], keep: f64) {
    let mut lengths: Vec<f64> = found.iter().filter(|n| n.found().is_some()).map(|n| n.distance2).collect();
    let kept = (keep * lengths.len() as f64).ceil() as usize;
    if kept == 0 || kept >= lengths.len() {
        return;
    }
    let (_, &mut limit, _) = lengths.select_nth_unstable_by(kept - 1, f64::total_cmp);
    found.iter_mut().filter(|n| n.distance2 > limit).for_each(|n| *n = Neighbour::NONE);
}

fn corners(points: &[[f64; 2]]) -> [[f64; 2]; 4] {
    let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
    for p in points {
        for d in 0..2 {
            low[d] = low[d].min(p[d]);
            high[d] = high[d].max(p[d]);
        }
    }
    [low, [high[0], low[1]], high, [low[0], high[1]]]
}
