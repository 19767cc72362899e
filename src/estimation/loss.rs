//! Robust losses: how much a large residual may pull.
//!
//! A residual is the length r of a point's weighted misclosure (both coordinates together, in sigmas). The tuning
//! constants give 95 % efficiency for two-dimensional normal errors; the usual ones (1.345, 2.385, 4.685) are for one
//! dimension. Source of the losses: P. J. Huber and E. M. Ronchetti, Robust Statistics, 2nd ed.

use crate::error::{Error, Result};

/// A loss ρ(r²); its derivative by r² is the weight.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Loss {
    /// Least squares.
    #[default]
    Squares,
    /// Quadratic, then linear.
    Huber,
    /// Logarithmic: far points still pull a little.
    Cauchy,
    /// Bounded: far points do not pull at all.
    Tukey,
}

impl Loss {
    /// The loss of this name.
    pub fn from_name(name: &str) -> Result<Self> {
        Ok(match name {
            "squares" => Self::Squares,
            "huber" => Self::Huber,
            "cauchy" => Self::Cauchy,
            "tukey" => Self::Tukey,
            _ => return Err(Error::invalid(format!("there is no loss {name:?}: squares, huber, cauchy or tukey"))),
        })
    }

    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Squares => "squares",
            Self::Huber => "huber",
            Self::Cauchy => "cauchy",
            Self::Tukey => "tukey",
        }
    }

    /// The tuning constant, sigmas.
    pub fn constant(self) -> f64 {
        match self {
            Self::Squares => f64::INFINITY,
            Self::Huber => 1.501,
            Self::Cauchy => 2.549,
            Self::Tukey => 5.123,
        }
    }

    /// (ρ, dρ/ds) at s = r².
    #[inline]
    pub fn at(self, s: f64) -> (f64, f64) {
        let c = self.constant();
        match self {
            Self::Squares => (s, 1.0),
            Self::Huber => {
                if s <= c * c {
                    (s, 1.0)
                } else {
                    let r = s.sqrt();
                    (2.0 * c * r - c * c, c / r)
                }
            }
            Self::Cauchy => {
                let t = s / (c * c);
                (c * c * t.ln_1p(), 1.0 / (1.0 + t))
            }
            Self::Tukey => {
                let t = 1.0 - s / (c * c);
                if t > 0.0 { (c * c / 3.0 * (1.0 - t * t * t), t * t) } else { (c * c / 3.0, 0.0) }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_are_the_derivatives_of_the_losses() {
        for loss in [Loss::Squares, Loss::Huber, Loss::Cauchy, Loss::Tukey] {
            assert_eq!(Loss::from_name(loss.name()).unwrap(), loss);
            for s in [0.01, 0.5, 2.0, 3.0, 10.0, 20.0, 30.0, 100.0] {
                let h = 1e-5 * s;
                let numeric = (loss.at(s + h).0 - loss.at(s - h).0) / (2.0 * h);
                assert!((loss.at(s).1 - numeric).abs() < 1e-7, "{loss:?} {s}");
            }
            let small = loss.at(1e-8);
            assert!((small.0 / 1e-8 - 1.0).abs() < 1e-6 && (small.1 - 1.0).abs() < 1e-6);
        }
    }
}
