//! The distributions behind the tests: central and noncentral χ² and F, their quantiles and powers.
//!
//! The noncentral distributions are Poisson mixtures of central ones. Source: N. L. Johnson, S. Kotz and N. Balakrishnan,
//! Continuous Univariate Distributions 2, 1995, ch. 29 and 30; the use in reliability theory: W. Baarda, A testing
//! procedure for use in geodetic networks, 1968.

use statrs::function::beta::checked_beta_reg;
use statrs::function::gamma::{checked_gamma_lr, checked_gamma_ur, ln_gamma};

use crate::error::{Error, Result};

/// What a quadratic form of `dimension` components follows, divided by that dimension.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Reference {
    /// χ² over its degrees of freedom: the variance factor is known.
    ChiSquared {
        /// Components of the tested quantity.
        dimension: f64,
    },
    /// F: the variance factor was estimated with `dof` degrees of freedom.
    Fisher {
        /// Components of the tested quantity.
        dimension: f64,
        /// Degrees of freedom of the estimated variance factor.
        dof: f64,
    },
}

impl Reference {
    /// F where `dof` says that the variance factor was estimated, else χ².
    pub fn new(dimension: usize, dof: Option<usize>) -> Self {
        let dimension = dimension as f64;
        match dof {
            Some(dof) => Self::Fisher { dimension, dof: dof as f64 },
            None => Self::ChiSquared { dimension },
        }
    }

    /// The probability of a larger value.
    pub fn exceedance(&self, value: f64) -> f64 {
        if value.is_nan() {
            return f64::NAN;
        }
        if value <= 0.0 {
            return 1.0;
        }
        if value == f64::INFINITY {
            return 0.0;
        }
        match *self {
            Self::ChiSquared { dimension: d } => {
                checked_gamma_ur(0.5 * d, 0.5 * d * value).unwrap_or(f64::NAN).clamp(0.0, 1.0)
            }
            Self::Fisher { dimension: d, dof } => beta_reg(0.5 * dof, 0.5 * d, dof / (dof + d * value)),
        }
    }

    /// The value that is exceeded with this probability.
    pub fn critical_value(&self, exceedance: f64) -> Result<f64> {
        if !(exceedance > 0.0 && exceedance < 1.0) {
            return Err(Error::invalid(format!(
                "a probability of {exceedance} has no critical value: it is in (0, 1)"
            )));
        }
        root(|x| self.exceedance(x) - exceedance)
    }

    /// The probability of a value above `critical` when the tested quantity is off by noncentrality λ.
    pub fn power(&self, critical: f64, noncentrality: f64) -> f64 {
        let half = 0.5 * noncentrality;
        // Poisson weights beyond twelve standard deviations from their mode are below 1e-15.
        let reach = 12.0 * half.sqrt() + 40.0;
        let first = (half - reach).max(0.0).floor();
        // The central distribution function F at shape a, and what it loses from a to a + 1.
        let (mut a, mut below, mut loss, x, b);
        match *self {
            Self::ChiSquared { dimension: d } => {
                (a, x, b) = (0.5 * d + first, 0.5 * d * critical, None);
                below = checked_gamma_lr(a, x).unwrap_or(f64::NAN);
                loss = (a * x.ln() - x - ln_gamma(a + 1.0)).exp();
            }
            Self::Fisher { dimension: d, dof } => {
                let half_dof = 0.5 * dof;
                (a, x, b) = (0.5 * d + first, d * critical / (d * critical + dof), Some(half_dof));
                below = beta_reg(a, half_dof, x);
                let norm = ln_gamma(a + half_dof) - ln_gamma(a + 1.0) - ln_gamma(half_dof);
                loss = (a * x.ln() + half_dof * (dof / (d * critical + dof)).ln() + norm).exp();
            }
        }
        let mut weight = if half > 0.0 {
            (first * half.ln() - half - ln_gamma(first + 1.0)).exp()
        } else {
            f64::from(u8::from(first == 0.0))
        };
        let (mut j, mut missed) = (first, 0.0);
        while j <= half + reach {
            missed += weight * below;
            below = (below - loss).max(0.0);
            loss *= x * b.map_or(1.0, |b| a + b) / (a + 1.0);
            a += 1.0;
            j += 1.0;
            weight *= half / j;
        }
        (1.0 - missed).clamp(0.0, 1.0)
    }

    /// The noncentrality λ at which a test at level `alpha` finds the error with this power.
    pub fn noncentrality(&self, alpha: f64, power: f64) -> Result<f64> {
        if !(power > alpha && power < 1.0) {
            return Err(Error::invalid(format!("a power of {power} is not between alpha = {alpha} and 1")));
        }
        let critical = self.critical_value(alpha)?;
        root(|lambda| power - self.power(critical, lambda))
    }
}

fn beta_reg(a: f64, b: f64, x: f64) -> f64 {
    checked_beta_reg(a, b, x.clamp(0.0, 1.0)).unwrap_or(f64::NAN).clamp(0.0, 1.0)
}

/// Where a falling function of a positive value crosses zero.
fn root(f: impl Fn(f64) -> f64) -> Result<f64> {
    let (mut low, mut high) = (0.0, 1.0);
    let mut at_high = f(high);
    while at_high > 0.0 {
        (low, high) = (high, high * 2.0);
        if high > 1e300 {
            return Err(Error::invalid("a critical value lies beyond all numbers: there are too few observations"));
        }
        at_high = f(high);
    }
    if at_high.is_nan() {
        return Err(Error::Internal("a probability is not a number".into()));
    }
    for _ in 0..200 {
        let middle = 0.5 * (low + high);
        if high - low <= 1e-15 * high {
            break;
        }
        if f(middle) > 0.0 { low = middle } else { high = middle }
    }
    Ok(0.5 * (low + high))
}

/// The two-sided χ² test of a variance factor: the interval in which s₀² is expected, and where it is found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VarianceTest {
    /// α/2 of the distribution lies below.
    pub lower: f64,
    /// α/2 of the distribution lies above.
    pub upper: f64,
    /// Twice the smaller tail's probability.
    pub p_value: f64,
    /// Whether the factor lies inside.
    pub accepted: bool,
}

impl VarianceTest {
    /// Tests a variance factor against one.
    pub fn new(variance_factor: f64, dof: usize, alpha: f64) -> Result<Self> {
        let reference = Reference::ChiSquared { dimension: dof as f64 };
        let lower = reference.critical_value(1.0 - 0.5 * alpha)?;
        let upper = reference.critical_value(0.5 * alpha)?;
        let above = reference.exceedance(variance_factor);
        let p_value = (2.0 * above.min(1.0 - above)).min(1.0);
        Ok(Self { lower, upper, p_value, accepted: (lower..=upper).contains(&variance_factor) })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn close(a: f64, b: f64, tolerance: f64) {
        assert!((a - b).abs() <= tolerance * b.abs(), "{a} against {b}");
    }

    #[test]
    fn quantiles_are_those_of_the_tables() {
        // Tables of Johnson, Kotz and Balakrishnan, more digits from SciPy 1.17's chi2.isf and f.isf.
        close(Reference::new(2, None).critical_value(0.001).unwrap(), 13.815510557964274 / 2.0, 1e-12);
        close(Reference::new(6, None).critical_value(0.05).unwrap(), 12.591587243743977 / 6.0, 1e-12);
        close(Reference::new(2, Some(18)).critical_value(0.05).unwrap(), 3.5545571456617875, 1e-12);
        close(Reference::new(2, Some(1)).critical_value(0.001).unwrap(), 499999.5, 1e-9);
        close(Reference::new(20_000, None).critical_value(0.025).unwrap(), CHI2_20000_UPPER / 20_000.0, 1e-11);
    }
    const CHI2_20000_UPPER: f64 = 20393.883649999767;

    #[test]
    fn noncentralities_are_those_of_reliability_theory() {
        // Baarda's λ₀ for one component, α = 0.001, power 0.80; the same for two; F from SciPy's ncf.
        close(Reference::new(1, None).noncentrality(0.001, 0.80).unwrap(), LAMBDA_1, 1e-9);
        close(Reference::new(2, None).noncentrality(0.001, 0.80).unwrap(), LAMBDA_2, 1e-9);
        close(Reference::new(2, Some(10)).noncentrality(0.001, 0.80).unwrap(), LAMBDA_F, 1e-7);
    }
    const LAMBDA_1: f64 = 17.07464680518754;
    const LAMBDA_2: f64 = 19.66238560932999;
    const LAMBDA_F: f64 = 42.98422360693762;

    #[test]
    fn power_without_an_error_is_the_level() {
        for reference in [Reference::new(2, None), Reference::new(3, Some(7))] {
            let critical = reference.critical_value(0.01).unwrap();
            close(reference.power(critical, 0.0), 0.01, 1e-9);
            close(reference.exceedance(critical), 0.01, 1e-9);
        }
    }

    #[test]
    fn the_test_of_a_variance_factor_is_two_sided() {
        let test = VarianceTest::new(1.0, 18, 0.05).unwrap();
        assert!(test.accepted && test.p_value > 0.8);
        close(test.lower * 18.0, 8.230746194756652, 1e-10);
        close(test.upper * 18.0, 31.526378440386633, 1e-10);
        assert!(!VarianceTest::new(2.0, 18, 0.05).unwrap().accepted);
        assert!(!VarianceTest::new(0.2, 18, 0.05).unwrap().accepted);
    }
}
