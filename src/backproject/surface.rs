//! One surface through measured depths, as a plane: there the inverse depth is linear in the ray's direction.
//!
//! With `n·X = e` on the plane and `X = s w`, `1/s = (n/e)·w`: exact under any lens, for depths along the axis as well as
//! for ranges. A plane is looked for that holds the nearest sample and as many others as possible; samples of another
//! surface do not take part in it.

use std::f64::consts::TAU;

use nalgebra::{Matrix3, Vector3};

use super::opening::{spacing, triangle};

/// A measured depth near a pixel.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sample {
    /// Coefficients of the ray's direction in the basis at the pixel: 1, and two that are small.
    pub row: Vector3<f64>,
    /// One over the depth.
    pub inverse: f64,
    /// Its place from the pixel, pixels.
    pub offset: [f64; 2],
}

/// The largest number of samples that are looked at, nearest first.
pub(super) const MOST: usize = 32;
/// Two samples of a surface may leave so large an angle open around a pixel that still lies between them, radians.
const SURROUNDED: f64 = 170.0 * std::f64::consts::PI / 180.0;
/// Samples from which planes are formed.
const SEEDS: usize = 8;
/// Samples that a plane has to hold: one more than form it.
const FEWEST: usize = 4;

/// Scatter of a plane's samples beyond their noise is relief if it exceeds that by so many of its own sigmas.
const RELIEF: f64 = 1.0;
/// The part of that variance that is passed on to the pixel: some samples stand out, most are near the mean.
const PASSED_ON: f64 = 0.5;
/// A sample that is off its neighbours' plane by so many times what samples may be lies across a depth edge.
const EDGE: f64 = 2.0;

/// How far samples may be from their plane, relative to the inverse depth.
#[derive(Debug, Clone, Copy)]
pub(super) struct Tolerance {
    /// One sigma of a depth over the depth.
    pub sigma: f64,
    /// What curvature and rounding may do, relative.
    pub systematic: f64,
}

impl Tolerance {
    /// What noise makes of a plane through few samples allows twice as much as of one sample.
    fn reach(&self, s: &Sample) -> f64 {
        4.0 * self.sigma + self.systematic * (1.0 + distance(s))
    }
}

/// A plane in the basis at the pixel.
#[derive(Debug, Clone)]
pub(super) struct Surface {
    /// The inverse depth at the pixel, and its derivatives by the two small coefficients.
    pub value: Vector3<f64>,
    /// Of the inverse depth at the pixel, one sigma.
    pub sigma: f64,
    /// Whether samples of the surface lie all around the pixel, and hardly any of another within their ring.
    pub surrounds: bool,
    /// Which of the samples lie on it.
    inside: [bool; MOST],
    /// Whether samples of other surfaces lie where those of this one leave the largest angle open.
    pub bounded: bool,
}

fn miss(value: &Vector3<f64>, s: &Sample) -> f64 {
    (value.dot(&s.row) - s.inverse).abs() / s.inverse
}

/// The least-squares plane of some samples, closer ones weighing more, with the cofactor of its value at the pixel.
fn fit<'s>(samples: impl Iterator<Item = &'s Sample> + Clone, radius: f64) -> Option<(Vector3<f64>, f64)> {
    let weight = |s: &Sample| 1.0 / (1.0 + (s.offset[0].powi(2) + s.offset[1].powi(2)) / (radius * radius));
    let (mut n, mut g, mut spread) = (Matrix3::zeros(), Vector3::zeros(), 0.0f64);
    for s in samples.clone() {
        let w = weight(s);
        n += s.row * s.row.transpose() * w;
        g += s.row * (s.inverse * w);
        spread = spread.max(s.row.y.abs()).max(s.row.z.abs());
    }
    // The small coefficients in their own unit, or the inverse is lost in rounding.
    let unit = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0 / spread, 1.0 / spread));
    let inverse = unit * (unit * n * unit).try_inverse()? * unit;
    let value = inverse * g;
    // Law of propagation with the weights as they are: all samples have the same sigma.
    let influence = inverse.row(0).transpose();
    let cofactor: f64 = samples.map(|s| (weight(s) * influence.dot(&s.row)).powi(2)).sum();
    (value.iter().all(|v| v.is_finite()) && cofactor.is_finite()).then_some((value, cofactor))
}

/// The plane through three samples, unless they lie nearly in a line.
fn through(a: &Sample, b: &Sample, c: &Sample) -> Option<Vector3<f64>> {
    let (u, v) = (
        [b.offset[0] - a.offset[0], b.offset[1] - a.offset[1]],
        [c.offset[0] - a.offset[0], c.offset[1] - a.offset[1]],
    );
    if (u[0] * v[1] - u[1] * v[0]).abs() < 0.5 {
        return None;
    }
    let rows = Matrix3::from_rows(&[a.row.transpose(), b.row.transpose(), c.row.transpose()]);
    rows.try_inverse().map(|inverse| inverse * Vector3::new(a.inverse, b.inverse, c.inverse))
}

/// The surface at the pixel that the nearest sample, the first one, lies on. `possible` says whether a plane may be: at
/// grazing incidence it may not, for then it stands across a depth edge.
pub(super) fn surface(
    samples: &[Sample],
    radius: f64,
    tolerance: &Tolerance,
    possible: impl Fn(&Vector3<f64>) -> bool,
) -> Option<Surface> {
    if samples.len() < FEWEST {
        return None;
    }
    let holds = |value: &Vector3<f64>, s: &Sample| miss(value, s) <= tolerance.reach(s);
    let mut best: Option<Vector3<f64>> = None;
    let mut most = 0;
    let all = fit(samples.iter(), radius).map(|f| f.0).filter(|v| samples.iter().all(|s| holds(v, s)) && possible(v));
    if all.is_some() {
        (best, most) = (all, samples.len());
    } else {
        let seeds = &samples[..samples.len().min(SEEDS)];
        for i in 1..seeds.len() {
            for k in i + 1..seeds.len() {
                let Some(value) = through(&seeds[0], &seeds[i], &seeds[k]).filter(&possible) else { continue };
                let held = samples.iter().filter(|s| holds(&value, s)).count();
                if held > most {
                    (best, most) = (Some(value), held);
                }
            }
        }
    }
    let mut value = best.filter(|_| most >= FEWEST)?;
    let mut cofactor = 0.0;
    let mut inside = [false; MOST];
    for _ in 0..2 {
        for (inside, s) in inside.iter_mut().zip(samples) {
            *inside = holds(&value, s);
        }
        let chosen = samples.iter().zip(&inside).filter(|(_, inside)| **inside).map(|(s, _)| s);
        (value, cofactor) = fit(chosen, radius)?;
    }
    let held: Vec<&Sample> = samples.iter().zip(&inside).filter(|(_, i)| **i).map(|(s, _)| s).collect();
    if held.len() < FEWEST || !inside[0] || !possible(&value) || value.x <= 0.0 {
        return None;
    }
    let squares: f64 = held.iter().map(|s| miss(&value, s).powi(2)).sum();
    let freedom = (held.len() - 3) as f64;
    let scatter = squares / freedom;
    let noise = tolerance.sigma.powi(2);
    // What lies beyond the noise, and beyond what chance makes of it, is relief: neighbours share it, and their mean is
    // no nearer to the surface at the pixel than each of them.
    let relief = (scatter - noise * (1.0 + RELIEF * (2.0 / freedom).sqrt())).max(0.0);
    let sigma = (scatter.max(noise) * cofactor + PASSED_ON * relief).sqrt() * value.x;

    let (gap, open) = largest_gap(&held);
    let in_gap = |s: &Sample| (angle(s) - open).rem_euclid(TAU) < gap;
    let bounded = samples.iter().zip(&inside).any(|(s, inside)| !inside && in_gap(s));
    Some(Surface { value, sigma, surrounds: surrounds(&held, samples, &inside), inside, bounded })
}

fn angle(s: &Sample) -> f64 {
    s.offset[1].atan2(s.offset[0])
}

fn distance(s: &Sample) -> f64 {
    s.offset[0].hypot(s.offset[1])
}

/// The largest angle that samples leave open, and where it begins.
fn largest_gap(samples: &[&Sample]) -> (f64, f64) {
    let mut angles: Vec<f64> = samples.iter().map(|s| angle(s)).collect();
    angles.sort_by(f64::total_cmp);
    let last = angles[angles.len() - 1];
    let mut largest = (TAU + angles[0] - last, last);
    for pair in angles.windows(2) {
        if pair[1] - pair[0] > largest.0 {
            largest = (pair[1] - pair[0], pair[0]);
        }
    }
    largest
}

/// Whether the surface's nearest samples lie all around the pixel without those of another surface among them: a plane
/// that leans across a depth edge holds a row of samples on either side, and loses the next ones.
fn surrounds(held: &[&Sample], samples: &[Sample], inside: &[bool; MOST]) -> bool {
    let Some(n) = (3..=held.len()).find(|&n| largest_gap(&held[..n]).0 < SURROUNDED) else { return false };
    let ring = distance(held[n - 1]) + 1.5;
    let among = |held: bool| samples.iter().zip(inside).filter(|(s, i)| **i == held && distance(s) <= ring).count();
    5 * among(false) <= among(true)
}

/// The triangle of samples that a pixel lies in.
#[derive(Debug, Clone, Copy)]
pub(super) struct Opening {
    /// Radius of its circle in the surface's usual spacings. One missing row of a square grid makes 1.12 of 0.71, wherever
    /// in it the pixel is.
    pub width: f64,
    /// Of the inverse depth at the pixel, one sigma: corners that lie on something else, as near as relief, may go on to
    /// it.
    pub relief: f64,
    /// Whether a corner lies across a depth edge.
    pub edge: bool,
}

impl Surface {
    /// Between which samples the pixel lies. `samples` are those that the surface was found in.
    pub fn opening(&self, samples: &[Sample], tolerance: &Tolerance) -> Option<Opening> {
        let mut places = [[0.0; 2]; MOST];
        let mut held = [[0.0; 2]; MOST];
        let mut n = 0;
        for (i, s) in samples.iter().enumerate() {
            places[i] = s.offset;
            if self.inside[i] {
                held[n] = s.offset;
                n += 1;
            }
        }
        let found = triangle(&places[..samples.len()])?;
        let (mut variance, mut edge) = (0.0, false);
        for (i, share) in found.corners.iter().zip(&found.shares) {
            if !self.inside[*i] {
                let off = miss(&self.value, &samples[*i]);
                variance += share.max(0.0) * off * off;
                edge |= off > EDGE * tolerance.reach(&samples[*i]);
            }
        }
        let width = found.radius / spacing(&held[..n]);
        Some(Opening { width, relief: variance.sqrt() * self.value.x, edge })
    }
}
