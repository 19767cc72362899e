//! How well the points control each other: redundancy numbers, tests, minimal detectable biases and what they would do.
//!
//! With the misclosure w of a point, its weight W⁻¹ and its prediction's cofactor A Q Aᵀ:
//! ```text
//! Q_w = W − A Q Aᵀ                 cofactor of the misclosure
//! S   = W⁻¹ Q_w W⁻¹                 information about a bias ∇ of the point
//! R   = Σ Bᵀ W⁻¹ Q_w W⁻¹ B          its diagonal: redundancy numbers, their sum is the redundancy
//! T   = wᵀ Q_w⁻¹ w                  χ² with C degrees of freedom when the point has no bias (mean-shift model)
//! w₍ᵢ₎ = W Q_w⁻¹ w                  the misclosure against an estimate without this point
//! ∇ᵀ S ∇ = λ₀                      minimal detectable biases: an ellipse
//! ∇x  = Q Aᵀ W⁻¹ ∇                  what an undetected one does to the parameters
//! ```
//! Where the variance factor is estimated, the estimate without the point is what T is measured with, so that
//! `(T / C) / ((Ω − T) / (f − C))` follows F exactly: the point's own error does not hide it.
//!
//! Sources: W. Baarda 1968; A. J. Pope, The statistics of residuals and the detection of outliers, 1976; Förstner and
//! Wrobel 2016, ch. 4.6; R. D. Cook, Detection of influential observation in linear regression, 1977.

use nalgebra::{DMatrix, SMatrix, SVector};
use rayon::prelude::*;

use super::distributions::Reference;
use super::gauss_helmert::{Design, PointFit, Solution};
use crate::error::Result;

/// Below this share of its misclosure a point is not controlled by the others.
const UNCONTROLLED: f64 = 1e-9;
/// An estimated variance factor below this is rounding: data without noise must not be tested by it.
const ROUNDING_VARIANCE: f64 = 1e-12;

/// What the tests are made with.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TestLevels {
    /// Significance level of each single test.
    pub alpha: f64,
    /// Power at which a bias counts as detectable.
    pub power: f64,
    /// Whether the variance factor is estimated (F) or taken as one (χ²).
    pub estimated: bool,
}

/// The test of one point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PointTest {
    /// The distribution of T / C.
    pub reference: Reference,
    /// T / C above this is a rejection.
    pub critical: f64,
}

impl PointTest {
    /// For points of `c` conditions in an adjustment of `dof` degrees of freedom; `None` where nothing can be tested.
    pub fn new(c: usize, dof: usize, levels: &TestLevels) -> Result<Option<Self>> {
        if levels.estimated && dof <= c {
            return Ok(None);
        }
        let reference = Reference::new(c, levels.estimated.then(|| dof - c));
        Ok(Some(Self { reference, critical: reference.critical_value(levels.alpha)? }))
    }
}

/// The reliability of one point. NaN where the other points do not control it.
#[derive(Debug, Clone, PartialEq)]
pub struct PointReliability<const C: usize, const M: usize> {
    /// Redundancy numbers of its observations; with correlated observations only their sums have a meaning.
    pub redundancy: SVector<f64, M>,
    /// What is tested: T / C, over the variance factor without this point where that is estimated.
    pub statistic: f64,
    /// The probability of a larger statistic without a bias.
    pub p_value: f64,
    /// predicted − observed, against the estimate without this point.
    pub deleted: SVector<f64, C>,
    /// Its covariance, scaled by the variance factor in use.
    pub deleted_covariance: SMatrix<f64, C, C>,
    /// The minimal detectable bias of the condition in its worst direction.
    pub detectable: f64,
    /// That direction, a unit vector.
    pub direction: SVector<f64, C>,
    /// The minimal detectable bias of each observation alone; infinite where none would be found.
    pub detectable_observation: SVector<f64, M>,
    /// The largest change of each parameter by an undetected bias of the point.
    pub effect_on_parameters: Vec<f64>,
    /// The largest shift, at any of the places asked for, by an undetected bias of the point.
    pub effect_on_places: f64,
}

/// T and Q_w⁻¹ of a point, or `None` where it is not controlled.
pub(super) fn mean_shift<const C: usize, const M: usize>(
    point: &PointFit<C, M>,
    q: &DMatrix<f64>,
) -> Option<(f64, SMatrix<f64, C, C>)> {
    let prediction = point.prediction_cofactor(q);
    let q_w = point.cofactor - prediction;
    // W⁻¹ Q_w has the eigenvalues of the point's redundancy: all must be away from zero.
    let share = point.weight * q_w;
    let inverse = q_w.try_inverse()?;
    let smallest = 1.0 / (inverse * point.cofactor).norm();
    if share.trace() <= 0.0 || smallest < UNCONTROLLED || smallest.is_nan() {
        return None;
    }
    Some((point.misclosure.dot(&(inverse * point.misclosure)).max(0.0), inverse))
}

/// The tested statistic of one T.
pub(super) fn statistic(t: f64, c: usize, omega: f64, dof: usize, levels: &TestLevels) -> f64 {
    let t = t / c as f64;
    if !levels.estimated {
        t
    } else if dof > c {
        let rest = (omega - t * c as f64) / (dof - c) as f64;
        t / rest.max(ROUNDING_VARIANCE)
    } else {
        f64::NAN
    }
}

/// Tests and reliability of every point. `places` holds design rows of places (pixels over the photo, say) whose shift is
/// asked for, C rows each; `scale` is the variance factor in use.
pub fn reliability<S: Sync, const C: usize, const M: usize>(
    solution: &Solution<S, C, M>,
    covariances: &[SMatrix<f64, M, M>],
    places: &[DMatrix<f64>],
    levels: &TestLevels,
    scale: f64,
) -> Result<Vec<PointReliability<C, M>>> {
    let test = match PointTest::new(C, solution.dof, levels)? {
        Some(t) => Some((t, t.reference.noncentrality(levels.alpha, levels.power)?)),
        None => None,
    };
    // By rows: every point meets every place.
    let places: Vec<Design<C>> = places.iter().map(by_rows).collect();
    let one = |(point, covariance): (&PointFit<C, M>, &SMatrix<f64, M, M>)| {
        of_point(solution, point, covariance, &places, levels, test.as_ref(), scale)
    };
    Ok(solution.points.par_iter().zip(covariances).with_min_len(64).map(one).collect())
}

fn of_point<S, const C: usize, const M: usize>(
    solution: &Solution<S, C, M>,
    point: &PointFit<C, M>,
    covariance: &SMatrix<f64, M, M>,
    places: &[Design<C>],
    levels: &TestLevels,
    test: Option<&(PointTest, f64)>,
    scale: f64,
) -> PointReliability<C, M> {
    let q = &solution.cofactor;
    let u = q.nrows();
    let information = point.weight * (point.cofactor - point.prediction_cofactor(q)) * point.weight;
    let b = &point.by_observations;
    let redundancy = (covariance * b.transpose() * information * b).diagonal();
    let mut result = PointReliability {
        redundancy,
        statistic: f64::NAN,
        p_value: f64::NAN,
        deleted: SVector::repeat(f64::NAN),
        deleted_covariance: SMatrix::repeat(f64::NAN),
        detectable: f64::INFINITY,
        direction: SVector::repeat(f64::NAN),
        detectable_observation: SVector::repeat(f64::INFINITY),
        effect_on_parameters: vec![f64::INFINITY; u],
        effect_on_places: f64::INFINITY,
    };
    let Some((t, inverse)) = mean_shift(point, q) else { return result };
    let by_rest = point.cofactor * inverse;
    result.deleted = by_rest * point.misclosure;
    result.deleted_covariance = by_rest * point.cofactor * scale;
    let Some((test, noncentrality)) = test else { return result };
    result.statistic = statistic(t, C, solution.omega, solution.dof, levels);
    result.p_value = test.reference.exceedance(result.statistic);

    // Every bias on the ellipse ∇ᵀ S ∇ = λ₀ is √λ₀ times `half` times a unit vector.
    let size = (noncentrality * scale).sqrt();
    let eigen = DMatrix::from_fn(C, C, |i, j| 0.5 * (information[(i, j)] + information[(j, i)])).symmetric_eigen();
    let weakest = eigen.eigenvalues.imin();
    result.detectable = size / eigen.eigenvalues[weakest].max(0.0).sqrt();
    result.direction = SVector::from_fn(|i, _| eigen.eigenvectors[(i, weakest)]);
    let information_l = b.transpose() * information * b;
    result.detectable_observation = information_l.diagonal().map(|s| size / s.max(0.0).sqrt());
    let half = SMatrix::<f64, C, C>::from_fn(|i, k| eigen.eigenvectors[(i, k)] / eigen.eigenvalues[k].max(0.0).sqrt());
    let weighted = point.weight * half;
    let to_parameters = q * DMatrix::from_fn(u, C, |k, j| (0..C).map(|i| point.design[i][k] * weighted[(i, j)]).sum());
    result.effect_on_parameters = (0..u).map(|k| size * to_parameters.row(k).norm()).collect();
    let to_parameters: Design<C> = by_rows(&to_parameters.transpose());
    let stretch = places.iter().map(|rows| largest_stretch(rows, &to_parameters, u)).fold(0.0, f64::max);
    result.effect_on_places = size * stretch;
    result
}

fn by_rows<const C: usize>(rows: &DMatrix<f64>) -> Design<C> {
    std::array::from_fn(|i| std::array::from_fn(|k| rows.get((i, k)).copied().unwrap_or(0.0)))
}

/// The largest singular value of `rows · mapᵀ`, of `u` columns each.
fn largest_stretch<const C: usize>(rows: &Design<C>, map: &Design<C>, u: usize) -> f64 {
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let m = SMatrix::<f64, C, C>::from_fn(|i, j| dot(&rows[i][..u], &map[j][..u]));
    let gram = m.transpose() * m;
    if C == 2 {
        let (a, b, d) = (gram[(0, 0)], gram[(0, 1)], gram[(1, 1)]);
        return (0.5 * (a + d) + (0.25 * (a - d).powi(2) + b * b).sqrt()).max(0.0).sqrt();
    }
    DMatrix::from_fn(C, C, |i, j| gram[(i, j)]).symmetric_eigenvalues().max().max(0.0).sqrt()
}

/// Redundancy of the predicted observations (photo, or target frame), of the others (object, or source frame), and of
/// the priors. Their sum is the redundancy minus the number of constraints.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GroupRedundancy {
    /// The first C observations of all points.
    pub predicted: f64,
    /// The other observations of all points.
    pub given: f64,
    /// The priors.
    pub priors: f64,
}

/// Sums of the redundancy numbers.
pub fn group_redundancy<S, const C: usize, const M: usize>(
    solution: &Solution<S, C, M>,
    points: &[PointReliability<C, M>],
) -> GroupRedundancy {
    let sum = |places: std::ops::Range<usize>| -> f64 {
        points.iter().map(|p| places.clone().map(|i| p.redundancy[i]).sum::<f64>()).sum()
    };
    GroupRedundancy { predicted: sum(0..C), given: sum(C..M), priors: solution.prior_redundancy }
}
