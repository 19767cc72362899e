//! The linear part of a Direct Linear Transformation: equations, normalisation, and what their singular values say.
//!
//! Every point gives two equations that are linear in the matrix, `a · h = 0` with the rows `(X̃, 0, −x X̃)` and
//! `(0, X̃, −y X̃)`. Both spaces are normalised first: centroid in the origin, mean distance √3 and √2.
//!
//! Sources: Abdel-Aziz and Karara 1971 (eleven parameters, h34 = 1); Hartley and Zisserman, Multiple View Geometry, 4.4
//! and 7.1 (normalisation, twelve parameters).

use faer::Mat;
use nalgebra::{DMatrix, Matrix3, Matrix4, SMatrix, SVector, Vector3};

use crate::error::{Error, Result};

/// A cloud of control points thinner than this, over its length, is a plane.
pub const FLAT: f64 = 1e-4;

/// The ratio of the last two singular values above which noise decides what the matrix is.
pub const NO_GAP: f64 = 0.3;

/// The last but one singular value over the first below which the equations determine no matrix.
const RANK: f64 = 1e-8;

const REMEDY: &str = "add control points in front of or behind the others; a plane, or a curve through the camera, does not \
                      determine the eleven parameters: with a known camera use resection";

pub(super) type Matrix12 = SMatrix<f64, 12, 12>;
pub(super) type Matrix34 = SMatrix<f64, 3, 4>;

/// Normalised points and the way back.
pub(super) struct Normalised {
    xyz: Vec<Vector3<f64>>,
    xy: Vec<[f64; 2]>,
    /// Pixels = `pixels` · normalised.
    pixels: Matrix3<f64>,
    /// Normalised = `object` · object space.
    object: Matrix4<f64>,
    /// Smallest extent of the control points over the largest.
    pub thickness: f64,
}

/// A matrix of the normalised points and the figures that say how well it is determined.
pub(super) struct Linear {
    /// Of the normalised spaces, of length 1.
    pub h: SVector<f64, 12>,
    /// Last singular value over the last but one: 0 is exact, 1 undetermined.
    pub gap: f64,
}

impl Normalised {
    /// From points of the local frame; refused where they lie in one plane.
    pub fn new(xyz: &[[f64; 3]], xy: &[[f64; 2]]) -> Result<Self> {
        let n = xyz.len() as f64;
        let centroid = xyz.iter().fold(Vector3::zeros(), |s, p| s + Vector3::from(*p)) / n;
        let middle = xy.iter().fold([0.0; 2], |s, p| [s[0] + p[0] / n, s[1] + p[1] / n]);
        let shifted: Vec<Vector3<f64>> = xyz.iter().map(|p| Vector3::from(*p) - centroid).collect();
        let scatter: Matrix3<f64> = shifted.iter().map(|p| p * p.transpose()).sum();
        let mut extents = scatter.symmetric_eigenvalues().map(|v| v.max(0.0).sqrt());
        extents.as_mut_slice().sort_by(|a, b| b.total_cmp(a));
        let thickness = extents[2] / extents[0];
        if thickness < FLAT || thickness.is_nan() {
            return Err(Error::Degenerate {
                what: "the control points lie in one plane, which does not determine a DLT".into(),
                quantity: "the thickness of the control points over their length",
                value: thickness,
                limit: FLAT,
                remedy: REMEDY,
            });
        }
        let spread = shifted.iter().map(Vector3::norm).sum::<f64>() / n;
        let width = xy.iter().map(|p| (p[0] - middle[0]).hypot(p[1] - middle[1])).sum::<f64>() / n;
        if width <= 0.0 || !width.is_finite() {
            return Err(Error::invalid("all control points have the same photo coordinates"));
        }
        let (s, t) = (3f64.sqrt() / spread, 2f64.sqrt() / width);
        let mut object = Matrix4::identity() * s;
        object[(3, 3)] = 1.0;
        for i in 0..3 {
            object[(i, 3)] = -s * centroid[i];
        }
        let pixels = Matrix3::new(1.0 / t, 0.0, middle[0], 0.0, 1.0 / t, middle[1], 0.0, 0.0, 1.0);
        Ok(Self {
            xyz: shifted.iter().map(|p| p * s).collect(),
            xy: xy.iter().map(|p| [(p[0] - middle[0]) * t, (p[1] - middle[1]) * t]).collect(),
            pixels,
            object,
            thickness,
        })
    }

    fn rows(&self, i: usize) -> [SVector<f64, 12>; 2] {
        let (p, [x, y]) = (&self.xyz[i], self.xy[i]);
        let q = [p.x, p.y, p.z, 1.0];
        let (mut a, mut b) = (SVector::zeros(), SVector::zeros());
        for k in 0..4 {
            (a[k], a[8 + k]) = (q[k], -x * q[k]);
            (b[4 + k], b[8 + k]) = (q[k], -y * q[k]);
        }
        [a, b]
    }

    fn denominator(&self, h: &SVector<f64, 12>, i: usize) -> f64 {
        let p = &self.xyz[i];
        h[8] * p.x + h[9] * p.y + h[10] * p.z + h[11]
    }

    /// Twelve parameters: min ‖A h‖ with ‖h‖ = 1.
    pub fn twelve(&self) -> Result<Linear> {
        let n = self.xyz.len();
        let mut a = Mat::<f64>::zeros((2 * n).max(12), 12);
        for i in 0..n {
            for (k, row) in self.rows(i).iter().enumerate() {
                for j in 0..12 {
                    a[(2 * i + k, j)] = row[j];
                }
            }
        }
        let svd = a.thin_svd().map_err(|e| Error::Internal(format!("singular values of the DLT: {e:?}")))?;
        let (s, v) = (svd.S().column_vector(), svd.V());
        if s[10] <= RANK * s[0] || s[10].is_nan() {
            return Err(Error::Degenerate {
                what: "the control points do not determine a DLT".into(),
                quantity: "the last but one singular value over the first",
                value: s[10] / s[0],
                limit: RANK,
                remedy: REMEDY,
            });
        }
        Ok(Linear { h: SVector::from_fn(|j, _| v[(j, 11)]), gap: s[11] / s[10] })
    }

    /// Eleven parameters: h34 = 1 (which the shift to the centroid makes safe), each equation divided by the
    /// denominator of the last iteration, so that the residuals become those of the photo.
    pub fn eleven(&self, start: &Linear) -> SVector<f64, 12> {
        let mut h = if start.h[11] != 0.0 { start.h / start.h[11] } else { start.h };
        for _ in 0..20 {
            let mut normal = SMatrix::<f64, 11, 11>::zeros();
            let mut right = SVector::<f64, 11>::zeros();
            for i in 0..self.xyz.len() {
                let weight = 1.0 / self.denominator(&h, i).powi(2);
                for row in self.rows(i) {
                    let a = row.fixed_rows::<11>(0);
                    normal += a * a.transpose() * weight;
                    right -= a * (row[11] * weight);
                }
            }
            let Some(solved) = normal.cholesky().map(|c| c.solve(&right)) else { break };
            let change = (solved - h.fixed_rows::<11>(0)).norm() / solved.norm();
            h.fixed_rows_mut::<11>(0).copy_from(&solved);
            h[11] = 1.0;
            if change < 1e-10 {
                break;
            }
        }
        h / h.norm()
    }

    /// First-order covariance of the twelve parameters (of length 1) from that of the pixels: `sigma` gives xx, xy, yy of
    /// a point.
    pub fn covariance(&self, h: &SVector<f64, 12>, sigma: impl Fn(usize) -> [f64; 3]) -> Option<Matrix12> {
        let t = 1.0 / self.pixels[(0, 0)];
        let (mut n, mut noise) = (Matrix12::zeros(), Matrix12::zeros());
        for i in 0..self.xyz.len() {
            let [a, b] = self.rows(i);
            n += a * a.transpose() + b * b.transpose();
            let scale = (self.denominator(h, i) * t).powi(2);
            let [xx, xy, yy] = sigma(i);
            noise += (a * a.transpose() * xx + b * b.transpose() * yy) * scale;
            noise += (a * b.transpose() + b * a.transpose()) * (xy * scale);
        }
        // The solution is the eigenvector of the smallest eigenvalue: it moves in the other eleven directions alone.
        let eigen = n.symmetric_eigen();
        let smallest = eigen.eigenvalues.imin();
        let mut inverse = Matrix12::zeros();
        for k in (0..12).filter(|&k| k != smallest) {
            let gap = eigen.eigenvalues[k] - eigen.eigenvalues[smallest];
            if gap <= 0.0 {
                return None;
            }
            let v = eigen.eigenvectors.column(k);
            inverse += v * v.transpose() / gap;
        }
        Some(inverse * noise * inverse)
    }

    /// The matrix from object space to pixels, of any scale.
    pub fn matrix(&self, h: &SVector<f64, 12>) -> [[f64; 4]; 3] {
        let m = self.pixels * Matrix34::from_fn(|i, j| h[4 * i + j]) * self.object;
        std::array::from_fn(|i| std::array::from_fn(|j| m[(i, j)]))
    }

    /// d(matrix, row by row)/d(h).
    pub fn matrix_by_h(&self) -> Matrix12 {
        let mut d = Matrix12::zeros();
        for i in 0..3 {
            for j in 0..4 {
                for k in 0..3 {
                    for l in 0..4 {
                        d[(4 * i + j, 4 * k + l)] = self.pixels[(i, k)] * self.object[(l, j)];
                    }
                }
            }
        }
        d
    }

    /// How many points lie behind the camera of this matrix.
    pub fn behind(&self, h: &SVector<f64, 12>) -> usize {
        let m = Matrix34::from_fn(|i, j| h[4 * i + j]);
        let sign = m.fixed_columns::<3>(0).determinant().signum();
        (0..self.xyz.len()).filter(|&i| self.denominator(h, i) * sign <= 0.0).count()
    }
}

/// Rows and columns of a fixed matrix as a dynamic one.
pub(super) fn dynamic(m: &Matrix12) -> DMatrix<f64> {
    DMatrix::from_fn(12, 12, |i, j| m[(i, j)])
}
