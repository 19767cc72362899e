//! Exterior orientation, and small rotations.

use nalgebra::{Matrix3, Vector3};

use crate::error::{Error, Result};

/// `t_camera_world`: where the camera stands and how it is turned.
///
/// Kept as rotation and projection centre, and applied as `R (X − C)`: the difference is formed first, so that
/// coordinates with seven digits before the point lose nothing.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pose {
    /// World to camera.
    pub rotation: Matrix3<f64>,
    /// Projection centre in the world frame.
    pub centre: Vector3<f64>,
}

impl Pose {
    /// The pose at the world's origin, looking along +z.
    pub fn identity() -> Self {
        Self { rotation: Matrix3::identity(), centre: Vector3::zeros() }
    }

    /// From `x_cam = R X + t`. The centre solves `R C = −t`, so that a rotation with few digits keeps its meaning.
    pub fn from_rotation_translation(rotation: Matrix3<f64>, translation: Vector3<f64>) -> Result<Self> {
        if !rotation.iter().chain(translation.iter()).all(|v| v.is_finite()) {
            return Err(Error::invalid("the pose holds values that are not finite"));
        }
        let departure = (rotation * rotation.transpose() - Matrix3::identity()).amax();
        if departure > 1e-6 || rotation.determinant() < 0.0 {
            return Err(Error::invalid(format!(
                "the rotation matrix is not a rotation: R Rᵀ differs from the identity by {departure:.3e}, its \
                 determinant is {:.6}",
                rotation.determinant()
            )));
        }
        let inverse = rotation.try_inverse().ok_or_else(|| Error::invalid("the rotation matrix is singular"))?;
        let centre = -(inverse * translation);
        // One step of refinement removes the rounding of the inverse.
        let centre = centre - inverse * (rotation * centre + translation);
        Ok(Self { rotation, centre })
    }

    /// `t` of `x_cam = R X + t`.
    pub fn translation(&self) -> Vector3<f64> {
        -(self.rotation * self.centre)
    }

    /// World to camera.
    #[inline(always)]
    pub fn transform(&self, p_world: &[f64; 3]) -> Vector3<f64> {
        let (x, y, z) = (p_world[0] - self.centre.x, p_world[1] - self.centre.y, p_world[2] - self.centre.z);
        // Written out, so that many points at once (`block`) get the same bits as one.
        let row = |i: usize| self.rotation[(i, 0)] * x + self.rotation[(i, 1)] * y + self.rotation[(i, 2)] * z;
        Vector3::new(row(0), row(1), row(2))
    }

    /// The pose after a small rotation vector on the left and a shift of the projection centre:
    /// `R ← exp([δ]×) R`, `C ← C + d`. These six are the parameters of every covariance.
    pub fn perturbed(&self, rotation: &Vector3<f64>, centre: &Vector3<f64>) -> Self {
        Self { rotation: rotation_exp(rotation) * self.rotation, centre: self.centre + centre }
    }

    /// The rotation vector and shift that take `self` to `other`, as [`Pose::perturbed`] applies them.
    pub fn difference(&self, other: &Self) -> (Vector3<f64>, Vector3<f64>) {
        (rotation_log(&(other.rotation * self.rotation.transpose())), other.centre - self.centre)
    }

    /// The pose with its rotation matrix made orthonormal again (nearest in the Frobenius norm).
    pub fn orthonormalised(&self) -> Self {
        let svd = self.rotation.svd(true, true);
        match (svd.u, svd.v_t) {
            (Some(u), Some(v_t)) => Self { rotation: u * v_t, centre: self.centre },
            _ => *self,
        }
    }
}

/// `[v]×`, so that `[v]× w = v × w`.
pub fn skew_matrix(v: &Vector3<f64>) -> Matrix3<f64> {
    Matrix3::new(0.0, -v.z, v.y, v.z, 0.0, -v.x, -v.y, v.x, 0.0)
}

/// The rotation matrix of a rotation vector (Rodrigues).
pub fn rotation_exp(v: &Vector3<f64>) -> Matrix3<f64> {
    let theta2 = v.norm_squared();
    let theta = theta2.sqrt();
    let (a, b) = if theta < 1e-4 {
        (1.0 - theta2 / 6.0, 0.5 - theta2 / 24.0)
    } else {
        (theta.sin() / theta, (1.0 - theta.cos()) / theta2)
    };
    let k = skew_matrix(v);
    Matrix3::identity() + k * a + k * k * b
}

/// The rotation vector of a rotation matrix, its length in [0, π].
pub fn rotation_log(r: &Matrix3<f64>) -> Vector3<f64> {
    let rotation = nalgebra::Rotation3::from_matrix_unchecked(*r);
    nalgebra::UnitQuaternion::from_rotation_matrix(&rotation).scaled_axis()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exp_and_log_are_inverse() {
        for v in [[0.1, -0.2, 0.3], [1e-7, 2e-7, -1e-7], [2.0, 1.5, -1.0], [0.0, 0.0, 0.0]] {
            let v = Vector3::from(v);
            let r = rotation_exp(&v);
            assert!((r * r.transpose() - Matrix3::identity()).amax() < 1e-14);
            assert!((rotation_log(&r) - v).amax() < 1e-12, "{v}");
        }
    }

    #[test]
    fn perturbation_and_difference_are_inverse() {
        let pose =
            Pose { rotation: rotation_exp(&Vector3::new(0.4, -1.1, 0.2)), centre: Vector3::new(4.5e5, 5.8e6, 120.0) };
        let (w, d) = (Vector3::new(0.01, -0.02, 0.005), Vector3::new(0.5, -0.25, 0.125));
        let (w2, d2) = pose.difference(&pose.perturbed(&w, &d));
        assert!((w - w2).amax() < 1e-13 && (d - d2).amax() < 1e-9);
    }

    #[test]
    fn a_matrix_that_is_no_rotation_is_refused_with_its_number() {
        let error = Pose::from_rotation_translation(Matrix3::identity() * 1.01, Vector3::zeros()).unwrap_err();
        assert!(error.to_string().contains("2.010e-2"), "{error}");
    }
}
