//! Interior orientation: from the camera frame to the pixel plane and back, with derivatives.
//!
//! `x = fx·xd + s·yd + cx`, `y = fy·yd + cy` with (xd, yd) the distorted normalised coordinates. The named models have
//! no skew `s`; a decomposed DLT matrix has.

use std::f64::consts::PI;

use nalgebra::Vector3;

use super::fisheye::Fisheye;
use super::polynomial::Polynomial;
use crate::error::{Error, Result};

/// The largest number of parameters that a model has.
pub const MAX_PARAMS: usize = 12;

/// Focal lengths that are taken for ones, in units of the longer side: a straight-line lens of 169° has the smallest, a
/// telescope of 100 m the largest.
const FOCAL: (f64, f64) = (0.05, 1e4);

/// How far from the picture its principal point may be, in units of the longer side: far, as pictures may be small pieces
/// of larger ones.
const PRINCIPAL_POINT: f64 = 1e3;

/// So near to the principal point, in units of the longer side, no lens moves anything by half of its distance.
const NEAR: f64 = 0.02;

/// The camera models, with parameters in OpenCV's meaning.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Model {
    /// fx fy cx cy
    Pinhole,
    /// fx fy cx cy k1 k2 p1 p2 k3
    OpenCv,
    /// fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6
    FullOpenCv,
    /// fx fy cx cy k1 k2 k3 k4
    OpenCvFisheye,
    /// width and height alone
    Equirectangular,
}

impl Model {
    /// The model of this name.
    pub fn from_name(name: &str) -> Result<Self> {
        Ok(match name {
            "PINHOLE" => Self::Pinhole,
            "OPENCV" => Self::OpenCv,
            "FULL_OPENCV" => Self::FullOpenCv,
            "OPENCV_FISHEYE" => Self::OpenCvFisheye,
            "EQUIRECTANGULAR" => Self::Equirectangular,
            _ => return Err(Error::invalid(format!("there is no camera model {name:?}"))),
        })
    }

    /// Its name in files.
    pub fn name(self) -> &'static str {
        match self {
            Self::Pinhole => "PINHOLE",
            Self::OpenCv => "OPENCV",
            Self::FullOpenCv => "FULL_OPENCV",
            Self::OpenCvFisheye => "OPENCV_FISHEYE",
            Self::Equirectangular => "EQUIRECTANGULAR",
        }
    }

    /// The names of its parameters, in order.
    pub fn parameters(self) -> &'static [&'static str] {
        match self {
            Self::Pinhole => &["fx", "fy", "cx", "cy"],
            Self::OpenCv => &["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"],
            Self::FullOpenCv => &["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"],
            Self::OpenCvFisheye => &["fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"],
            Self::Equirectangular => &[],
        }
    }
}

/// What "depth" means for a model.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Depth {
    /// The coordinate along the optical axis: pinhole and polynomial models.
    AlongAxis,
    /// The distance from the projection centre: models that see beside and behind the camera plane.
    Range,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Lens {
    Polynomial(Polynomial),
    Fisheye(Fisheye),
    Equirectangular,
}

/// A camera: its model, the size of its upright image, and its parameters.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    model: Model,
    /// Pixels.
    pub width: u32,
    /// Pixels.
    pub height: u32,
    pub(super) fx: f64,
    pub(super) fy: f64,
    pub(super) cx: f64,
    pub(super) cy: f64,
    pub(super) skew: f64,
    pub(super) lens: Lens,
}

/// A projected point with its derivatives.
#[derive(Debug, Clone, Copy)]
pub struct Projection {
    /// Pixels.
    pub xy: [f64; 2],
    /// d(x, y)/d(point in the camera frame).
    pub d_point: [[f64; 3]; 2],
    /// d(x, y)/d(parameters), in the model's order; unused columns are zero.
    pub d_params: [[f64; MAX_PARAMS]; 2],
}

impl Camera {
    /// A camera of a named model.
    pub fn new(model: Model, width: u32, height: u32, params: &[f64]) -> Result<Self> {
        let names = model.parameters();
        if params.len() != names.len() {
            return Err(Error::invalid(format!(
                "{} takes {} parameters ({}), {} were given",
                model.name(),
                names.len(),
                names.join(" "),
                params.len()
            )));
        }
        if width == 0 || height == 0 || width > 1 << 20 || height > 1 << 20 {
            return Err(Error::invalid(format!("an image of {width} × {height} pixels is not possible")));
        }
        for (name, value) in names.iter().zip(params) {
            if !value.is_finite() || (name.starts_with('f') && *value <= 0.0) {
                return Err(Error::invalid(format!("{} camera: {name} = {value} is not possible", model.name())));
            }
        }
        let p = |i: usize| params.get(i).copied().unwrap_or(0.0);
        let lens = match model {
            Model::Pinhole | Model::OpenCv | Model::FullOpenCv => {
                Lens::Polynomial(Polynomial::new([p(4), p(5), p(6), p(7), p(8), p(9), p(10), p(11)]))
            }
            Model::OpenCvFisheye => Lens::Fisheye(Fisheye::new([p(4), p(5), p(6), p(7)])),
            Model::Equirectangular => Lens::Equirectangular,
        };
        Ok(Self { model, width, height, fx: p(0), fy: p(1), cx: p(2), cy: p(3), skew: 0.0, lens })
    }

    /// Refuses focal lengths, principal points and distortions that no camera has. Not a part of [`Camera::new`]: an
    /// iteration may pass through such values, a DLT matrix is of use without its parts having a meaning, and what an
    /// estimate comes to has tests of its own. It is for what people write.
    pub fn check_plausible(&self) -> Result<()> {
        let (size, names) = (f64::from(self.width.max(self.height)), self.model.parameters());
        for (name, value) in names.iter().zip([self.fx, self.fy]) {
            if !(FOCAL.0 * size..=FOCAL.1 * size).contains(&value) {
                return Err(Error::invalid(format!(
                    "{} camera: {name} = {value:?} for {} × {} pixels is no focal length in pixels (here between {} and \
                     {}); one in mm is divided by the width of a pixel in mm",
                    self.model.name(),
                    self.width,
                    self.height,
                    (FOCAL.0 * size).round(),
                    (FOCAL.1 * size).round()
                )));
            }
        }
        for (axis, value) in ["cx", "cy"].iter().zip([self.cx, self.cy]) {
            if value.abs() > PRINCIPAL_POINT * size {
                return Err(Error::invalid(format!(
                    "{} camera: {axis} = {value:?} is no place of a principal point: it is more than {PRINCIPAL_POINT} times \
                     the longer side of {} × {} pixels away",
                    self.model.name(),
                    self.width,
                    self.height
                )));
            }
        }
        let near = NEAR * size / self.fx.min(self.fy);
        let moved = match &self.lens {
            Lens::Polynomial(lens) => [[near, 0.0], [-near, 0.0], [0.0, near], [0.0, -near]]
                .map(|[x, y]| {
                    let [xd, yd] = lens.distort_unchecked(x, y, near * near);
                    (xd - x).hypot(yd - y)
                })
                .into_iter()
                .fold(0.0, |a: f64, b| if b > a || b.is_nan() { b } else { a }),
            Lens::Fisheye(lens) => (lens.distort(near.atan()) - near.atan()).abs(),
            Lens::Equirectangular => 0.0,
        };
        if moved.is_nan() || moved > 0.5 * near {
            return Err(Error::invalid(format!(
                "{} camera: its distortion moves what lies {:.0} pixels from the principal point by {:.3e} pixels, as no lens \
                 does: its terms ({}) act on coordinates divided by the focal length, not on pixels or mm",
                self.model.name(),
                NEAR * size,
                moved * self.fx.max(self.fy),
                self.distortion_terms()
            )));
        }
        Ok(())
    }

    /// The distortion's terms that are not zero, as people write them.
    fn distortion_terms(&self) -> String {
        let k: &[f64] = match &self.lens {
            Lens::Polynomial(lens) => &lens.k,
            Lens::Fisheye(lens) => &lens.k,
            Lens::Equirectangular => &[],
        };
        let names = self.model.parameters().iter().skip(4);
        let given = names.zip(k).filter(|(_, value)| **value != 0.0);
        given.map(|(name, value)| format!("{name} = {value:?}")).collect::<Vec<_>>().join(", ")
    }

    /// The same camera with a skew, as a decomposed DLT matrix has it.
    pub fn with_skew(mut self, skew: f64) -> Self {
        self.skew = skew;
        self
    }

    /// The model.
    pub fn model(&self) -> Model {
        self.model
    }

    /// The coefficient of yd in x; zero for the named models.
    pub fn skew(&self) -> f64 {
        self.skew
    }

    /// fx fy cx cy; zero for a panorama.
    pub fn affine(&self) -> [f64; 4] {
        [self.fx, self.fy, self.cx, self.cy]
    }

    /// The distortion terms k1 k2 p1 p2 k3 k4 k5 k6 and the squared radius up to which they are valid; `None` for
    /// fisheye and panorama.
    pub fn polynomial(&self) -> Option<([f64; 8], f64)> {
        match &self.lens {
            Lens::Polynomial(lens) => Some((lens.k, lens.max_r2)),
            Lens::Fisheye(_) | Lens::Equirectangular => None,
        }
    }

    /// The parameters in the model's order.
    pub fn params(&self) -> Vec<f64> {
        let mut all = vec![self.fx, self.fy, self.cx, self.cy];
        match &self.lens {
            Lens::Polynomial(p) => all.extend(p.k),
            Lens::Fisheye(f) => all.extend(f.k),
            Lens::Equirectangular => {}
        }
        all.truncate(self.model.parameters().len());
        all
    }

    /// What depth means for this camera.
    #[inline(always)]
    pub fn depth_kind(&self) -> Depth {
        match self.lens {
            Lens::Polynomial(_) => Depth::AlongAxis,
            Lens::Fisheye(_) | Lens::Equirectangular => Depth::Range,
        }
    }

    /// The depth of a point of the camera frame.
    #[inline(always)]
    pub fn depth(&self, p: &Vector3<f64>) -> f64 {
        match self.depth_kind() {
            Depth::AlongAxis => p.z,
            Depth::Range => p.norm(),
        }
    }

    /// The largest angle from the optical axis at which the model is valid, radians.
    pub fn max_angle(&self) -> f64 {
        match &self.lens {
            Lens::Polynomial(p) => p.max_r2.sqrt().atan(),
            Lens::Fisheye(f) => f.max_theta,
            Lens::Equirectangular => PI,
        }
    }

    /// Whether a pixel position lies in the image: [−0.5, W−0.5) × [−0.5, H−0.5).
    #[inline(always)]
    pub fn contains(&self, xy: &[f64; 2]) -> bool {
        xy[0] >= -0.5 && xy[0] < f64::from(self.width) - 0.5 && xy[1] >= -0.5 && xy[1] < f64::from(self.height) - 0.5
    }

    #[inline(always)]
    fn pixel_at(&self, xd: f64, yd: f64) -> [f64; 2] {
        [self.fx * xd + self.skew * yd + self.cx, self.fy * yd + self.cy]
    }

    #[inline(always)]
    fn normalised_at(&self, xy: &[f64; 2]) -> [f64; 2] {
        let yd = (xy[1] - self.cy) / self.fy;
        [(xy[0] - self.cx - self.skew * yd) / self.fx, yd]
    }

    /// A point of the camera frame to pixels; `None` behind the camera, beyond the lens's valid field, or for NaN.
    #[inline]
    pub fn project(&self, p: &Vector3<f64>) -> Option<[f64; 2]> {
        match &self.lens {
            Lens::Polynomial(lens) => {
                if p.z > 0.0 {
                    let iz = 1.0 / p.z;
                    let [xd, yd] = lens.distort(p.x * iz, p.y * iz)?;
                    Some(self.pixel_at(xd, yd))
                } else {
                    None
                }
            }
            Lens::Fisheye(lens) => {
                let r = p.x.hypot(p.y);
                let theta = r.atan2(p.z);
                if r > 0.0 && theta <= lens.max_theta {
                    let scale = lens.distort(theta) / r;
                    Some(self.pixel_at(p.x * scale, p.y * scale))
                } else {
                    (r == 0.0 && p.z > 0.0).then_some([self.cx, self.cy])
                }
            }
            Lens::Equirectangular => {
                let range = p.norm();
                if !range.is_finite() || range <= 0.0 {
                    return None;
                }
                let (w, h) = (f64::from(self.width), f64::from(self.height));
                let x = (p.x.atan2(p.z) / (2.0 * PI) + 0.5) * w - 0.5;
                let latitude = (-p.y).atan2(p.x.hypot(p.z));
                let y = (0.5 - latitude / PI) * h - 0.5;
                // Longitude +π is the left border, and the nadir belongs to the last row.
                Some([if x >= w - 0.5 { x - w } else { x }, y.min((h - 0.5).next_down())])
            }
        }
    }

    /// As [`Camera::project`], with derivatives; `None` also at the poles of a panorama, which have none.
    pub fn project_with_jacobian(&self, p: &Vector3<f64>) -> Option<Projection> {
        let xy = self.project(p)?;
        match &self.lens {
            Lens::Polynomial(lens) => Some(self.polynomial_jacobian(lens, p, xy)),
            Lens::Fisheye(lens) => Some(self.fisheye_jacobian(lens, p, xy)),
            Lens::Equirectangular => self.panorama_jacobian(p, xy),
        }
    }

    /// As [`Camera::project_with_jacobian`] with d(x, y)/d(point) alone, which costs little more than projecting.
    #[inline]
    pub fn project_with_point_jacobian(&self, p: &Vector3<f64>) -> Option<([f64; 2], [[f64; 3]; 2])> {
        let Lens::Polynomial(lens) = &self.lens else {
            return self.project_with_jacobian(p).map(|j| (j.xy, j.d_point));
        };
        if p.z <= 0.0 || p.z.is_nan() {
            return None;
        }
        let iz = 1.0 / p.z;
        let (x, y) = (p.x * iz, p.y * iz);
        let ([xd, yd], [xx, xy, yy]) = lens.distort_with_slope(x, y)?;
        let row = |a: f64, b: f64| [a * iz, b * iz, -(a * x + b * y) * iz];
        let d_point =
            [row(self.fx * xx + self.skew * xy, self.fx * xy + self.skew * yy), row(self.fy * xy, self.fy * yy)];
        Some((self.pixel_at(xd, yd), d_point))
    }

    /// Rows of d(x, y)/d(a) from rows of d(xd, yd)/d(a).
    fn pixel_rows<const N: usize>(&self, dxd: &[f64; N], dyd: &[f64; N]) -> [[f64; N]; 2] {
        [std::array::from_fn(|i| self.fx * dxd[i] + self.skew * dyd[i]), std::array::from_fn(|i| self.fy * dyd[i])]
    }

    fn affine_columns(xd: f64, yd: f64) -> [[f64; MAX_PARAMS]; 2] {
        let mut d_params = [[0.0; MAX_PARAMS]; 2];
        d_params[0][..4].copy_from_slice(&[xd, 0.0, 1.0, 0.0]);
        d_params[1][..4].copy_from_slice(&[0.0, yd, 0.0, 1.0]);
        d_params
    }

    fn polynomial_jacobian(&self, lens: &Polynomial, p: &Vector3<f64>, xy: [f64; 2]) -> Projection {
        let iz = 1.0 / p.z;
        let (x, y) = (p.x * iz, p.y * iz);
        let d = lens.derivatives(x, y);
        let [xd, yd] = self.normalised_at(&xy);
        let mut d_params = Self::affine_columns(xd, yd);
        let by_terms = self.pixel_rows(&d.d_k[0], &d.d_k[1]);
        let terms = self.model.parameters().len().saturating_sub(4);
        for (row, by_terms) in d_params.iter_mut().zip(by_terms) {
            row[4..4 + terms].copy_from_slice(&by_terms[..terms]);
        }
        let by_normalised = self.pixel_rows(&d.d_xy[0], &d.d_xy[1]);
        let d_point = by_normalised.map(|[a, b]| [a * iz, b * iz, -(a * x + b * y) * iz]);
        Projection { xy, d_point, d_params }
    }

    fn fisheye_jacobian(&self, lens: &Fisheye, p: &Vector3<f64>, xy: [f64; 2]) -> Projection {
        let r = p.x.hypot(p.y);
        let range2 = p.norm_squared();
        let theta = r.atan2(p.z);
        let (ux, uy, dxd, dyd) = if r > 1e-12 * range2.sqrt() {
            let (ux, uy, scale, slope) = (p.x / r, p.y / r, lens.distort(theta) / r, lens.slope(theta));
            // d(θd)/d(x, y, z); the direction (ux, uy) turns with (x, y).
            let d = [slope * ux * p.z / range2, slope * uy * p.z / range2, -slope * r / range2];
            (
                ux,
                uy,
                [ux * d[0] + scale * uy * uy, ux * d[1] - scale * ux * uy, ux * d[2]],
                [uy * d[0] - scale * ux * uy, uy * d[1] + scale * ux * ux, uy * d[2]],
            )
        } else {
            // On the axis everything tends to the pinhole.
            (0.0, 0.0, [1.0 / p.z, 0.0, 0.0], [0.0, 1.0 / p.z, 0.0])
        };
        let [xd, yd] = self.normalised_at(&xy);
        let mut d_params = Self::affine_columns(xd, yd);
        let mut power = theta;
        for i in 4..8 {
            power *= theta * theta;
            d_params[0][i] = (self.fx * ux + self.skew * uy) * power;
            d_params[1][i] = self.fy * uy * power;
        }
        Projection { xy, d_point: self.pixel_rows(&dxd, &dyd), d_params }
    }

    fn panorama_jacobian(&self, p: &Vector3<f64>, xy: [f64; 2]) -> Option<Projection> {
        let rho2 = p.x * p.x + p.z * p.z;
        let rho = rho2.sqrt();
        let range2 = p.norm_squared();
        if rho == 0.0 {
            return None;
        }
        let (a, b) = (f64::from(self.width) / (2.0 * PI), f64::from(self.height) / PI);
        let d_point = [
            [a * p.z / rho2, 0.0, -a * p.x / rho2],
            [-b * p.x * p.y / (range2 * rho), b * rho / range2, -b * p.z * p.y / (range2 * rho)],
        ];
        Some(Projection { xy, d_point, d_params: [[0.0; MAX_PARAMS]; 2] })
    }

    /// A pixel to the unit direction in the camera frame; `None` where nothing of the valid field is imaged.
    pub fn unproject(&self, xy: &[f64; 2]) -> Option<Vector3<f64>> {
        let direction = match &self.lens {
            Lens::Polynomial(lens) => {
                let [xd, yd] = self.normalised_at(xy);
                let [x, y] = lens.undistort(xd, yd)?;
                Vector3::new(x, y, 1.0)
            }
            Lens::Fisheye(lens) => {
                let [xd, yd] = self.normalised_at(xy);
                let theta_d = xd.hypot(yd);
                let theta = lens.undistort(theta_d)?;
                let scale = if theta_d > 0.0 { theta.sin() / theta_d } else { 1.0 };
                Vector3::new(xd * scale, yd * scale, theta.cos())
            }
            Lens::Equirectangular => {
                let (w, h) = (f64::from(self.width), f64::from(self.height));
                let longitude = ((xy[0] + 0.5) / w - 0.5) * 2.0 * PI;
                let latitude = (0.5 - (xy[1] + 0.5) / h) * PI;
                if latitude.abs() > 0.5 * PI {
                    return None;
                }
                let c = latitude.cos();
                Vector3::new(c * longitude.sin(), -latitude.sin(), c * longitude.cos())
            }
        };
        let norm = direction.norm();
        (norm.is_finite() && norm > 0.0).then(|| direction / norm)
    }
}
