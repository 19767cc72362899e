//! Where the next control point would help most, and by how much.
//!
//! A new point with design rows a and misclosure cofactor W changes the covariance to
//! `Q' = Q − Q aᵀ (W + a Q aᵀ)⁻¹ a Q`, whatever will be measured there. Candidates are judged by the predicted error over
//! target places: its mean (V-optimality) or its maximum (G-optimality). The best one is added, then the next is sought.
//!
//! Source: V. V. Fedorov, Theory of Optimal Experiments, 1972.

use nalgebra::{DMatrix, Matrix2, Matrix2x3, Matrix3};
use rayon::prelude::*;

use super::view_conditions::design_of;
use super::view_covariance::ViewCovariance;
use crate::error::{Error, Result};
use crate::geometry::View;

/// What is to become small.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Criterion {
    /// The root mean square of the predicted error over the targets.
    Mean,
    /// The largest predicted error of a target.
    Largest,
}

/// A place where a control point could be measured.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Candidate {
    /// World frame.
    pub xyz: [f64; 3],
    /// Its expected covariance in the cloud.
    pub covariance_xyz: [[f64; 3]; 3],
    /// Its expected covariance in the photo, px².
    pub covariance_xy: [[f64; 2]; 2],
}

/// One piece of advice, after the ones before it were followed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Advice {
    /// The candidate's number.
    pub candidate: usize,
    /// Where it lies in the photo.
    pub xy: [f64; 2],
    /// One sigma per axis, px: root mean square over the targets, before and after.
    pub mean_px: [f64; 2],
    /// The largest of the targets' sigmas, px, before and after.
    pub largest_px: [f64; 2],
}

/// What was judged, and the advice.
#[derive(Debug, Clone, PartialEq)]
pub struct NextPoints {
    /// In the order in which to measure.
    pub advice: Vec<Advice>,
    /// For each candidate, if it were the next one alone: the mean predicted error, px. NaN where it is not visible.
    pub mean_px: Vec<f64>,
    /// The same for the largest predicted error.
    pub largest_px: Vec<f64>,
}

/// Judges candidates by the predicted errors of target points of the world.
pub fn next_points(
    view: &View,
    covariance: &ViewCovariance,
    candidates: &[Candidate],
    targets: &[[f64; 3]],
    criterion: Criterion,
    count: usize,
) -> Result<NextPoints> {
    let free = covariance.free();
    let rows: Vec<DMatrix<f64>> = targets.iter().filter_map(|t| design_of(free, view, t)).collect();
    if rows.is_empty() {
        return Err(Error::invalid(format!("none of {} target places is visible in the photo", targets.len())));
    }
    let prepared: Vec<Option<Prepared>> = candidates.par_iter().map(|c| prepare(view, covariance, c)).collect();
    if prepared.iter().all(Option::is_none) {
        return Err(Error::invalid(format!("none of {} candidate places is visible in the photo", candidates.len())));
    }
    let mut q = covariance.matrix().clone();
    let mut result = NextPoints { advice: Vec::new(), mean_px: Vec::new(), largest_px: Vec::new() };
    for turn in 0..count {
        let now = figures(&rows, &q);
        let after: Vec<[f64; 2]> = prepared
            .par_iter()
            .map(|c| match c.as_ref().and_then(|c| c.updated(&q)) {
                Some(next) => figures(&rows, &next),
                None => [f64::NAN; 2],
            })
            .collect();
        if turn == 0 {
            result.mean_px = after.iter().map(|f| f[0]).collect();
            result.largest_px = after.iter().map(|f| f[1]).collect();
        }
        let which = usize::from(criterion == Criterion::Largest);
        let best = (0..after.len())
            .filter(|&i| after[i][which].is_finite())
            .min_by(|&a, &b| after[a][which].total_cmp(&after[b][which]));
        let Some((i, c)) = best.and_then(|i| prepared[i].as_ref().map(|c| (i, c))) else { break };
        let Some(next) = c.updated(&q) else { break };
        result.advice.push(Advice {
            candidate: i,
            xy: c.xy,
            mean_px: [now[0], after[i][0]],
            largest_px: [now[1], after[i][1]],
        });
        q = next;
    }
    Ok(result)
}

struct Prepared {
    xy: [f64; 2],
    rows: DMatrix<f64>,
    own: Matrix2<f64>,
}

fn prepare(view: &View, covariance: &ViewCovariance, c: &Candidate) -> Option<Prepared> {
    let j = view.project_with_jacobian(&c.xyz)?;
    if !view.camera.contains(&j.xy) {
        return None;
    }
    let j_x = Matrix2x3::from_fn(|i, k| j.d_xyz[i][k]);
    let object = Matrix3::from_fn(|i, k| c.covariance_xyz[i][k]);
    let own = j_x * object * j_x.transpose() + Matrix2::from_fn(|i, k| c.covariance_xy[i][k]);
    Some(Prepared { xy: j.xy, rows: design_of(covariance.free(), view, &c.xyz)?, own })
}

impl Prepared {
    fn updated(&self, q: &DMatrix<f64>) -> Option<DMatrix<f64>> {
        let qa = q * self.rows.transpose();
        let aqa = &self.rows * &qa;
        let inner = (self.own + Matrix2::from_fn(|i, k| aqa[(i, k)])).try_inverse()?;
        let inner = DMatrix::from_fn(2, 2, |i, k| inner[(i, k)]);
        Some(q - &qa * inner * qa.transpose())
    }
}

/// Root mean square and maximum of one sigma per axis.
fn figures(rows: &[DMatrix<f64>], q: &DMatrix<f64>) -> [f64; 2] {
    let (mut sum, mut largest) = (0.0, 0.0f64);
    for r in rows {
        let half_trace: f64 = (0..2)
            .map(|i| {
                let a = r.row(i);
                let mut total = 0.0;
                for m in 0..q.ncols() {
                    total += a[m] * a.iter().zip(q.column(m).iter()).map(|(x, y)| x * y).sum::<f64>();
                }
                0.5 * total
            })
            .sum();
        sum += half_trace.max(0.0);
        largest = largest.max(half_trace);
    }
    [(sum / rows.len() as f64).sqrt(), largest.max(0.0).sqrt()]
}
