//! Check points: known in the cloud and in the photo, but without a part in the estimate. They judge it.
//!
//! The difference d = predicted − observed has the covariance `J Σ Jᵀ + J_X Σ_X J_Xᵀ + Σ_xy`. All check points share the
//! view's errors, so that the test of all together uses their joint covariance (by the matrix inversion lemma).

use nalgebra::{DMatrix, DVector, Matrix2, Matrix2x3, Matrix3, Vector2, Vector3};

use super::distributions::Reference;
use super::view_covariance::ViewCovariance;
use crate::error::{Error, Result};
use crate::estimation::MAX_FREE;
use crate::geometry::{Model, View};

/// Root mean squares by both definitions, and by coordinate. In pixels, or in metres at the object.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RootMeanSquare<const D: usize> {
    /// √(Σ(v²)/(D n)): per coordinate.
    pub rms: f64,
    /// √(Σ(v²)/n): radial.
    pub rmse: f64,
    /// Of each coordinate.
    pub axes: [f64; D],
}

impl<const D: usize> RootMeanSquare<D> {
    /// Of differences; NaN without any.
    pub fn of(values: &[[f64; D]]) -> Self {
        let n = values.len() as f64;
        let squares: [f64; D] = std::array::from_fn(|i| values.iter().map(|v| v[i] * v[i]).sum());
        let sum: f64 = squares.iter().sum();
        Self { rms: (sum / (D as f64 * n)).sqrt(), rmse: (sum / n).sqrt(), axes: squares.map(|s| (s / n).sqrt()) }
    }
}

/// One check point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CheckPoint {
    /// observed − predicted, px; NaN where the view does not see the point.
    pub residual: [f64; 2],
    /// Its covariance, px².
    pub covariance: Matrix2<f64>,
    /// From the point to the observed pixel's ray, perpendicular to it, in the world frame and unit.
    pub offset: [f64; 3],
    /// dᵀ C⁻¹ d / 2
    pub statistic: f64,
    /// The probability of a larger one.
    pub p_value: f64,
}

/// All check points.
#[derive(Debug, Clone, PartialEq)]
pub struct CheckReport {
    /// In the order given.
    pub points: Vec<CheckPoint>,
    /// Pixels.
    pub pixels: RootMeanSquare<2>,
    /// At the object, in the world's unit.
    pub object: RootMeanSquare<3>,
    /// The joint test: dᵀ C⁻¹ d / (2 n) and the probability of a larger value.
    pub statistic: f64,
    /// See `statistic`.
    pub p_value: f64,
}

/// Judges a view by points that took no part in its estimate. All covariances are scaled by `scale` where the variance
/// factor was estimated with `dof` degrees of freedom; `covariance` is scaled already.
#[allow(clippy::too_many_arguments, reason = "four parallel columns of one table, and what they are judged by")]
pub fn check_points(
    view: &View,
    covariance: Option<&ViewCovariance>,
    xyz: &[[f64; 3]],
    xy: &[[f64; 2]],
    covariance_xyz: &[[[f64; 3]; 3]],
    covariance_xy: &[[[f64; 2]; 2]],
    scale: f64,
    dof: Option<usize>,
) -> Result<CheckReport> {
    let n = xyz.len();
    if xy.len() != n || covariance_xyz.len() != n || covariance_xy.len() != n {
        return Err(Error::invalid(format!("{n} check points with {} pixels", xy.len())));
    }
    let single = Reference::new(2, dof);
    let u = covariance.map_or(0, |c| c.free().len());
    let mut points = Vec::with_capacity(n);
    // dᵀ D⁻¹ d, Jᵀ D⁻¹ d and Jᵀ D⁻¹ J with D the part of the covariance that the points do not share.
    let (mut own, mut right, mut gram, mut seen) = (0.0, DVector::zeros(u), DMatrix::zeros(u, u), 0usize);
    for i in 0..n {
        let Some(j) = view.project_with_jacobian(&xyz[i]) else {
            points.push(CheckPoint {
                residual: [f64::NAN; 2],
                covariance: Matrix2::repeat(f64::NAN),
                offset: [f64::NAN; 3],
                statistic: f64::NAN,
                p_value: f64::NAN,
            });
            continue;
        };
        let mut d = Vector2::new(xy[i][0] - j.xy[0], xy[i][1] - j.xy[1]);
        if view.camera.model() == Model::Equirectangular {
            let width = f64::from(view.camera.width);
            d.x -= (d.x / width).round() * width;
        }
        let j_x = Matrix2x3::from_fn(|a, b| j.d_xyz[a][b]);
        let s_x = Matrix3::from_fn(|a, b| covariance_xyz[i][a][b]);
        let s_xy = Matrix2::from_fn(|a, b| covariance_xy[i][a][b]);
        let noise = (j_x * s_x * j_x.transpose() + s_xy) * scale;
        let shared = covariance.map_or_else(Matrix2::zeros, |c| c.pixel_covariance(view, &j));
        let all = noise + shared;
        let statistic = all.try_inverse().map_or(f64::NAN, |w| 0.5 * d.dot(&(w * d)));
        if let (Some(c), Some(w)) = (covariance, noise.try_inverse()) {
            let mut rows = [[0.0; MAX_FREE]; 2];
            c.free().columns(view, &j, &mut rows);
            let a = DMatrix::from_fn(2, u, |r, k| rows[r][k]);
            let wa = DMatrix::from_fn(2, u, |r, k| w[(r, 0)] * a[(0, k)] + w[(r, 1)] * a[(1, k)]);
            gram += a.transpose() * &wa;
            right += wa.transpose() * DVector::from_column_slice(d.as_slice());
        }
        own += noise.try_inverse().map_or(f64::NAN, |w| d.dot(&(w * d)));
        seen += 1;
        let offset = view.ray(&xy[i]).map_or([f64::NAN; 3], |ray| {
            let arm = Vector3::from(xyz[i]) - view.pose.centre;
            (ray * ray.dot(&arm) - arm).into()
        });
        points.push(CheckPoint {
            residual: d.into(),
            covariance: all,
            offset,
            statistic,
            p_value: single.exceedance(statistic),
        });
    }
    let shared = covariance.map_or(0.0, |c| {
        // In standard deviations, so that pixels and radians do not meet in one elimination.
        let sigma = c.matrix().diagonal().map(|v| if v > 0.0 { v.sqrt() } else { 1.0 });
        let correlation = DMatrix::from_fn(u, u, |a, b| c.matrix()[(a, b)] / (sigma[a] * sigma[b]));
        let right = right.component_mul(&sigma);
        let gram = DMatrix::from_fn(u, u, |a, b| gram[(a, b)] * sigma[a] * sigma[b]);
        let inner = DMatrix::identity(u, u) + &correlation * gram;
        inner.lu().solve(&(correlation * &right)).map_or(f64::NAN, |x| right.dot(&x))
    });
    let statistic = (own - shared) / (2 * seen) as f64;
    let p_value = if seen > 0 { Reference::new(2 * seen, dof).exceedance(statistic) } else { f64::NAN };
    let finite = |v: &[f64]| v.iter().all(|x| x.is_finite());
    let residuals: Vec<[f64; 2]> = points.iter().map(|p| p.residual).filter(|r| finite(r)).collect();
    let offsets: Vec<[f64; 3]> = points.iter().map(|p| p.offset).filter(|r| finite(r)).collect();
    Ok(CheckReport {
        points,
        pixels: RootMeanSquare::of(&residuals),
        object: RootMeanSquare::of(&offsets),
        statistic,
        p_value,
    })
}
