//! An adjustment with everything that is said about it: rejections, variance factor and components, reliability.

use nalgebra::{DMatrix, SMatrix, SVector};

use super::distributions::{Reference, VarianceTest};
use super::gauss_helmert::{Conditions, Observed, PointFit, Solution};
use super::reliability::{GroupRedundancy, PointReliability, PointTest, TestLevels, group_redundancy, reliability};
use super::snooping::{Rejection, adjust_and_snoop};
use super::variance_components::{VarianceComponents, rescaled, variance_components};
use crate::error::{Error, Result};
use crate::estimation::MAX_FREE;

/// Correlations above this are worth a warning: the two parameters imitate each other.
const HIGH_CORRELATION: f64 = 0.95;

/// How an adjustment is to be judged.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FullOptions {
    /// Levels of the tests, and whether the variance factor is estimated.
    pub levels: TestLevels,
    /// Significance level of the test of the variance factor.
    pub alpha_variance: f64,
    /// Whether blunders are rejected.
    pub snoop: bool,
    /// Whether the two groups' variances are estimated and used.
    pub components: bool,
}

impl Default for FullOptions {
    fn default() -> Self {
        Self {
            levels: TestLevels { alpha: 0.001, power: 0.80, estimated: true },
            alpha_variance: 0.05,
            snoop: true,
            components: false,
        }
    }
}

/// One point of those given.
#[derive(Debug, Clone, PartialEq)]
pub struct PointOutcome<const C: usize, const M: usize> {
    /// Whether it took part to the end.
    pub used: bool,
    /// predicted − observed, at the observed coordinates.
    pub residual: SVector<f64, C>,
    /// Corrections of all its observations; zero for rejected points.
    pub corrections: SVector<f64, M>,
    /// Its tests. Of a rejected point only the test against the final estimate has a meaning.
    pub reliability: PointReliability<C, M>,
}

/// An adjustment and its statistics.
#[derive(Debug, Clone)]
pub struct Adjusted<S, const C: usize, const M: usize> {
    /// The adjustment of the points that were kept.
    pub solution: Solution<S, C, M>,
    /// The parameters' names.
    pub names: Vec<String>,
    /// The factor that all covariances are scaled with: the a posteriori variance factor where it is estimated, else 1.
    pub scale: f64,
    /// Degrees of freedom of `scale` where it is estimated.
    pub scale_dof: Option<usize>,
    /// Of the parameters, scaled.
    pub covariance: DMatrix<f64>,
    /// The test of the variance factor against one; `None` without redundancy.
    pub variance_test: Option<VarianceTest>,
    /// All points given, in their order.
    pub points: Vec<PointOutcome<C, M>>,
    /// What was rejected, in order.
    pub rejected: Vec<Rejection>,
    /// Critical value of the points' statistics; NaN where nothing can be tested.
    pub critical: f64,
    /// λ₀ of the minimal detectable biases; NaN where nothing can be tested.
    pub noncentrality: f64,
    /// Redundancies of the groups.
    pub redundancy: GroupRedundancy,
    /// The variances of the two groups, where asked for; they are applied.
    pub components: Option<VarianceComponents>,
}

impl<S, const C: usize, const M: usize> Adjusted<S, C, M> {
    /// Correlations of the parameters.
    pub fn correlations(&self) -> DMatrix<f64> {
        correlations(&self.covariance)
    }

    /// Pairs of parameters whose correlation is above 0.95.
    pub fn high_correlations(&self) -> Vec<(usize, usize, f64)> {
        let r = self.correlations();
        let u = r.nrows();
        (0..u)
            .flat_map(|i| (0..i).map(move |j| (j, i)))
            .filter(|p| r[*p].abs() > HIGH_CORRELATION)
            .map(|(j, i)| (j, i, r[(j, i)]))
            .collect()
    }
}

/// Covariances over the roots of the diagonal; zero where a parameter is known.
pub fn correlations(covariance: &DMatrix<f64>) -> DMatrix<f64> {
    let u = covariance.nrows();
    DMatrix::from_fn(u, u, |i, j| {
        let product = covariance[(i, i)] * covariance[(j, j)];
        if i == j {
            1.0
        } else if product > 0.0 {
            covariance[(i, j)] / product.sqrt()
        } else {
            0.0
        }
    })
}

/// Adjusts and judges. `places` gives design rows of places whose shift by undetected biases is of interest.
pub fn adjust_fully<Q, const C: usize, const M: usize>(
    conditions: &Q,
    start: &Q::State,
    observed: &[Observed<M>],
    options: &FullOptions,
    places: impl Fn(&Q::State) -> Vec<DMatrix<f64>>,
) -> Result<Adjusted<Q::State, C, M>>
where
    Q: Conditions<C, M>,
{
    let levels = &options.levels;
    for (name, alpha) in [("alpha", levels.alpha), ("alpha_variance", options.alpha_variance)] {
        if !(alpha > 0.0 && alpha < 1.0) {
            return Err(Error::invalid(format!("{name} = {alpha} is no significance level: it is between 0 and 1")));
        }
    }
    let snooped = adjust_and_snoop(conditions, start, observed, options.snoop.then_some(levels))?;
    let mut kept: Vec<Observed<M>> = snooped.used.iter().map(|&i| observed[i]).collect();
    let (mut solution, mut components) = (snooped.solution, None);
    let mut factors = [1.0; 2];
    if options.components {
        let (found, again) = variance_components(conditions, &solution.state, &kept)?;
        factors = found.factors;
        kept = rescaled::<C, M>(&kept, &factors);
        (solution, components) = (again, Some(found));
    }
    let scale_dof = levels.estimated.then_some(solution.dof).filter(|f| *f > 0);
    let scale = scale_dof.and(solution.variance_factor()).unwrap_or(1.0);
    let variance_test = match solution.variance_factor() {
        Some(factor) => Some(VarianceTest::new(factor, solution.dof, options.alpha_variance)?),
        None => None,
    };
    let covariances: Vec<SMatrix<f64, M, M>> = kept.iter().map(|o| o.covariance).collect();
    let judged = reliability(&solution, &covariances, &places(&solution.state), levels, scale)?;
    let redundancy = group_redundancy(&solution, &judged);
    let test = PointTest::new(C, solution.dof, levels)?;
    let noncentrality = match test {
        Some(t) => t.reference.noncentrality(levels.alpha, levels.power)?,
        None => f64::NAN,
    };

    let u = solution.cofactor.nrows();
    let mut points = Vec::with_capacity(observed.len());
    let mut next = snooped.used.iter().zip(judged.into_iter().zip(&solution.points)).peekable();
    for (i, o) in observed.iter().enumerate() {
        let residual =
            conditions.linearise(&solution.state, &o.value, None).map_or(SVector::repeat(f64::NAN), |(f, _)| f);
        if let Some((_, (reliability, fit))) = next.next_if(|(number, _)| **number == i) {
            points.push(PointOutcome { used: true, residual, corrections: fit.corrections, reliability });
        } else {
            let scaled = rescaled::<C, M>(std::slice::from_ref(o), &factors);
            let own = scaled.first().map_or(o.covariance, |s| s.covariance);
            let reliability = of_outsider(conditions, &solution, &o.value, &own, residual, scale, scale_dof, u);
            points.push(PointOutcome { used: false, residual, corrections: SVector::zeros(), reliability });
        }
    }
    Ok(Adjusted {
        names: conditions.names(),
        covariance: &solution.cofactor * scale,
        scale,
        scale_dof,
        variance_test,
        points,
        rejected: snooped.rejected,
        critical: test.map_or(f64::NAN, |t| t.critical),
        noncentrality,
        redundancy,
        components,
        solution,
    })
}

/// A rejected point against the estimate that it has no part in.
#[allow(clippy::too_many_arguments, reason = "the parts of one prediction")]
fn of_outsider<Q, const C: usize, const M: usize>(
    conditions: &Q,
    solution: &Solution<Q::State, C, M>,
    value: &SVector<f64, M>,
    covariance: &SMatrix<f64, M, M>,
    residual: SVector<f64, C>,
    scale: f64,
    scale_dof: Option<usize>,
    u: usize,
) -> PointReliability<C, M>
where
    Q: Conditions<C, M>,
{
    let mut result = PointReliability {
        redundancy: SVector::repeat(f64::NAN),
        statistic: f64::NAN,
        p_value: f64::NAN,
        deleted: residual,
        deleted_covariance: SMatrix::repeat(f64::NAN),
        detectable: f64::NAN,
        direction: SVector::repeat(f64::NAN),
        detectable_observation: SVector::repeat(f64::NAN),
        effect_on_parameters: vec![f64::NAN; u],
        effect_on_places: f64::NAN,
    };
    let mut design = [[0.0; MAX_FREE]; C];
    let Some((_, b)) = conditions.linearise(&solution.state, value, Some(&mut design)) else { return result };
    let cofactor = b * covariance * b.transpose();
    let point = PointFit {
        design,
        by_observations: b,
        cofactor,
        weight: SMatrix::zeros(),
        misclosure: residual,
        corrections: SVector::zeros(),
    };
    result.deleted_covariance = (cofactor + point.prediction_cofactor(&solution.cofactor)) * scale;
    if let Some(inverse) = result.deleted_covariance.try_inverse() {
        result.statistic = residual.dot(&(inverse * residual)) / C as f64;
        result.p_value = Reference::new(C, scale_dof).exceedance(result.statistic);
    }
    result
}
