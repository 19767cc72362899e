//! What a scanner's data sheet says about the points' covariance: range, two angles, station.

use nalgebra::{Matrix3, Vector3};

use crate::error::{Error, Result};

/// Independent errors of range and of the horizontal and vertical angle, seen from one station. The vertical axis is +z.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ScannerModel {
    /// Where the scanner stood, world frame.
    pub station: Vector3<f64>,
    /// Of the range, metres.
    pub sigma_range: f64,
    /// Of the horizontal angle, radians.
    pub sigma_horizontal: f64,
    /// Of the vertical angle, radians.
    pub sigma_vertical: f64,
}

impl ScannerModel {
    /// Checked: finite, and not negative.
    pub fn new(station: [f64; 3], sigma_range: f64, sigma_horizontal: f64, sigma_vertical: f64) -> Result<Self> {
        for (name, value) in
            [("range", sigma_range), ("horizontal angle", sigma_horizontal), ("vertical angle", sigma_vertical)]
        {
            if !(value >= 0.0 && value.is_finite()) {
                return Err(Error::invalid(format!(
                    "the scanner's sigma of the {name} is {value}: it is not negative"
                )));
            }
        }
        if !station.iter().all(|v| v.is_finite()) {
            return Err(Error::invalid("the scanner's station is not finite"));
        }
        Ok(Self { station: Vector3::from(station), sigma_range, sigma_horizontal, sigma_vertical })
    }

    /// The three directions in which the errors act, each as long as one sigma of the position; zeros at the station.
    #[inline]
    pub fn error_axes(&self, xyz: &[f64; 3]) -> [Vector3<f64>; 3] {
        let d = Vector3::from(*xyz) - self.station;
        let range = d.norm();
        if range == 0.0 {
            return [Vector3::zeros(); 3];
        }
        let e = d / range;
        let level = d.x.hypot(d.y);
        let h = if level > 1e-12 * range { Vector3::new(-d.y, d.x, 0.0) / level } else { Vector3::x() };
        // A horizontal angle moves a point along its circle of latitude.
        [e * self.sigma_range, h * (level * self.sigma_horizontal), e.cross(&h) * (range * self.sigma_vertical)]
    }

    /// The covariance of a point, m².
    pub fn covariance(&self, xyz: &[f64; 3]) -> [[f64; 3]; 3] {
        let sum: Matrix3<f64> = self.error_axes(xyz).iter().map(|a| a * a.transpose()).sum();
        std::array::from_fn(|i| std::array::from_fn(|j| sum[(i, j)]))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_act_along_the_beam_and_across() {
        let scanner = ScannerModel::new([1.0, 2.0, 3.0], 0.005, 1e-4, 2e-4).unwrap();
        let c = scanner.covariance(&[21.0, 2.0, 3.0]);
        let expected = [0.005f64.powi(2), (20.0f64 * 1e-4).powi(2), (20.0f64 * 2e-4).powi(2)];
        for i in 0..3 {
            for j in 0..3 {
                assert!((c[i][j] - if i == j { expected[i] } else { 0.0 }).abs() < 1e-15);
            }
        }
    }

    #[test]
    fn the_covariance_is_that_of_the_polar_coordinates() {
        // Differences of the polar map against the axes.
        let scanner = ScannerModel::new([0.5, -1.0, 2.0], 1.0, 1.0, 1.0).unwrap();
        let xyz = [4.0, 3.0, 7.0];
        let d = Vector3::from(xyz) - scanner.station;
        let (range, azimuth, elevation) = (d.norm(), d.y.atan2(d.x), d.z.atan2(d.x.hypot(d.y)));
        let at = |r: f64, a: f64, e: f64| Vector3::new(r * e.cos() * a.cos(), r * e.cos() * a.sin(), r * e.sin());
        let h = 1e-6;
        let numeric = [
            (at(range + h, azimuth, elevation) - at(range - h, azimuth, elevation)) / (2.0 * h),
            (at(range, azimuth + h, elevation) - at(range, azimuth - h, elevation)) / (2.0 * h),
            (at(range, azimuth, elevation + h) - at(range, azimuth, elevation - h)) / (2.0 * h),
        ];
        for (axis, n) in scanner.error_axes(&xyz).iter().zip(numeric) {
            assert!((axis - n).norm().min((axis + n).norm()) < 1e-8);
        }
        assert!(ScannerModel::new([0.0; 3], -1.0, 0.0, 0.0).is_err());
    }
}
