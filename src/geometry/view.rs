//! A view: camera and pose together. A DLT matrix is a view like any other, its camera merely has a skew.

use nalgebra::{Matrix3, Vector3};

use super::camera::{Camera, Model};
use super::pose::Pose;
use crate::error::{Error, Result};

/// A photo's geometry: from world points to pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct View {
    /// Interior orientation.
    pub camera: Camera,
    /// Exterior orientation, world to camera.
    pub pose: Pose,
}

/// What a 3×4 projection matrix means, metric: `P = K [R | −R C]`.
#[derive(Debug, Clone, Copy)]
pub struct DltParts {
    /// Upper triangular, K₃₃ = 1, positive diagonal.
    pub calibration: Matrix3<f64>,
    /// World to camera.
    pub rotation: Matrix3<f64>,
    /// Projection centre in the world frame.
    pub centre: Vector3<f64>,
    /// The matrix scaled to ‖(h31 h32 h33)‖ = 1 and det M > 0: its third row times (X, 1) is the depth.
    pub scaled: [[f64; 4]; 3],
}

impl DltParts {
    /// Decomposes a projection matrix of any scale and sign (Hartley and Zisserman, 6.2.4).
    pub fn from_matrix(p: &[[f64; 4]; 3]) -> Result<Self> {
        if !p.iter().flatten().all(|v| v.is_finite()) {
            return Err(Error::invalid("the DLT matrix holds values that are not finite"));
        }
        let m = Matrix3::from_fn(|i, j| p[i][j]);
        let norm = m.row(2).norm();
        let size = m.amax();
        if norm <= 1e-14 * size || size == 0.0 {
            return Err(Error::Degenerate {
                what: "the DLT matrix has no projection centre at a finite place".into(),
                quantity: "‖(h31 h32 h33)‖ over the largest element",
                value: if size > 0.0 { norm / size } else { 0.0 },
                limit: 1e-14,
                remedy: "control points must differ in depth",
            });
        }
        let sign = if m.determinant() < 0.0 { -1.0 } else { 1.0 };
        let scaled: [[f64; 4]; 3] = std::array::from_fn(|i| std::array::from_fn(|j| p[i][j] * sign / norm));
        let m = m * (sign / norm);
        let p4 = Vector3::new(scaled[0][3], scaled[1][3], scaled[2][3]);
        let (calibration, rotation) = rq(&m);
        let smallest = (0..3).map(|i| calibration[(i, i)]).fold(f64::INFINITY, f64::min) / calibration.amax();
        if smallest <= 1e-12 || smallest.is_nan() {
            return Err(Error::Degenerate {
                what: "the DLT matrix has no camera: its left 3×3 part is singular".into(),
                quantity: "smallest diagonal element of K over the largest element",
                value: smallest,
                limit: 1e-12,
                remedy: "control points must not lie in one plane",
            });
        }
        let lu = m.lu();
        let centre = lu.solve(&-p4).ok_or_else(|| Error::Internal("singular M after its check".into()))?;
        // One step of refinement: large coordinates make p4 large against the camera's own scale.
        let centre = centre - lu.solve(&(m * centre + p4)).unwrap_or_default();
        Ok(Self { calibration: calibration / calibration[(2, 2)], rotation, centre, scaled })
    }
}

/// `M = K R` with K upper triangular and of positive diagonal, R a rotation (det M > 0).
fn rq(m: &Matrix3<f64>) -> (Matrix3<f64>, Matrix3<f64>) {
    let flip = Matrix3::new(0.0, 0.0, 1.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0);
    let qr = (flip * m).transpose().qr();
    let mut k = flip * qr.r().transpose() * flip;
    let mut r = flip * qr.q().transpose();
    for i in 0..3 {
        if k[(i, i)] < 0.0 {
            k.column_mut(i).neg_mut();
            r.row_mut(i).neg_mut();
        }
    }
    for (i, j) in [(1, 0), (2, 0), (2, 1)] {
        k[(i, j)] = 0.0;
    }
    (k, r)
}

impl View {
    /// From camera and pose.
    pub fn new(camera: Camera, pose: Pose) -> Self {
        Self { camera, pose }
    }

    /// From a 3×4 projection matrix of any scale and sign, and optional distortion terms k1 k2 p1 p2 k3.
    ///
    /// The terms act as in the OPENCV model on the coordinates normalised by the matrix's own K.
    pub fn from_dlt(p: &[[f64; 4]; 3], width: u32, height: u32, distortion: &[f64; 5]) -> Result<Self> {
        let parts = DltParts::from_matrix(p)?;
        let k = &parts.calibration;
        let mut params = vec![k[(0, 0)], k[(1, 1)], k[(0, 2)], k[(1, 2)]];
        params.extend(distortion);
        let camera = Camera::new(Model::OpenCv, width, height, &params)?.with_skew(k[(0, 1)]);
        Ok(Self { camera, pose: Pose { rotation: parts.rotation, centre: parts.centre } })
    }

    /// `K [R | −R C]` with the third row of K being (0 0 1); `None` for models that are no matrix even without
    /// distortion.
    pub fn matrix(&self) -> Option<[[f64; 4]; 3]> {
        if matches!(self.camera.model(), Model::OpenCvFisheye | Model::Equirectangular) {
            return None;
        }
        let p = self.camera.params();
        let k = Matrix3::new(p[0], self.camera.skew(), p[2], 0.0, p[1], p[3], 0.0, 0.0, 1.0);
        let m = k * self.pose.rotation;
        let p4 = -(m * self.pose.centre);
        Some(std::array::from_fn(|i| [m[(i, 0)], m[(i, 1)], m[(i, 2)], p4[i]]))
    }

    /// A world point to pixels and depth; `None` where the camera cannot see it.
    #[inline]
    pub fn project(&self, p_world: &[f64; 3]) -> Option<([f64; 2], f64)> {
        let p = self.pose.transform(p_world);
        self.camera.project(&p).map(|xy| (xy, self.camera.depth(&p)))
    }

    /// A pixel to the unit direction in the world frame.
    pub fn ray(&self, xy: &[f64; 2]) -> Option<Vector3<f64>> {
        self.camera.unproject(xy).map(|d| self.pose.rotation.transpose() * d)
    }
}
