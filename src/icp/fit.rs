//! The motion that brings pairs together, by weighted least squares.
//!
//! The families are nested: each has the parameters of the one before and some more. Increments are applied on the
//! left, `H ← exp-like(δ) H`, about the pairs' centroid and in units of their spread, so that all parameters are of the
//! same size and a small eigenvalue of the normal equations means what it seems to mean.

use nalgebra::{DMatrix, DVector, Matrix3};
use rayon::prelude::*;

use super::matching::Pairs;
use crate::error::{Error, Result};

/// The largest number of parameters.
pub(super) const MOST: usize = 8;

/// Parts of the largest eigenvalue below which a direction of the parameters is not determined and stays as it is.
pub(super) const UNDETERMINED: f64 = 1e-11;

/// A family of transformations of the plane.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Motion {
    /// A shift: 2 parameters.
    Translation,
    /// Shift and rotation: 3.
    Rigid,
    /// And scale: 4.
    Similarity,
    /// And stretch and shear: 6.
    Affine,
    /// And perspective: 8.
    Projective,
}

impl Motion {
    /// How many parameters.
    pub fn parameters(self) -> usize {
        match self {
            Self::Translation => 2,
            Self::Rigid => 3,
            Self::Similarity => 4,
            Self::Affine => 6,
            Self::Projective => 8,
        }
    }

    /// The names of the parameters that are reported, with the covariance in this order.
    pub fn names(self) -> &'static [&'static str] {
        match self {
            Self::Translation => &["tx", "ty"],
            Self::Rigid => &["rotation", "tx", "ty"],
            Self::Similarity => &["scale", "rotation", "tx", "ty"],
            Self::Affine => &["h11", "h12", "h13", "h21", "h22", "h23"],
            Self::Projective => &["h11", "h12", "h13", "h21", "h22", "h23", "h31", "h32"],
        }
    }

    /// By name.
    pub fn from_name(name: &str) -> Result<Self> {
        Ok(match name {
            "translation" => Self::Translation,
            "rigid" => Self::Rigid,
            "similarity" => Self::Similarity,
            "affine" => Self::Affine,
            "projective" => Self::Projective,
            _ => {
                return Err(Error::invalid(format!(
                    "there is no motion {name:?}; there are translation, rigid, similarity, affine and projective"
                )));
            }
        })
    }

    /// An increment, about the origin.
    fn retract(self, d: &[f64; MOST]) -> Matrix3<f64> {
        let [tx, ty, turn, scale, stretch, shear, g1, g2] = *d;
        match self {
            Self::Translation => Matrix3::new(1.0, 0.0, tx, 0.0, 1.0, ty, 0.0, 0.0, 1.0),
            Self::Rigid => {
                let (s, c) = turn.sin_cos();
                Matrix3::new(c, -s, tx, s, c, ty, 0.0, 0.0, 1.0)
            }
            // Linear in the parameters: one step of the adjustment is the solution.
            _ => Matrix3::new(
                1.0 + scale + stretch,
                -turn + shear,
                tx,
                turn + shear,
                1.0 + scale - stretch,
                ty,
                g1,
                g2,
                1.0,
            ),
        }
    }
}

/// Derivatives of a moved point by the increment's parameters.
#[inline(always)]
pub(super) fn derivatives(u: &[f64; 2]) -> [[f64; MOST]; 2] {
    let [x, y] = *u;
    [[1.0, 0.0, -y, x, x, y, -x * x, -x * y], [0.0, 1.0, x, y, -y, x, -x * y, -y * y]]
}

/// A point under a projective transformation.
#[inline(always)]
pub(super) fn apply(h: &Matrix3<f64>, p: &[f64; 2]) -> [f64; 2] {
    let (x, y) = (h[(0, 0)] * p[0] + h[(0, 1)] * p[1] + h[(0, 2)], h[(1, 0)] * p[0] + h[(1, 1)] * p[1] + h[(1, 2)]);
    // Most are affine, and divisions are what this costs.
    if h[(2, 0)] == 0.0 && h[(2, 1)] == 0.0 && h[(2, 2)] == 1.0 {
        return [x, y];
    }
    let w = h[(2, 0)] * p[0] + h[(2, 1)] * p[1] + h[(2, 2)];
    [x / w, y / w]
}

/// Centroid and root mean square spread of points: the units of the adjustment.
#[derive(Debug, Clone, Copy)]
pub(super) struct Units {
    pub centre: [f64; 2],
    pub spread: f64,
}

impl Units {
    pub fn of(points: &[[f64; 2]]) -> Result<Self> {
        let n = points.len() as f64;
        let sum = chunked(points, [0.0; 2], |s, p| [s[0] + p[0], s[1] + p[1]], |a, b| [a[0] + b[0], a[1] + b[1]]);
        let centre = sum.map(|v| v / n);
        let square = |p: &[f64; 2]| (p[0] - centre[0]).powi(2) + (p[1] - centre[1]).powi(2);
        let spread = (chunked(points, 0.0, |s, p| s + square(p), |a, b| a + b) / n).sqrt();
        if spread <= 1e-13 * centre[0].abs().max(centre[1].abs()) || spread == 0.0 {
            return Err(Error::Degenerate {
                what: "all pairs lie in one place".into(),
                quantity: "their spread",
                value: spread,
                limit: 1e-13,
                remedy: "begin with a larger threshold",
            });
        }
        Ok(Self { centre, spread })
    }

    #[inline(always)]
    pub fn local(&self, p: &[f64; 2]) -> [f64; 2] {
        let scale = 1.0 / self.spread;
        [(p[0] - self.centre[0]) * scale, (p[1] - self.centre[1]) * scale]
    }

    /// A transformation of local coordinates as one of the points' own.
    pub fn global(&self, h: &Matrix3<f64>) -> Matrix3<f64> {
        let [x, y] = self.centre;
        let s = self.spread;
        let to_local = Matrix3::new(1.0 / s, 0.0, -x / s, 0.0, 1.0 / s, -y / s, 0.0, 0.0, 1.0);
        Matrix3::new(s, 0.0, x, 0.0, s, y, 0.0, 0.0, 1.0) * h * to_local
    }
}

/// Of sums that are formed in parallel.
const CHUNK: usize = 4096;

/// A sum over chunks of fixed size, in their order: the same bits at any number of threads.
pub(super) fn chunked<T: Sync, S: Copy + Send + Sync>(
    items: &[T],
    zero: S,
    add: impl Fn(S, &T) -> S + Sync,
    join: impl Fn(S, S) -> S,
) -> S {
    let parts: Vec<S> = items.par_chunks(CHUNK).map(|c| c.iter().fold(zero, &add)).collect();
    parts.into_iter().fold(zero, join)
}

/// Upper triangle of the normal matrix, right-hand side.
#[derive(Clone, Copy)]
struct Normal<const P: usize> {
    n: [[f64; P]; P],
    g: [f64; P],
}

impl<const P: usize> Normal<P> {
    const ZERO: Self = Self { n: [[0.0; P]; P], g: [0.0; P] };

    #[inline(always)]
    fn add(mut self, u: &[f64; 2], v: &[f64; 2], w: &[f64; 3]) -> Self {
        let [jx, jy] = derivatives(u);
        let (dx, dy) = (v[0] - u[0], v[1] - u[1]);
        let [wxx, wxy, wyy] = *w;
        for i in 0..P {
            let (ax, ay) = (jx[i] * wxx + jy[i] * wxy, jx[i] * wxy + jy[i] * wyy);
            self.g[i] += ax * dx + ay * dy;
            for k in i..P {
                self.n[i][k] += ax * jx[k] + ay * jy[k];
            }
        }
        self
    }

    /// As [`Normal::add`] with the weight of one.
    #[inline(always)]
    fn add_plain(mut self, u: &[f64; 2], v: &[f64; 2]) -> Self {
        let [jx, jy] = derivatives(u);
        let (dx, dy) = (v[0] - u[0], v[1] - u[1]);
        for i in 0..P {
            self.g[i] += jx[i] * dx + jy[i] * dy;
            for k in i..P {
                self.n[i][k] += jx[i] * jx[k] + jy[i] * jy[k];
            }
        }
        self
    }

    fn join(mut self, other: Self) -> Self {
        for i in 0..P {
            self.g[i] += other.g[i];
            for k in i..P {
                self.n[i][k] += other.n[i][k];
            }
        }
        self
    }

    fn dynamic(&self) -> (DMatrix<f64>, DVector<f64>) {
        let n = DMatrix::from_fn(P, P, |i, k| if i <= k { self.n[i][k] } else { self.n[k][i] });
        (n, DVector::from_row_slice(&self.g))
    }
}

/// `N` and `g` of the pairs after a first motion of their local coordinates.
fn normal_equations<const P: usize>(pairs: &Pairs, units: &Units, h: &Matrix3<f64>) -> (DMatrix<f64>, DVector<f64>) {
    let weights = pairs.weights();
    let pair = |k: usize| (apply(h, &units.local(&pairs.moved[k])), units.local(&pairs.goals[k]));
    let starts: Vec<usize> = (0..pairs.len()).step_by(CHUNK).collect();
    let part = |&from: &usize| {
        let chunk = from..(from + CHUNK).min(pairs.len());
        let plain = |sum: Normal<P>, k: usize| {
            let (u, v) = pair(k);
            sum.add_plain(&u, &v)
        };
        let weighed = |sum: Normal<P>, k: usize| {
            let (u, v) = pair(k);
            sum.add(&u, &v, &weights[k])
        };
        if weights.is_empty() { chunk.fold(Normal::ZERO, plain) } else { chunk.fold(Normal::ZERO, weighed) }
    };
    let parts: Vec<Normal<P>> = starts.par_iter().map(part).collect();
    parts.into_iter().fold(Normal::ZERO, Normal::join).dynamic()
}

/// The information that weights hold about the increment's parameters, at local coordinates.
pub(super) fn information(rows: &[([f64; 2], [f64; 3])], parameters: usize) -> DMatrix<f64> {
    let all = chunked(rows, Normal::<MOST>::ZERO, |s, (u, w)| s.add(u, u, w), Normal::join).dynamic().0;
    all.view((0, 0), (parameters, parameters)).into_owned()
}

/// The motion, to be applied after the present transformation, that brings the pairs closest together.
pub(super) fn increment(pairs: &Pairs, motion: Motion) -> Result<Matrix3<f64>> {
    let units = Units::of(&pairs.moved)?;
    if motion == Motion::Rigid && pairs.weights().is_empty() {
        return Ok(units.global(&rigid(pairs, &units)));
    }
    let mut h = Matrix3::identity();
    for _ in 0..20 {
        let (n, g) = match motion {
            Motion::Translation => normal_equations::<2>(pairs, &units, &h),
            Motion::Rigid => normal_equations::<3>(pairs, &units, &h),
            Motion::Similarity => normal_equations::<4>(pairs, &units, &h),
            Motion::Affine => normal_equations::<6>(pairs, &units, &h),
            Motion::Projective => normal_equations::<8>(pairs, &units, &h),
        };
        let step = solve(n, &g);
        let mut d = [0.0; MOST];
        d[..step.len()].copy_from_slice(step.as_slice());
        let next = motion.retract(&d) * h;
        h = next / next[(2, 2)];
        if !h.iter().all(|v| v.is_finite()) {
            return Err(Error::NotConverged {
                what: "the least-squares transformation of the pairs",
                iterations: 20,
                detail: "its elements are not finite; try a family with fewer parameters".into(),
            });
        }
        // The next step would be of the square of this one's size. Of a linear family the first step is exact.
        if step.amax() < 1e-8 || matches!(motion, Motion::Translation | Motion::Similarity | Motion::Affine) {
            break;
        }
    }
    Ok(units.global(&h))
}

/// Turn and shift of pairs that all weigh the same, in local coordinates, whose origin is the centroid of what is moved:
/// in closed form, because it needs the pairs once.
///
/// Source: K. Arun, T. Huang and S. Blostein, Least-squares fitting of two 3-D point sets, 1987, in the plane.
fn rigid(pairs: &Pairs, units: &Units) -> Matrix3<f64> {
    let starts: Vec<usize> = (0..pairs.len()).step_by(CHUNK).collect();
    let part = |&from: &usize| {
        let chunk = from..(from + CHUNK).min(pairs.len());
        let places = pairs.moved[chunk.clone()].iter().zip(&pairs.goals[chunk]);
        places.fold([0.0; 4], |[dot, cross, x, y], (p, q)| {
            let (u, v) = (units.local(p), units.local(q));
            [dot + u[0] * v[0] + u[1] * v[1], cross + u[0] * v[1] - u[1] * v[0], x + v[0], y + v[1]]
        })
    };
    let parts: Vec<[f64; 4]> = starts.par_iter().map(part).collect();
    let [dot, cross, x, y] = parts.iter().fold([0.0; 4], |sum, part| std::array::from_fn(|k| sum[k] + part[k]));
    let n = pairs.len() as f64;
    // Goals in one place say nothing of the turn: what is left of the sums then is rounding.
    let (s, c) = if dot.hypot(cross) > 1e-9 * n { cross.atan2(dot).sin_cos() } else { (0.0, 1.0) };
    Matrix3::new(c, -s, x / n, s, c, y / n, 0.0, 0.0, 1.0)
}

/// `N⁺ g`: directions that the pairs say nothing about keep their value.
fn solve(n: DMatrix<f64>, g: &DVector<f64>) -> DVector<f64> {
    let eigen = n.symmetric_eigen();
    let limit = UNDETERMINED * eigen.eigenvalues.amax();
    let mut x = DVector::zeros(g.len());
    for (value, vector) in eigen.eigenvalues.iter().zip(eigen.eigenvectors.column_iter()) {
        if *value > limit {
            x += vector * (vector.dot(g) / value);
        }
    }
    x
}
