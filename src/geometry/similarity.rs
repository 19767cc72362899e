//! Similarity transformations in the plane and in space: `x_target = s R x_source + t`.

use nalgebra::{DMatrix, SMatrix, SVector};

use crate::error::{Error, Result};

/// Scale, rotation and translation from a source to a target frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Similarity<const D: usize> {
    /// Greater than zero.
    pub scale: f64,
    /// Source to target.
    pub rotation: SMatrix<f64, D, D>,
    /// In the target frame.
    pub translation: SVector<f64, D>,
}

impl<const D: usize> Similarity<D> {
    /// Source to target.
    pub fn apply(&self, p: &[f64; D]) -> [f64; D] {
        let x = self.rotation * SVector::from(*p) * self.scale + self.translation;
        std::array::from_fn(|i| x[i])
    }

    /// Target to source.
    pub fn inverse(&self) -> Self {
        let rotation = self.rotation.transpose();
        let scale = 1.0 / self.scale;
        Self { scale, rotation, translation: -(rotation * self.translation) * scale }
    }

    /// Refuses a matrix that is not a rotation, and a scale that is not positive.
    pub fn new(scale: f64, rotation: SMatrix<f64, D, D>, translation: SVector<f64, D>) -> Result<Self> {
        let departure = (rotation * rotation.transpose() - SMatrix::identity()).amax();
        let determinant = DMatrix::from_fn(D, D, |i, j| rotation[(i, j)]).determinant();
        if departure.is_nan() || departure > 1e-6 || determinant < 0.0 {
            return Err(Error::invalid(format!(
                "the matrix is not a rotation: R Rᵀ differs from the identity by {departure:.3e}, its determinant is \
                 {determinant:.6}"
            )));
        }
        if !(scale.is_finite() && scale > 0.0 && translation.iter().all(|v| v.is_finite())) {
            return Err(Error::invalid(format!(
                "a similarity of scale {scale} and translation {translation:?} is not one"
            )));
        }
        Ok(Self { scale, rotation, translation })
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix2, Vector2, Vector3};

    use super::*;
    use crate::geometry::rotation_exp;

    #[test]
    fn inverse_undoes_apply() {
        let rotation = rotation_exp(&Vector3::new(1.0, -2.0, 0.5));
        let similarity = Similarity::new(2.5, rotation, Vector3::new(10.0, -4.0, 3.0)).unwrap();
        let p = [3.0, -7.0, 0.25];
        let back = similarity.inverse().apply(&similarity.apply(&p));
        assert!((0..3).all(|i| (back[i] - p[i]).abs() < 1e-13));
    }

    #[test]
    fn what_is_no_similarity_is_refused_with_its_number() {
        let message =
            Similarity::new(1.0, Matrix2::new(1.0, 0.0, 0.0, -1.0), Vector2::zeros()).unwrap_err().to_string();
        assert!(message.contains("determinant is -1.0"), "{message}");
        assert!(
            Similarity::new(0.0, Matrix2::identity(), Vector2::zeros()).unwrap_err().to_string().contains("scale 0")
        );
        assert!(Similarity::new(1.0, Matrix2::identity() * 1.1, Vector2::zeros()).is_err());
    }
}
