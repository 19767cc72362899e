//! What a view's uncertainty does over the whole photo: picks in the middle say little about the corners.

use nalgebra::{Matrix2, Matrix2x3, Matrix3, Vector3};
use rayon::prelude::*;

use super::view_covariance::ViewCovariance;
use crate::error::{Error, Result};
use crate::geometry::{Depth, View, tangents};

/// The predicted error of one place of the photo at one depth, by the view's covariance alone.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PredictedError {
    /// The pixel.
    pub xy: [f64; 2],
    /// The point of the world behind it at the depth asked for.
    pub xyz: [f64; 3],
    /// J Σ Jᵀ, px²; NaN where the pixel sees nothing.
    pub covariance: Matrix2<f64>,
    /// √(trace / 2), px: one sigma per axis.
    pub sigma_px: f64,
    /// The longer half-axis of the error ellipse, px.
    pub largest_px: f64,
    /// One sigma per axis, perpendicular to the ray, in the world's unit.
    pub sigma_object: f64,
    /// The same as an angle, radians.
    pub sigma_angle: f64,
}

/// Pixels at the centres of `columns` × `rows` equal fields and, with `to_the_border`, spread from border to border.
pub fn photo_grid(view: &View, columns: usize, rows: usize, to_the_border: bool) -> Vec<[f64; 2]> {
    let place = |i: usize, n: usize, size: u32| {
        let size = f64::from(size);
        if to_the_border && n > 1 {
            i as f64 / (n - 1) as f64 * (size - 1.0)
        } else {
            (i as f64 + 0.5) / n as f64 * size - 0.5
        }
    };
    (0..rows)
        .flat_map(|j| (0..columns).map(move |i| (i, j)))
        .map(|(i, j)| [place(i, columns, view.camera.width), place(j, rows, view.camera.height)])
        .collect()
}

/// The world point behind a pixel at a depth (along the axis, or the range, as the camera defines it).
pub fn at_depth(view: &View, xy: &[f64; 2], depth: f64) -> Option<[f64; 3]> {
    let ray = view.ray(xy)?;
    let along = match view.camera.depth_kind() {
        Depth::AlongAxis => (view.pose.rotation * ray).z,
        Depth::Range => 1.0,
    };
    (along > 0.0).then(|| (view.pose.centre + ray * (depth / along)).into())
}

/// The error of a pixel carried to the plane perpendicular to its ray: the 3×3 covariance of rank two, in the world frame.
pub(super) fn across_the_ray(
    pixel: &Matrix2<f64>,
    d_xyz: &Matrix2x3<f64>,
    direction: &Vector3<f64>,
) -> Option<Matrix3<f64>> {
    let (e1, e2) = tangents(direction);
    let basis = nalgebra::Matrix3x2::from_columns(&[e1, e2]);
    let to_object = basis * (d_xyz * basis).try_inverse()?;
    Some(to_object * pixel * to_object.transpose())
}

/// The predicted errors of pixels, all at one depth.
pub fn predicted_errors(
    view: &View,
    covariance: &ViewCovariance,
    pixels: &[[f64; 2]],
    depth: f64,
) -> Result<Vec<PredictedError>> {
    if !(depth > 0.0 && depth.is_finite()) {
        return Err(Error::invalid(format!("a depth of {depth} is not possible: it is positive")));
    }
    let one = |xy: &[f64; 2]| {
        let nothing = PredictedError {
            xy: *xy,
            xyz: [f64::NAN; 3],
            covariance: Matrix2::repeat(f64::NAN),
            sigma_px: f64::NAN,
            largest_px: f64::NAN,
            sigma_object: f64::NAN,
            sigma_angle: f64::NAN,
        };
        let Some(xyz) = at_depth(view, xy, depth) else { return nothing };
        let Some(j) = view.project_with_jacobian(&xyz) else { return PredictedError { xyz, ..nothing } };
        let pixel = covariance.pixel_covariance(view, &j);
        let arm = Vector3::from(xyz) - view.pose.centre;
        let range = arm.norm();
        let across = across_the_ray(&pixel, &Matrix2x3::from_fn(|i, k| j.d_xyz[i][k]), &(arm / range));
        let sigma_object = across.map_or(f64::NAN, |s| (0.5 * s.trace()).max(0.0).sqrt());
        let half = 0.5 * (pixel[(0, 0)] - pixel[(1, 1)]);
        let mean = 0.5 * pixel.trace();
        PredictedError {
            xy: *xy,
            xyz,
            covariance: pixel,
            sigma_px: mean.max(0.0).sqrt(),
            largest_px: (mean + half.hypot(pixel[(0, 1)])).max(0.0).sqrt(),
            sigma_object,
            sigma_angle: sigma_object / range,
        }
    };
    Ok(pixels.par_iter().with_min_len(32).map(one).collect())
}
