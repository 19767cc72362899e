//! The equidistant fisheye with four odd terms, as OpenCV's `fisheye` module defines it:
//! θd = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸), the image radius is θd.
//!
//! Source: Kannala and Brandt, A generic camera model and calibration method, 2006.

use std::f64::consts::PI;

use super::roots::first_positive_crossing;

#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Fisheye {
    pub k: [f64; 4],
    /// θ up to which θd grows, π at most.
    pub max_theta: f64,
}

impl Fisheye {
    pub fn new(k: [f64; 4]) -> Self {
        let fold = first_positive_crossing(&[1.0, 3.0 * k[0], 5.0 * k[1], 7.0 * k[2], 9.0 * k[3]]);
        Self { k, max_theta: fold.map_or(PI, |s| s.sqrt().min(PI)) }
    }

    #[inline(always)]
    pub fn distort(&self, theta: f64) -> f64 {
        let [k1, k2, k3, k4] = self.k;
        let s = theta * theta;
        theta * (1.0 + s * (k1 + s * (k2 + s * (k3 + s * k4))))
    }

    #[inline(always)]
    pub fn slope(&self, theta: f64) -> f64 {
        let [k1, k2, k3, k4] = self.k;
        let s = theta * theta;
        1.0 + s * (3.0 * k1 + s * (5.0 * k2 + s * (7.0 * k3 + s * 9.0 * k4)))
    }

    /// The angle whose image radius is `theta_d`; `None` beyond the valid field.
    pub fn undistort(&self, theta_d: f64) -> Option<f64> {
        let (mut low, mut high) = (0.0, self.max_theta);
        let inside = theta_d <= self.distort(high);
        if !inside {
            return None;
        }
        let mut theta = theta_d.min(high);
        for _ in 0..100 {
            let value = self.distort(theta) - theta_d;
            if value > 0.0 {
                high = theta
            } else {
                low = theta
            }
            let slope = self.slope(theta);
            let newton = theta - value / slope;
            let next = if slope > 0.0 && newton >= low && newton <= high { newton } else { 0.5 * (low + high) };
            if (next - theta).abs() <= 2e-16 * (1.0 + theta) {
                return Some(next);
            }
            theta = next;
        }
        Some(theta)
    }
}
