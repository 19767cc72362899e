//! The collinearity equations as a least-squares problem: a view that sees known points where they were measured.

use rayon::prelude::*;

use super::batch::{LANES, PoseSums};
use super::levenberg::{LeastSquares, Normal};
use super::loss::Loss;
use super::observations::Observations;
use super::parameters::{FreeSet, MAX_FREE};
use super::priors::Priors;
use crate::geometry::View;

/// Points per task. Sums are formed block by block and added in order: the same bits at any number of threads.
const BLOCK: usize = 256 * LANES;

/// The problem: which points, which parameters, which loss.
pub(super) struct Collinearity<'a> {
    pub free: &'a FreeSet,
    pub observations: &'a Observations,
    pub priors: &'a Priors,
    pub loss: Loss,
    /// Residuals enter the loss in this many sigmas.
    pub scale: f64,
}

impl Collinearity<'_> {
    /// Misclosure (projected − measured, in sigmas) and design rows of a point; `None` where it is not visible.
    #[inline(always)]
    fn rows(&self, view: &View, i: usize) -> Option<([f64; 2], [[f64; MAX_FREE]; 2])> {
        let j = view.project_with_jacobian(&self.observations.xyz[i])?;
        let xy = self.observations.xy[i];
        let mut rows = [[0.0; MAX_FREE]; 2];
        self.free.columns(view, &j, &mut rows);
        let precision = &self.observations.precision;
        let v = precision.whiten(i, [j.xy[0] - xy[0], j.xy[1] - xy[1]]);
        for k in 0..self.free.len() {
            [rows[0][k], rows[1][k]] = precision.whiten(i, [rows[0][k], rows[1][k]]);
        }
        Some((v, rows))
    }

    /// The sums over the points from `first` to `last`; `None` where one of them is not visible.
    fn block(&self, view: &View, first: usize, last: usize) -> Option<Normal> {
        if self.loss == Loss::Squares
            && self.free.is_pose()
            && let Some((flat, sigma)) = self.observations.flat(view)
        {
            // The usual case: the pose alone, one sigma, least squares.
            let batches = &self.observations.batches()[first / LANES..last.div_ceil(LANES)];
            let sums = flat.pose_sums(batches, last - first);
            return (sums.visible == last - first).then(|| pose_normal(&sums, 1.0 / (sigma * sigma)));
        }
        self.any_block(view, first, last)
    }

    fn any_block(&self, view: &View, first: usize, last: usize) -> Option<Normal> {
        let u = self.free.len();
        let mut sums = Normal::zero(u);
        let per_scale2 = 1.0 / (self.scale * self.scale);
        for i in first..last {
            let (mut v, mut rows) = self.rows(view, i)?;
            let s = v[0] * v[0] + v[1] * v[1];
            if self.loss == Loss::Squares {
                sums.cost += s;
            } else {
                let (rho, weight) = self.loss.at(s * per_scale2);
                sums.cost += rho / per_scale2;
                let root = weight.sqrt();
                v = v.map(|v| v * root);
                for row in &mut rows {
                    row.iter_mut().take(u).for_each(|r| *r *= root);
                }
            }
            sums.add(&rows[0][..u], v[0]);
            sums.add(&rows[1][..u], v[1]);
        }
        Some(sums)
    }

    fn sums(&self, view: &View) -> Option<Normal> {
        let n = self.observations.len();
        let mut total = if n <= BLOCK {
            self.block(view, 0, n)?
        } else {
            let blocks: Option<Vec<Normal>> = (0..n.div_ceil(BLOCK))
                .into_par_iter()
                .map(|b| self.block(view, b * BLOCK, ((b + 1) * BLOCK).min(n)))
                .collect();
            let mut total = Normal::zero(self.free.len());
            for block in blocks? {
                total.absorb(&block);
            }
            total
        };
        for (v, row) in self.priors.rows(self.free, view) {
            total.cost += v * v;
            total.add(&row[..self.free.len()], v);
        }
        Some(total)
    }

    /// Every weighted design row with its misclosure, priors last; `None` where a point is not visible.
    pub fn all_rows(&self, view: &View) -> Option<Vec<([f64; MAX_FREE], f64)>> {
        let mut all = Vec::with_capacity(2 * self.observations.len() + self.priors.terms.len());
        for i in 0..self.observations.len() {
            let (v, rows) = self.rows(view, i)?;
            all.push((rows[0], v[0]));
            all.push((rows[1], v[1]));
        }
        all.extend(self.priors.rows(self.free, view).into_iter().map(|(v, row)| (row, v)));
        Some(all)
    }
}

fn pose_normal(sums: &PoseSums, weight: f64) -> Normal {
    let mut normal = Normal::zero(6);
    normal.cost = sums.cost * weight;
    let mut upper = sums.n.iter();
    for i in 0..6 {
        normal.g[i] = sums.g[i] * weight;
        for (j, n) in (i..6).zip(&mut upper) {
            normal.n[6 * i + j] = n * weight;
        }
    }
    normal
}

impl LeastSquares for Collinearity<'_> {
    type State = View;

    fn normal(&self, view: &View) -> Option<Normal> {
        let sums = self.sums(view)?;
        let u = sums.len;
        let finite =
            sums.cost.is_finite() && sums.g[..u].iter().all(|v| v.is_finite()) && sums.n.iter().all(|v| v.is_finite());
        finite.then_some(sums)
    }

    fn step(&self, view: &View, delta: &[f64]) -> Option<View> {
        // A rotation by a radian is no refinement, and half turns come back.
        let turn: f64 = (0..3).filter_map(|k| self.free.rotation_place(k)).map(|p| delta[p] * delta[p]).sum();
        if turn > 1.0 {
            return None;
        }
        self.free.apply(view, delta).ok()
    }

    fn rounding(&self) -> f64 {
        // Pixels carry about 1e-13 of the photo's width.
        let o = &self.observations;
        let size = o.xy.iter().flatten().fold(100.0_f64, |m, v| m.max(v.abs()));
        let sigma = o.precision.typical_sigma();
        2.0 * o.len() as f64 * (1e-13 * size / sigma).powi(2)
    }
}
