//! Gauss–Helmert adjustment: conditions between observations and parameters, both of which are uncertain.
//!
//! ```text
//! minimise   Σᵢ vᵢᵀ Σᵢ⁻¹ vᵢ + r(x)ᵀ P r(x)
//! subject to fᵢ(lᵢ + vᵢ, x) = 0   (the conditions of point i)   and   c(x) = 0
//! ```
//! Each point's observations l (covariance Σ, possibly singular) are independent of the other points'. For given
//! parameters every point is first moved onto its condition: v ← −Σ Bᵀ W⁻¹ w with B = ∂f/∂l *at the adjusted
//! observations*, the proper misclosure w = f(l + v) − B v, and W = B Σ Bᵀ. What is left is a problem in the parameters
//! alone, with normal matrix Σ Aᵀ W⁻¹ A, gradient Σ Aᵀ W⁻¹ w and objective Σ wᵀ W⁻¹ w: point by point, so that the
//! time is linear in the points. It is solved by damped Gauss–Newton steps inside the constraints' tangent space.
//!
//! Linearising at the given instead of the adjusted observations biases the estimate. Sources: A. J. Pope, Some pitfalls
//! to be avoided in the iterative adjustment of nonlinear problems, 1972; W. Förstner and B. P. Wrobel, Photogrammetric
//! Computer Vision, 2016, ch. 4.8.
//!
//! Assumes independent points and errors small enough for first-order covariances.

use nalgebra::{DMatrix, DVector, SMatrix, SVector};
use rayon::prelude::*;

use super::normal_equations::{NormalEquations, Reduced, SINGULAR, TOO_WEAK};
use crate::error::{Error, Result};
use crate::estimation::MAX_FREE;

/// Steps before the iteration is given up.
const MAX_ITERATIONS: usize = 100;
/// The iteration ends when a step changes the parameters by less than this, in units of their standard deviations.
const STEP_TOLERANCE: f64 = 1e-9;
/// Below this a step may also end the iteration by no longer getting smaller: rounding is all that is left.
const ROUNDING_STEP: f64 = 1e-5;
/// Steps that move one point onto its condition.
const MAX_PROJECTIONS: usize = 30;
/// Points per task. Partial sums are added in the points' order, so that the threads' number changes no bit.
const BLOCK: usize = 256;

/// Rows ∂f/∂x of one point; only the first places, as many as there are parameters, are used.
pub type Design<const C: usize> = [[f64; MAX_FREE]; C];

/// f and ∂f/∂l of one point.
pub type Linearised<const C: usize, const M: usize> = (SVector<f64, C>, SMatrix<f64, C, M>);

/// Residuals of the parameters themselves, r(x): a priori knowledge with its weight.
#[derive(Debug, Clone)]
pub struct Priors {
    /// r(x)
    pub residual: DVector<f64>,
    /// ∂r/∂x
    pub jacobian: DMatrix<f64>,
    /// P, the inverse of the a priori covariance.
    pub weight: DMatrix<f64>,
}

/// Equations that the parameters obey exactly, c(x) = 0.
#[derive(Debug, Clone)]
pub struct Constraints {
    /// c(x)
    pub value: DVector<f64>,
    /// ∂c/∂x
    pub jacobian: DMatrix<f64>,
}

/// C conditions on M observations for each point. By convention the first C observations are those that the condition
/// predicts (`f = predicted − observed`): photo coordinates, or the target frame's.
pub trait Conditions<const C: usize, const M: usize>: Sync {
    /// The parameters as the model keeps them.
    type State: Clone + Send + Sync;

    /// The parameters' names, in order.
    fn names(&self) -> Vec<String>;

    /// The condition and its derivatives at these (adjusted) observations; `None` where there is none, as behind a
    /// camera.
    fn linearise(
        &self,
        state: &Self::State,
        l: &SVector<f64, M>,
        design: Option<&mut Design<C>>,
    ) -> Option<Linearised<C, M>>;

    /// The state after `delta` was added to the parameters.
    fn apply(&self, state: &Self::State, delta: &[f64]) -> Result<Self::State>;

    /// A priori knowledge of the parameters.
    fn priors(&self, _state: &Self::State) -> Option<Priors> {
        None
    }

    /// Equations between the parameters.
    fn constraints(&self, _state: &Self::State) -> Option<Constraints> {
        None
    }
}

/// The observations of one point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Observed<const M: usize> {
    /// l
    pub value: SVector<f64, M>,
    /// Σ, a priori.
    pub covariance: SMatrix<f64, M, M>,
}

/// One point after the adjustment, everything at the adjusted observations.
#[derive(Debug, Clone, Copy)]
pub struct PointFit<const C: usize, const M: usize> {
    /// A = ∂f/∂x
    pub design: Design<C>,
    /// B = ∂f/∂l
    pub by_observations: SMatrix<f64, C, M>,
    /// W = B Σ Bᵀ
    pub cofactor: SMatrix<f64, C, C>,
    /// W⁻¹
    pub weight: SMatrix<f64, C, C>,
    /// w = −B v
    pub misclosure: SVector<f64, C>,
    /// v, so that l + v fulfils the condition.
    pub corrections: SVector<f64, M>,
}

impl<const C: usize, const M: usize> PointFit<C, M> {
    /// A as a matrix of `u` columns.
    pub fn design_matrix(&self, u: usize) -> DMatrix<f64> {
        DMatrix::from_fn(C, u, |i, k| self.design[i][k])
    }

    /// A Q Aᵀ: the cofactor matrix of the prediction.
    pub fn prediction_cofactor(&self, q: &DMatrix<f64>) -> SMatrix<f64, C, C> {
        let u = q.nrows();
        let mut aq = [[0.0; MAX_FREE]; C];
        for (row, a) in aq.iter_mut().zip(&self.design) {
            for k in 0..u {
                row[k] = (0..u).map(|m| a[m] * q[(m, k)]).sum();
            }
        }
        SMatrix::from_fn(|i, j| (0..u).map(|k| aq[i][k] * self.design[j][k]).sum())
    }

    /// wᵀ W⁻¹ w
    pub fn omega(&self) -> f64 {
        self.misclosure.dot(&(self.weight * self.misclosure))
    }
}

/// An adjustment's outcome. Cofactors are covariances for an a priori variance factor of one.
#[derive(Debug, Clone)]
pub struct Solution<S, const C: usize, const M: usize> {
    /// The estimate.
    pub state: S,
    /// One for each point.
    pub points: Vec<PointFit<C, M>>,
    /// Q of the parameters; singular in the directions that constraints hold.
    pub cofactor: DMatrix<f64>,
    /// The weighted sum of squared corrections, priors included.
    pub omega: f64,
    /// Conditions + priors + constraints − parameters.
    pub dof: usize,
    /// Redundancy of the priors together.
    pub prior_redundancy: f64,
    /// Steps taken.
    pub iterations: usize,
    /// The smallest eigenvalue of the normal matrix scaled to a unit diagonal: the sign of weak determination.
    pub smallest_eigenvalue: f64,
}

impl<S, const C: usize, const M: usize> Solution<S, C, M> {
    /// The a posteriori variance factor; `None` without redundancy.
    pub fn variance_factor(&self) -> Option<f64> {
        (self.dof > 0).then(|| self.omega / self.dof as f64)
    }
}

/// Moves one point onto its condition at `state`.
fn fit_point<Q, const C: usize, const M: usize>(
    conditions: &Q,
    state: &Q::State,
    observed: &Observed<M>,
) -> Option<PointFit<C, M>>
where
    Q: Conditions<C, M>,
{
    let mut v = SVector::<f64, M>::zeros();
    let mut design = [[0.0; MAX_FREE]; C];
    let mut round = 0;
    loop {
        let (f, b) = conditions.linearise(state, &(observed.value + v), None)?;
        let misclosure = f - b * v;
        let spread = observed.covariance * b.transpose();
        let cofactor = b * spread;
        let weight = cofactor.try_inverse().filter(|w| w.iter().all(|x| x.is_finite()))?;
        round += 1;
        // f is what the last correction left open: 1e-9 standard deviations are below the parameters' own rounding.
        if f.dot(&(weight * f)) < 1e-18 || round == MAX_PROJECTIONS {
            conditions.linearise(state, &(observed.value + v), Some(&mut design))?;
            return Some(PointFit { design, by_observations: b, cofactor, weight, misclosure, corrections: v });
        }
        v = -(spread * (weight * misclosure));
        if !v.iter().all(|x| x.is_finite()) {
            return None;
        }
    }
}

/// Sums over the points at one state, or the number of the point that has no condition there.
fn evaluate<Q, const C: usize, const M: usize>(
    conditions: &Q,
    state: &Q::State,
    observed: &[Observed<M>],
    u: usize,
) -> std::result::Result<NormalEquations, usize>
where
    Q: Conditions<C, M>,
{
    let block = |(first, points): (usize, &[Observed<M>])| {
        let mut sum = NormalEquations::zeros(u);
        for (i, point) in points.iter().enumerate() {
            let fit = fit_point::<Q, C, M>(conditions, state, point).ok_or(first + i)?;
            sum.add_point(&fit);
        }
        Ok(sum)
    };
    let partial: Vec<std::result::Result<NormalEquations, usize>> = if observed.len() <= BLOCK {
        vec![block((0, observed))]
    } else {
        observed.par_chunks(BLOCK).enumerate().map(|(i, points)| block((i * BLOCK, points))).collect()
    };
    let mut total = NormalEquations::zeros(u);
    for sum in partial {
        total.add(&sum?);
    }
    total.mirror();
    if let Some(priors) = conditions.priors(state) {
        total.add_priors(&priors);
    }
    Ok(total)
}

/// Moves the state onto its constraints.
fn onto_constraints<Q, const C: usize, const M: usize>(
    conditions: &Q,
    mut state: Q::State,
    scale: &DVector<f64>,
) -> Result<Q::State>
where
    Q: Conditions<C, M>,
{
    let mut last = f64::INFINITY;
    for _ in 0..50 {
        let Some(c) = conditions.constraints(&state) else { return Ok(state) };
        let (step, size) = Reduced::constraint_step(&c, scale)?;
        if size == 0.0 || (size < 1e-9 && size >= 0.5 * last) {
            return Ok(state);
        }
        last = size;
        state = conditions.apply(&state, step.as_slice())?;
    }
    Err(Error::NotConverged {
        what: "fulfilling the constraints",
        iterations: 50,
        detail: format!("{last:.3e} is left"),
    })
}

/// Adjusts from a starting state. The observations are taken as they are: rejecting some is the caller's.
pub fn adjust<Q, const C: usize, const M: usize>(
    conditions: &Q,
    start: &Q::State,
    observed: &[Observed<M>],
) -> Result<Solution<Q::State, C, M>>
where
    Q: Conditions<C, M>,
{
    let names = conditions.names();
    let u = names.len();
    check::<C, M>(observed, u)?;
    let at_start = |i: usize| {
        Error::invalid(format!(
            "point {} has no place in the model at the starting values (behind the camera, or without any \
             uncertainty): give better starting values or sigmas",
            i + 1
        ))
    };
    let first = evaluate::<Q, C, M>(conditions, start, observed, u).map_err(at_start)?;
    let mut state = onto_constraints(conditions, start.clone(), &first.scale())?;
    let mut normal = evaluate::<Q, C, M>(conditions, &state, observed, u).map_err(at_start)?;

    let mut damping = 0.0;
    let mut last_step = f64::INFINITY;
    for iteration in 1..=MAX_ITERATIONS {
        let scale = normal.scale();
        let reduced = Reduced::new(&normal, conditions.constraints(&state).as_ref())?;
        let step = reduced.solve(&normal, damping);
        let size = normal.length(&step) / (u as f64).sqrt();
        let done = damping < 1e-6 && (size < STEP_TOLERANCE || (size < ROUNDING_STEP && size >= 0.5 * last_step));
        let trial = conditions
            .apply(&state, step.as_slice())
            .and_then(|s| onto_constraints(conditions, s, &scale))
            .ok()
            .and_then(|s| evaluate::<Q, C, M>(conditions, &s, observed, u).ok().map(|n| (s, n)));
        // Near the end the objective moves less than its own rounding; the step decides there.
        let better = trial.as_ref().is_some_and(|(_, n)| n.objective <= normal.objective || size < ROUNDING_STEP);
        if let (true, Some((s, n))) = (better, trial) {
            (state, normal) = (s, n);
            damping = if damping > 1e-7 { damping * 0.1 } else { 0.0 };
            last_step = size;
            if done {
                return finish(conditions, state, observed, &normal, &names, iteration);
            }
        } else {
            damping = if damping == 0.0 { 1e-4 } else { damping * 10.0 };
            if damping > 1e12 {
                break;
            }
        }
    }
    // A problem without a determined answer does not converge either; that is the better thing to say.
    let reduced = Reduced::new(&normal, conditions.constraints(&state).as_ref())?;
    reduced.refuse_singular(&names, TOO_WEAK)?;
    Err(Error::NotConverged {
        what: "the adjustment",
        iterations: MAX_ITERATIONS,
        detail: format!(
            "the last step was {last_step:.3e} standard deviations, the residuals are {:.3e} times their sigmas; look \
             for blunders or give better starting values",
            (normal.objective / (C * observed.len()).max(1) as f64).sqrt()
        ),
    })
}

fn check<const C: usize, const M: usize>(observed: &[Observed<M>], u: usize) -> Result<()> {
    if u > MAX_FREE {
        return Err(Error::Internal(format!("{u} parameters, {MAX_FREE} have room")));
    }
    for (i, o) in observed.iter().enumerate() {
        if !o.value.iter().chain(o.covariance.iter()).all(|x| x.is_finite()) {
            return Err(Error::invalid(format!("point {} holds values that are not finite", i + 1)));
        }
        let asymmetry = (o.covariance - o.covariance.transpose()).amax();
        let size = o.covariance.amax();
        let smallest = smallest_eigenvalue(&o.covariance);
        if asymmetry > 1e-9 * size || smallest < -1e-9 * size {
            return Err(Error::invalid(format!(
                "the covariance of point {} is not one: its smallest eigenvalue is {smallest:.3e}, its largest element \
                 {size:.3e}, it departs from symmetry by {asymmetry:.3e}",
                i + 1
            )));
        }
    }
    Ok(())
}

fn smallest_eigenvalue<const M: usize>(s: &SMatrix<f64, M, M>) -> f64 {
    let is_diagonal = (0..M).all(|i| (0..M).all(|j| i == j || s[(i, j)] == 0.0));
    if is_diagonal {
        return s.diagonal().min();
    }
    DMatrix::from_fn(M, M, |i, j| 0.5 * (s[(i, j)] + s[(j, i)])).symmetric_eigenvalues().min()
}

fn finish<Q, const C: usize, const M: usize>(
    conditions: &Q,
    state: Q::State,
    observed: &[Observed<M>],
    normal: &NormalEquations,
    names: &[String],
    iterations: usize,
) -> Result<Solution<Q::State, C, M>>
where
    Q: Conditions<C, M>,
{
    let constraints = conditions.constraints(&state);
    let priors = conditions.priors(&state);
    let held = constraints.as_ref().map_or(0, |c| c.value.len());
    let known = priors.as_ref().map_or(0, |p| p.residual.len());
    let equations = C * observed.len() + known + held;
    if equations < names.len() {
        return Err(Error::Degenerate {
            what: format!("{} points do not determine {} parameters", observed.len(), names.len()),
            quantity: "the number of equations",
            value: equations as f64,
            limit: names.len() as f64,
            remedy: "give more points, or free fewer parameters",
        });
    }
    let reduced = Reduced::new(normal, constraints.as_ref())?;
    reduced.refuse_singular(names, SINGULAR)?;
    let cofactor = reduced.inverse();
    let prior_redundancy = priors
        .as_ref()
        .map_or(0.0, |p| known as f64 - (&p.jacobian * &cofactor * p.jacobian.transpose() * &p.weight).trace());
    let points: Option<Vec<PointFit<C, M>>> = if observed.len() <= BLOCK {
        observed.iter().map(|o| fit_point(conditions, &state, o)).collect()
    } else {
        observed.par_iter().with_min_len(BLOCK).map(|o| fit_point(conditions, &state, o)).collect()
    };
    let points = points.ok_or_else(|| Error::Internal("a point left its condition after convergence".into()))?;
    Ok(Solution {
        state,
        points,
        cofactor,
        omega: normal.objective,
        dof: equations - names.len(),
        prior_redundancy,
        iterations,
        smallest_eigenvalue: reduced.smallest_eigenvalue(),
    })
}
