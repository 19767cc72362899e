//! Levenberg's and Marquardt's iteration on normal equations.
//!
//! Each step solves (N + λ diag N) δ = −g with N = JᵀJ and g = Jᵀv, and is taken when the cost falls. The equations are
//! scaled to a unit diagonal first, so that pixels, radians and metres do not meet. Steps are measured in the observations'
//! sigmas, q² = δᵀ N δ: an iteration has converged when q is far below what the noise leaves uncertain, whatever the
//! units. Sources: D. W. Marquardt 1963; H. B. Nielsen, Damping parameter in Marquardt's method, 1999 (the update of λ).

use super::parameters::MAX_FREE;

/// A vector of parameters, of which the first few count.
pub type Small = [f64; MAX_FREE];

/// The normal equations at a state.
#[derive(Debug, Clone)]
pub struct Normal {
    /// How many parameters there are.
    pub len: usize,
    /// JᵀJ, weighted, row by row; the upper triangle counts.
    pub n: Vec<f64>,
    /// Jᵀv, weighted.
    pub g: Small,
    /// vᵀv, weighted, or the sum of a robust loss.
    pub cost: f64,
}

impl Normal {
    /// Nothing summed yet.
    pub fn zero(len: usize) -> Self {
        Self { len, n: vec![0.0; len * len], g: [0.0; MAX_FREE], cost: 0.0 }
    }

    /// An element of the symmetric JᵀJ.
    pub fn at(&self, i: usize, j: usize) -> f64 {
        self.n[i.min(j) * self.len + i.max(j)]
    }

    /// Adds a weighted design row and its misclosure.
    #[inline(always)]
    pub fn add(&mut self, row: &[f64], v: f64) {
        for ((i, r), sums) in row.iter().enumerate().zip(self.n.chunks_exact_mut(self.len)) {
            self.g[i] += r * v;
            for (sum, other) in sums[i..].iter_mut().zip(&row[i..]) {
                *sum += r * other;
            }
        }
    }

    /// Adds the sums of another part of the observations.
    pub fn absorb(&mut self, other: &Self) {
        self.n.iter_mut().zip(&other.n).for_each(|(a, b)| *a += b);
        self.g.iter_mut().zip(&other.g).for_each(|(a, b)| *a += b);
        self.cost += other.cost;
    }
}

/// A problem that can be linearised at a state.
pub trait LeastSquares {
    /// What is estimated.
    type State: Clone;

    /// The normal equations; `None` where the state has no residuals (a point behind the camera).
    fn normal(&self, state: &Self::State) -> Option<Normal>;

    /// The state after a step; `None` where there is none (a negative focal length).
    fn step(&self, state: &Self::State, delta: &[f64]) -> Option<Self::State>;

    /// The cost that rounding alone may leave.
    fn rounding(&self) -> f64;
}

/// When to stop.
#[derive(Debug, Clone, Copy)]
pub struct Limits {
    /// The largest number of steps, taken or refused.
    pub iterations: usize,
    /// The step, relative to the residuals, below which it has converged.
    pub step: f64,
    /// λ of the first step: small where the start is close.
    pub damping: f64,
}

impl Default for Limits {
    fn default() -> Self {
        Self { iterations: 200, step: 1e-10, damping: 1e-4 }
    }
}

/// Why an iteration stopped.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stop {
    /// The next step would be negligible.
    SmallStep,
    /// The residuals are zero but for rounding.
    ExactFit,
    /// No step reduces the cost any more, and the last ones were tiny.
    Stalled,
    /// The limit of iterations was reached first.
    Iterations,
    /// The normal equations are singular, or no step leads anywhere.
    Failed,
}

impl Stop {
    /// Whether the result may be used.
    pub fn converged(self) -> bool {
        matches!(self, Self::SmallStep | Self::ExactFit | Self::Stalled)
    }

    /// In words.
    pub fn name(self) -> &'static str {
        match self {
            Self::SmallStep => "small step",
            Self::ExactFit => "exact fit",
            Self::Stalled => "stalled at the rounding",
            Self::Iterations => "limit of iterations",
            Self::Failed => "no step possible",
        }
    }
}

/// Where an iteration ended.
#[derive(Debug, Clone)]
pub struct Outcome<S> {
    /// The best state.
    pub state: S,
    /// Its normal equations.
    pub normal: Normal,
    /// Steps tried.
    pub iterations: usize,
    /// Why no more were.
    pub stop: Stop,
}

/// Minimises from a starting state; `None` where the start itself has no residuals.
pub fn minimise<P: LeastSquares>(problem: &P, start: P::State, limits: &Limits) -> Option<Outcome<P::State>> {
    let normal = problem.normal(&start)?;
    let mut at = Outcome { state: start, normal, iterations: 0, stop: Stop::Iterations };
    let floor = problem.rounding();
    let (mut lambda, mut growth) = (limits.damping, 2.0);
    let mut last_q2 = f64::INFINITY;
    let mut doubts = 0;
    while at.iterations < limits.iterations {
        if at.normal.cost <= floor {
            at.stop = Stop::ExactFit;
            return Some(at);
        }
        at.iterations += 1;
        let Some(delta) = damped_step(&at.normal, lambda) else {
            lambda = (lambda * 10.0).max(1e-10);
            if lambda > 1e10 {
                at.stop = Stop::Failed;
                return Some(at);
            }
            continue;
        };
        let q2 = quadratic(&at.normal, &delta);
        let tiny = q2 <= limits.step * limits.step * at.normal.cost + floor * 1e-6;
        // Damping shortens steps, most of all along what is badly determined: a short step counts when it is free.
        if tiny && lambda > 1e-12 && doubts < 4 {
            doubts += 1;
            lambda = 1e-15;
            continue;
        }
        // Rounding of the residuals hides what such a step gains; Newton's steps improve the state all the same.
        let hidden = 1e-14 * at.normal.cost + (floor * at.normal.cost).sqrt() + floor;
        let unjudgeable = q2 <= hidden;
        let len = at.normal.len;
        let predicted = -(0..len).map(|i| delta[i] * at.normal.g[i]).sum::<f64>() - 0.5 * q2;
        let next = problem.step(&at.state, &delta[..len]).and_then(|s| problem.normal(&s).map(|n| (s, n)));
        let accepted = match &next {
            Some((_, n)) => n.cost < at.normal.cost || (unjudgeable && n.cost <= at.normal.cost + hidden),
            None => false,
        };
        if let (true, Some((state, normal))) = (accepted, next) {
            let gain = 0.5 * (at.normal.cost - normal.cost) / predicted.max(f64::MIN_POSITIVE);
            let falling = q2 < last_q2;
            last_q2 = q2;
            (at.state, at.normal) = (state, normal);
            if tiny || (unjudgeable && !falling) {
                at.stop = if tiny { Stop::SmallStep } else { Stop::Stalled };
                return Some(at);
            }
            lambda *= if gain > 0.75 && lambda > 1e-4 {
                0.2
            } else if gain > 0.75 || unjudgeable {
                0.01
            } else {
                (1.0 - (2.0 * gain - 1.0).powi(3)).max(1.0 / 3.0)
            };
            lambda = lambda.max(1e-15);
            growth = 2.0;
        } else {
            if tiny || unjudgeable {
                at.stop = if tiny { Stop::SmallStep } else { Stop::Stalled };
                return Some(at);
            }
            lambda = (lambda * growth).max(1e-7);
            growth *= 2.0;
            if lambda > 1e16 {
                at.stop = Stop::Failed;
                return Some(at);
            }
        }
    }
    Some(at)
}

/// δ of (N + λ diag N) δ = −g, by Cholesky's factors of the matrix with a unit diagonal.
fn damped_step(normal: &Normal, lambda: f64) -> Option<Small> {
    let u = normal.len;
    let mut scale = [0.0; MAX_FREE];
    for i in 0..u {
        scale[i] = 1.0 / normal.at(i, i).sqrt();
        if !scale[i].is_finite() {
            return None;
        }
    }
    let mut l = [[0.0; MAX_FREE]; MAX_FREE];
    let mut y = [0.0; MAX_FREE];
    for i in 0..u {
        for j in 0..=i {
            let known: f64 = (0..j).map(|k| l[i][k] * l[j][k]).sum();
            if i == j {
                let pivot = 1.0 + lambda - known;
                if pivot <= 1e-15 || pivot.is_nan() {
                    return None;
                }
                l[i][i] = pivot.sqrt();
            } else {
                l[i][j] = (normal.at(j, i) * scale[i] * scale[j] - known) / l[j][j];
            }
        }
        let known: f64 = (0..i).map(|k| l[i][k] * y[k]).sum();
        y[i] = (-normal.g[i] * scale[i] - known) / l[i][i];
    }
    let mut delta = [0.0; MAX_FREE];
    for i in (0..u).rev() {
        let known: f64 = (i + 1..u).map(|k| l[k][i] * delta[k]).sum();
        delta[i] = (y[i] - known) / l[i][i];
    }
    for i in 0..u {
        delta[i] *= scale[i];
    }
    delta[..u].iter().all(|d| d.is_finite()).then_some(delta)
}

fn quadratic(normal: &Normal, d: &Small) -> f64 {
    let mut sum = 0.0;
    for i in 0..normal.len {
        sum += normal.at(i, i) * d[i] * d[i];
        for j in i + 1..normal.len {
            sum += 2.0 * normal.at(i, j) * d[i] * d[j];
        }
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Rosenbrock's valley: residuals 10 (y − x²) and 1 − x.
    struct Valley;

    impl LeastSquares for Valley {
        type State = [f64; 2];

        fn normal(&self, s: &[f64; 2]) -> Option<Normal> {
            let v = [10.0 * (s[1] - s[0] * s[0]), 1.0 - s[0]];
            let mut normal = Normal::zero(2);
            normal.add(&[-20.0 * s[0], 10.0], v[0]);
            normal.add(&[-1.0, 0.0], v[1]);
            normal.cost = v[0] * v[0] + v[1] * v[1];
            Some(normal)
        }

        fn step(&self, s: &[f64; 2], d: &[f64]) -> Option<[f64; 2]> {
            Some([s[0] + d[0], s[1] + d[1]])
        }

        fn rounding(&self) -> f64 {
            1e-26
        }
    }

    /// v = (x², x, x)ᵀ + const: a minimum with residuals left.
    struct Rest;

    impl LeastSquares for Rest {
        type State = f64;

        fn normal(&self, x: &f64) -> Option<Normal> {
            if *x > 5.0 {
                return None;
            }
            let mut normal = Normal::zero(1);
            for (v, j) in [(x * x - 2.0, 2.0 * x), (x - 0.5, 1.0), (3.0 * x + 1.0, 3.0)] {
                normal.add(&[j], v);
                normal.cost += v * v;
            }
            Some(normal)
        }

        fn step(&self, x: &f64, d: &[f64]) -> Option<f64> {
            Some(x + d[0])
        }

        fn rounding(&self) -> f64 {
            1e-28
        }
    }

    #[test]
    fn the_valley_is_followed_to_its_end() {
        let end = minimise(&Valley, [-1.2, 1.0], &Limits::default()).unwrap();
        assert!(end.stop.converged() && end.iterations < 60, "{} {:?}", end.iterations, end.stop);
        assert!((end.state[0] - 1.0).abs() < 1e-10 && (end.state[1] - 1.0).abs() < 1e-10);
    }

    #[test]
    fn with_residuals_left_the_gradient_ends_at_zero() {
        let end = minimise(&Rest, 4.0, &Limits::default()).unwrap();
        assert!(end.stop.converged(), "{:?}", end.stop);
        assert!(end.normal.g[0].abs() < 1e-9 * end.normal.at(0, 0).sqrt(), "{}", end.normal.g[0]);
        assert!(minimise(&Rest, 6.0, &Limits::default()).is_none());
    }

    #[test]
    fn a_limit_of_iterations_is_reported_as_such() {
        let end = minimise(&Valley, [-1.2, 1.0], &Limits { iterations: 3, ..Limits::default() }).unwrap();
        assert_eq!((end.stop, end.iterations), (Stop::Iterations, 3));
        assert!(!end.stop.converged());
    }
}
