//! Similarity transformations of the plane (4 parameters) and of space (7 parameters).
//!
//! `y = b + s R (x − a)`, estimated from pairs by `min Σ w ‖y − b − s R (x − a)‖²`: only the second points are uncertain.
//! It turns about the pairs' weighted centroid `a` and not about the origin: coordinates with seven digits before the point lose nothing,
//! and the parameters' covariance has no blocks between turn, scale and shift.
//!
//! Sources: S. Umeyama, Least-squares estimation of transformation parameters between two point patterns, 1991, for the
//! closed form; the iterated adjustment from approximate values is the one that photogrammetry knows by the name of
//! absolute orientation.

use nalgebra::{DMatrix, DVector, SMatrix, SVector};

use crate::error::{Error, Result};
use crate::geometry::{Similarity, rotation_exp};

/// Points that leave their common line by less than this part of its length are called collinear.
const COLLINEAR: f64 = 1e-4;
/// The smallest determinacy of the rotation by the pairs, of 1.
const UNDETERMINED: f64 = 1e-9;

/// How pairs are weighted, and what is estimated.
#[derive(Debug, Clone, Copy, Default)]
pub struct SimilarityOptions<'a> {
    /// One per pair, 1/σ² of a coordinate; all 1 if there are none. A weight of 0 leaves a pair out.
    pub weights: Option<&'a [f64]>,
    /// Keep the scale at 1 (closed form) or at its approximate value (iterated).
    pub fixed_scale: bool,
}

/// A similarity transformation and how well the pairs determine it.
#[derive(Debug, Clone, PartialEq)]
pub struct SimilarityFit<const D: usize> {
    /// Positive.
    pub scale: f64,
    /// Orthonormal, determinant 1.
    pub rotation: SMatrix<f64, D, D>,
    /// The weighted centroid of the first points, about which it scales and turns.
    pub from: SVector<f64, D>,
    /// Where that point goes.
    pub to: SVector<f64, D>,
    /// `y` minus the transformed `x`, for every pair.
    pub residuals: Vec<[f64; D]>,
    /// A posteriori standard deviation of unit weight; NaN without redundancy.
    pub sigma0: f64,
    /// Redundancy.
    pub dof: usize,
    /// A posteriori, of scale (unless fixed), rotation (an angle, or a small rotation vector on the left), and `to`.
    pub covariance: DMatrix<f64>,
    /// Steps of the iteration; 0 for the closed form.
    pub iterations: usize,
    /// A mirror image would fit at least twice as well: an axis of one of the two frames is reversed.
    pub mirrored: bool,
}

impl<const D: usize> SimilarityFit<D> {
    /// One point.
    #[inline]
    pub fn apply(&self, x: &[f64; D]) -> [f64; D] {
        (self.to + self.rotation * (SVector::from(*x) - self.from) * self.scale).into()
    }

    /// The same transformation about the origin.
    pub fn similarity(&self) -> Similarity<D> {
        let translation = self.to - self.rotation * self.from * self.scale;
        Similarity { scale: self.scale, rotation: self.rotation, translation }
    }
}

/// Pairs about their weighted centroids, with what both estimators need to know of them.
struct Pairs<'a, const D: usize> {
    options: &'a SimilarityOptions<'a>,
    /// The centroids.
    from: SVector<f64, D>,
    to: SVector<f64, D>,
    /// Relative to them.
    x: Vec<SVector<f64, D>>,
    y: Vec<SVector<f64, D>>,
    total: f64,
    /// Of the first points, of the second, and between the second and the first.
    from_from: SMatrix<f64, D, D>,
    to_to: SMatrix<f64, D, D>,
    to_from: SMatrix<f64, D, D>,
    used: usize,
}

impl<'a, const D: usize> Pairs<'a, D> {
    fn new(from: &[[f64; D]], to: &[[f64; D]], options: &'a SimilarityOptions) -> Result<Self> {
        check(from, to, options)?;
        let weight = |i: usize| options.weights.map_or(1.0, |w| w[i]);
        let used = (0..from.len()).filter(|&i| weight(i) > 0.0).count();
        if used < D {
            return Err(Error::Degenerate {
                what: format!("a similarity transformation in {D}D is not determined"),
                quantity: "number of pairs",
                value: used as f64,
                limit: D as f64,
                remedy: "give more pairs",
            });
        }
        let total: f64 = (0..from.len()).map(weight).sum();
        // About the first point, so that the sums hold small numbers; then about the centroid.
        let mean = |points: &[[f64; D]]| {
            let first = SVector::from(points[0]);
            let sum: SVector<f64, D> =
                points.iter().enumerate().map(|(i, p)| (SVector::from(*p) - first) * weight(i)).sum();
            first + sum / total
        };
        let (a, b) = (mean(from), mean(to));
        let mut this = Self {
            options,
            from: a,
            to: b,
            x: from.iter().map(|x| SVector::from(*x) - a).collect(),
            y: to.iter().map(|y| SVector::from(*y) - b).collect(),
            total,
            from_from: SMatrix::zeros(),
            to_to: SMatrix::zeros(),
            to_from: SMatrix::zeros(),
            used,
        };
        for i in 0..from.len() {
            let w = weight(i) / total;
            let (x, y) = (this.x[i], this.y[i]);
            this.from_from += x * x.transpose() * w;
            this.to_to += y * y.transpose() * w;
            this.to_from += y * x.transpose() * w;
        }
        this.check_spread(&this.from_from, "first")?;
        this.check_spread(&this.to_to, "second")?;
        Ok(this)
    }

    /// The rotation of the least-squares solution, whatever the scale, with the singular values that determine it,
    /// and −1 where a mirror image would fit better.
    fn best_rotation(&self) -> Result<(SMatrix<f64, D, D>, SVector<f64, D>, f64)> {
        let (u, d, v) = svd(&self.to_from)?;
        let sign = if determinant(&u) * determinant(&v) < 0.0 { -1.0 } else { 1.0 };
        // The turn in the plane of the two weakest directions is held by the sum of their singular values.
        let held = (d[D - 2] + sign * d[D - 1]) / d[0];
        if held < UNDETERMINED || held.is_nan() {
            return Err(Error::Degenerate {
                what: "the pairs fit every rotation about some axis equally well".into(),
                quantity: "sum of the two smallest singular values of their covariance over the largest",
                value: held,
                limit: UNDETERMINED,
                remedy: "look for wrong pairs or a mirrored frame",
            });
        }
        let mut s = SVector::<f64, D>::repeat(1.0);
        s[D - 1] = sign;
        Ok((u * SMatrix::from_diagonal(&s) * v.transpose(), d, sign))
    }

    fn weight(&self, i: usize) -> f64 {
        self.options.weights.map_or(1.0, |w| w[i])
    }

    /// A rotation needs points that do not coincide, and in space points that do not lie on one line.
    fn check_spread(&self, moments: &SMatrix<f64, D, D>, which: &str) -> Result<()> {
        let spread = eigenvalues(moments);
        let (largest, second) = (spread[0].max(0.0).sqrt(), spread[1].max(0.0).sqrt());
        let at = self.from.amax().max(self.to.amax());
        if largest <= 1e-14 * at || largest == 0.0 {
            return Err(Error::Degenerate {
                what: format!("the {which} points of the pairs coincide, which leaves rotation and scale open"),
                quantity: "their largest extent",
                value: largest,
                limit: 1e-14 * at,
                remedy: "give pairs that lie apart",
            });
        }
        if D > 2 && second < COLLINEAR * largest {
            return Err(Error::Degenerate {
                what: format!(
                    "the {which} points of the pairs lie on one line (collinear), which leaves the turn about their line open"
                ),
                quantity: "extent across the line over extent along it",
                value: second / largest,
                limit: COLLINEAR,
                remedy: "add a pair beside the line",
            });
        }
        Ok(())
    }
}

fn check<const D: usize>(from: &[[f64; D]], to: &[[f64; D]], options: &SimilarityOptions) -> Result<()> {
    if from.len() != to.len() {
        return Err(Error::invalid(format!("{} points cannot be paired with {}", from.len(), to.len())));
    }
    for (which, points) in [("first", from), ("second", to)] {
        if let Some(i) = points.iter().position(|p| !p.iter().all(|v| v.is_finite())) {
            return Err(Error::invalid(format!("pair {i}: its {which} point is not finite: {:?}", points[i])));
        }
    }
    if let Some(w) = options.weights {
        if w.len() != from.len() {
            return Err(Error::invalid(format!("{} weights were given for {} pairs", w.len(), from.len())));
        }
        if let Some(i) = w.iter().position(|w| !w.is_finite() || *w < 0.0) {
            return Err(Error::invalid(format!("pair {i}: a weight of {} is not possible", w[i])));
        }
    }
    Ok(())
}

/// Descending.
fn eigenvalues<const D: usize>(m: &SMatrix<f64, D, D>) -> Vec<f64> {
    let dynamic = DMatrix::from_fn(D, D, |i, j| m[(i, j)]);
    let mut values: Vec<f64> = dynamic.symmetric_eigenvalues().iter().copied().collect();
    values.sort_by(|a, b| b.total_cmp(a));
    values
}

/// `U`, singular values descending, `V` of a small square matrix.
fn svd<const D: usize>(m: &SMatrix<f64, D, D>) -> Result<(SMatrix<f64, D, D>, SVector<f64, D>, SMatrix<f64, D, D>)> {
    let parts = faer::Mat::<f64>::from_fn(D, D, |i, j| m[(i, j)])
        .svd()
        .map_err(|e| Error::Internal(format!("singular values of a {D} × {D} matrix: {e:?}")))?;
    Ok((
        SMatrix::from_fn(|i, j| parts.U()[(i, j)]),
        SVector::from_fn(|i, _| parts.S()[i]),
        SMatrix::from_fn(|i, j| parts.V()[(i, j)]),
    ))
}

fn determinant<const D: usize>(m: &SMatrix<f64, D, D>) -> f64 {
    DMatrix::from_fn(D, D, |i, j| m[(i, j)]).determinant()
}

/// The transformation in closed form (Umeyama 1991).
pub fn fit_similarity<const D: usize>(
    from: &[[f64; D]],
    to: &[[f64; D]],
    options: &SimilarityOptions,
) -> Result<SimilarityFit<D>> {
    let pairs = Pairs::new(from, to, options)?;
    let (rotation, d, sign) = pairs.best_rotation()?;
    let spread = pairs.from_from.trace();
    let proper = d.sum() - (1.0 - sign) * d[D - 1];
    let scale = if options.fixed_scale { 1.0 } else { proper / spread };
    let mut fit = pairs.assess(&Local { scale, rotation, shift: SVector::zeros() }, 0)?;
    if sign < 0.0 {
        let misfit = |gain: f64| pairs.to_to.trace() - gain * gain / spread;
        fit.mirrored = misfit(d.sum()).max(0.0) < 0.25 * misfit(proper);
    }
    Ok(fit)
}

/// Parameters: scale unless fixed, rotation, shift.
fn parameters<const D: usize>(options: &SimilarityOptions) -> usize {
    usize::from(!options.fixed_scale) + D * (D - 1) / 2 + D
}

/// Derivatives of the transformed point by the parameters: `turned` is `R (x − a)`.
fn jacobian<const D: usize>(turned: &SVector<f64, D>, scale: f64, options: &SimilarityOptions) -> DMatrix<f64> {
    let mut j = DMatrix::zeros(D, parameters::<D>(options));
    let mut column = 0;
    if !options.fixed_scale {
        for d in 0..D {
            j[(d, 0)] = turned[d];
        }
        column = 1;
    }
    let q = turned * scale;
    if D == 2 {
        j[(0, column)] = -q[1];
        j[(1, column)] = q[0];
        column += 1;
    } else {
        // The columns of −[q]×.
        for (k, [a, b]) in [[1, 2], [2, 0], [0, 1]].into_iter().enumerate() {
            j[(b, column + k)] = q[a];
            j[(a, column + k)] = -q[b];
        }
        column += 3;
    }
    for d in 0..D {
        j[(d, column + d)] = 1.0;
    }
    j
}

/// A transformation between the centred points: `y = shift + scale · rotation · x`.
#[derive(Clone, Copy)]
struct Local<const D: usize> {
    scale: f64,
    rotation: SMatrix<f64, D, D>,
    shift: SVector<f64, D>,
}

impl<const D: usize> Pairs<'_, D> {
    fn residual(&self, t: &Local<D>, i: usize) -> SVector<f64, D> {
        self.y[i] - t.shift - t.rotation * self.x[i] * t.scale
    }

    /// Normal equations `N x = g` of the step, and the weighted sum of squares.
    fn normal_equations(&self, t: &Local<D>) -> (DMatrix<f64>, DVector<f64>, f64) {
        let p = parameters::<D>(self.options);
        let (mut n, mut g, mut cost) = (DMatrix::zeros(p, p), DVector::zeros(p), 0.0);
        for i in 0..self.x.len() {
            let w = self.weight(i);
            let v = self.residual(t, i);
            let j = jacobian(&(t.rotation * self.x[i]), t.scale, self.options);
            n += j.transpose() * &j * w;
            g += j.transpose() * DVector::from_column_slice(v.as_slice()) * w;
            cost += w * v.norm_squared();
        }
        (n, g, cost)
    }

    /// What an iteration ended with, unless the gradient vanishes there without a minimum: half a turn away from it.
    fn accepted(&self, t: &Local<D>, iterations: usize) -> Result<SimilarityFit<D>> {
        let (best, ..) = self.best_rotation()?;
        let departure = (t.rotation - best).amax();
        if departure > 1e-5 {
            return Err(Error::NotConverged {
                what: "the similarity transformation",
                iterations,
                detail: format!(
                    "it ended where its rotation differs by {departure:.3} from the best one; the approximate rotation \
                     is too far off"
                ),
            });
        }
        self.assess(t, iterations)
    }

    /// Residuals and covariance at the least-squares solution.
    fn assess(&self, t: &Local<D>, iterations: usize) -> Result<SimilarityFit<D>> {
        let (n, _, cost) = self.normal_equations(t);
        let dof = (D * self.used).saturating_sub(parameters::<D>(self.options));
        let variance = if dof > 0 { cost / dof as f64 } else { f64::NAN };
        let inverse = inverse(&n)
            .ok_or_else(|| Error::Internal("singular normal equations of a similarity that is determined".into()))?;
        Ok(SimilarityFit {
            scale: t.scale,
            rotation: t.rotation,
            from: self.from,
            to: self.to + t.shift,
            residuals: (0..self.x.len()).map(|i| self.residual(t, i).into()).collect(),
            sigma0: variance.sqrt(),
            dof,
            covariance: inverse * variance,
            iterations,
            mirrored: false,
        })
    }
}

/// Of a positive definite matrix whose parameters have different units.
fn inverse(n: &DMatrix<f64>) -> Option<DMatrix<f64>> {
    let unit = DVector::from_iterator(n.nrows(), n.diagonal().iter().map(|v| 1.0 / v.sqrt()));
    let unit = DMatrix::from_diagonal(&unit);
    Some(&unit * (&unit * n * &unit).cholesky()?.inverse() * &unit)
}

/// After a step of the parameters.
fn stepped<const D: usize>(t: &Local<D>, step: &DVector<f64>, options: &SimilarityOptions) -> Local<D> {
    let mut next = *t;
    let mut column = 0;
    if !options.fixed_scale {
        next.scale += step[0];
        column = 1;
    }
    let turn = if D == 2 {
        let (s, c) = step[column].sin_cos();
        column += 1;
        DMatrix::from_row_slice(2, 2, &[c, -s, s, c])
    } else {
        let v = nalgebra::Vector3::new(step[column], step[column + 1], step[column + 2]);
        column += 3;
        let r = rotation_exp(&v);
        DMatrix::from_fn(3, 3, |i, j| r[(i, j)])
    };
    let turn = SMatrix::<f64, D, D>::from_fn(|i, j| turn[(i, j)]);
    next.rotation = turn * t.rotation;
    for d in 0..D {
        next.shift[d] += step[column + d];
    }
    next
}

/// The transformation by iterated least squares (Levenberg–Marquardt) from approximate values, as the paper has it.
///
/// The closed form needs no approximate values and is better where it applies; this one says, by its steps, whether
/// the approximate values were good enough for the linearised equations.
pub fn iterate_similarity<const D: usize>(
    from: &[[f64; D]],
    to: &[[f64; D]],
    approximate: &Similarity<D>,
    options: &SimilarityOptions,
) -> Result<SimilarityFit<D>> {
    const STEPS: usize = 100;
    let pairs = Pairs::new(from, to, options)?;
    if !(approximate.scale.is_finite() && approximate.scale > 0.0) {
        return Err(Error::invalid(format!("an approximate scale of {} is not possible", approximate.scale)));
    }
    let shift = SVector::from(approximate.apply(&pairs.from.into())) - pairs.to;
    let mut t = Local { scale: approximate.scale, rotation: approximate.rotation, shift };
    let small = 1e-13 * pairs.to_to.trace().sqrt();
    let (mut n, mut g, mut cost) = pairs.normal_equations(&t);
    let mut damping = 0.0;
    for iteration in 1..=STEPS {
        let mut damped = n.clone();
        for i in 0..n.nrows() {
            damped[(i, i)] *= 1.0 + damping;
        }
        let step = inverse(&damped).map(|inverse| inverse * &g);
        // By what the step moves the points, root mean square.
        let moves = |step: &DVector<f64>| (step.dot(&(&n * step)) / pairs.total).max(0.0).sqrt();
        // No descent is left, at the last digit when the damping has made the steps small.
        if step.as_ref().is_some_and(|step| moves(step) <= small) {
            return pairs.accepted(&t, iteration);
        }
        let next = step.map(|step| stepped(&t, &step, options)).filter(|next| next.scale > 0.0);
        match next.map(|next| (next, pairs.normal_equations(&next))) {
            Some((next, equations)) if equations.2 <= cost => {
                t = next;
                (n, g, cost) = equations;
                damping = if damping < 1e-9 { 0.0 } else { damping * 0.1 };
            }
            _ => damping = if damping == 0.0 { 1e-4 } else { damping * 10.0 },
        }
    }
    Err(Error::NotConverged {
        what: "the similarity transformation",
        iterations: STEPS,
        detail: format!(
            "root mean square {:.3e} over {} pairs; better approximate values or the closed form help",
            (cost / pairs.total).sqrt(),
            pairs.used
        ),
    })
}

#[cfg(test)]
mod tests;
