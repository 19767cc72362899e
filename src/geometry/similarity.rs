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

    /// The least-squares similarity between point pairs of equal weight, in closed form.
    ///
    /// Source: S. Umeyama, Least-squares estimation of transformation parameters between two point patterns, 1991.
    /// Refused are points that coincide and, in space, points on one line.
    pub fn fit(source: &[[f64; D]], target: &[[f64; D]]) -> Result<Self> {
        let n = source.len();
        if target.len() != n {
            return Err(Error::invalid(format!("{n} source points and {} target points", target.len())));
        }
        if !source.iter().chain(target).flatten().all(|v| v.is_finite()) {
            return Err(Error::invalid("the points hold values that are not finite"));
        }
        let mean = |points: &[[f64; D]]| {
            points.iter().fold(SVector::<f64, D>::zeros(), |sum, p| sum + SVector::from(*p)) / n.max(1) as f64
        };
        let (from, to) = (mean(source), mean(target));
        let (mut cross, mut own) = (SMatrix::<f64, D, D>::zeros(), SMatrix::<f64, D, D>::zeros());
        for (s, t) in source.iter().zip(target) {
            let (s, t) = (SVector::from(*s) - from, SVector::from(*t) - to);
            cross += t * s.transpose();
            own += s * s.transpose();
        }
        let spread = DMatrix::from_fn(D, D, |i, j| own[(i, j)]).symmetric_eigenvalues();
        let mut widths: Vec<f64> = spread.iter().map(|v| v.max(0.0).sqrt()).collect();
        widths.sort_by(f64::total_cmp);
        // One direction of extent fixes a rotation of the plane, two fix one of space.
        let (needed, largest) = (widths[1], widths[D - 1]);
        let enough = if D == 2 { largest > 0.0 } else { needed > 1e-9 * largest };
        if !enough {
            return Err(Error::Degenerate {
                what: format!("{n} points do not determine a similarity"),
                quantity: "their extent across the longest direction over that along it",
                value: if D > 2 && largest > 0.0 { needed / largest } else { 0.0 },
                limit: 1e-9,
                remedy: "give points that do not lie on one line, nor in one place",
            });
        }
        let svd = DMatrix::from_fn(D, D, |i, j| cross[(i, j)]).svd(true, true);
        let (Some(u), Some(v_t)) = (svd.u, svd.v_t) else {
            return Err(Error::Internal("no singular vectors of a small matrix".into()));
        };
        let mut order: Vec<usize> = (0..D).collect();
        order.sort_by(|a, b| svd.singular_values[*b].total_cmp(&svd.singular_values[*a]));
        // A reflection fits better: the weakest direction gives way.
        let mut signs = [1.0; D];
        if u.determinant() * v_t.determinant() < 0.0 {
            signs[order[D - 1]] = -1.0;
        }
        let rotation = SMatrix::<f64, D, D>::from_fn(|i, j| (0..D).map(|k| u[(i, k)] * signs[k] * v_t[(k, j)]).sum());
        let scale = (0..D).map(|k| svd.singular_values[k] * signs[k]).sum::<f64>() / own.trace();
        if scale <= 0.0 || scale.is_nan() {
            return Err(Error::Degenerate {
                what: "the target points do not look like the source points".into(),
                quantity: "the scale between them",
                value: scale,
                limit: 0.0,
                remedy: "check that the pairs belong together",
            });
        }
        Ok(Self { scale, rotation, translation: to - rotation * from * scale })
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;
    use crate::geometry::rotation_exp;

    fn points() -> Vec<[f64; 3]> {
        (0..9).map(|i| [f64::from(i % 3) * 2.0, f64::from(i / 3) - 1.0, (f64::from(i) * 0.7).sin()]).collect()
    }

    #[test]
    fn exact_pairs_give_the_truth_in_space_and_in_the_plane() {
        let truth = Similarity {
            scale: 2.5,
            rotation: rotation_exp(&Vector3::new(1.0, -2.0, 0.5)),
            translation: Vector3::new(10.0, -4.0, 3.0),
        };
        let target: Vec<[f64; 3]> = points().iter().map(|p| truth.apply(p)).collect();
        let found = Similarity::fit(&points(), &target).unwrap();
        assert!((found.scale - 2.5).abs() < 1e-12 && (found.rotation - truth.rotation).amax() < 1e-12);
        assert!((found.translation - truth.translation).amax() < 1e-11);
        for (p, q) in points().iter().zip(&target) {
            let back = found.inverse().apply(q);
            assert!((0..3).all(|i| (back[i] - p[i]).abs() < 1e-11));
        }
        let flat: Vec<[f64; 2]> = points().iter().map(|p| [p[0], p[1]]).collect();
        let turned: Vec<[f64; 2]> = flat.iter().map(|p| [-0.5 * p[1] + 7.0, 0.5 * p[0] - 1.0]).collect();
        let found = Similarity::fit(&flat, &turned).unwrap();
        assert!((found.scale - 0.5).abs() < 1e-13 && (found.rotation[(1, 0)] - 1.0).abs() < 1e-13);
    }

    #[test]
    fn points_in_a_plane_are_enough_and_never_give_a_reflection() {
        let flat: Vec<[f64; 3]> = points().iter().map(|p| [p[0], p[1], 0.0]).collect();
        let found = Similarity::fit(&flat, &flat).unwrap();
        assert!((found.rotation - SMatrix::identity()).amax() < 1e-12);
        let mirrored: Vec<[f64; 3]> = points().iter().map(|p| [-p[0], p[1], p[2]]).collect();
        assert!(Similarity::fit(&points(), &mirrored).unwrap().rotation.determinant() > 0.999);
    }

    #[test]
    fn points_on_a_line_are_refused_with_their_width() {
        let line: Vec<[f64; 3]> = (0..5).map(|i| [f64::from(i), 2.0 * f64::from(i), 0.0]).collect();
        let error = Similarity::fit(&line, &line).unwrap_err().to_string();
        assert!(error.contains("one line"), "{error}");
        assert!(Similarity::fit(&[[1.0, 2.0]; 3], &[[1.0, 2.0]; 3]).is_err());
    }
}
