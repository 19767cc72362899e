//! The position error of a point's colour: view, scan and pixel noise carried to the surface.
//!
//! ```text
//! Σ_xy = J_u Σ_u J_uᵀ + J_X Σ_X J_Xᵀ + Σ_image
//! ```
//! is moved along the ray onto the tangent plane of the surface. A shift b of the ray's point, in any direction, becomes
//! `M b` with `M = I − d nᵀ / (n · d)`, for a ray d and a normal n; without a normal the plane perpendicular to the ray
//! stands in. The figure is one sigma per axis, √(trace / 2): of the errors of a circular normal distribution 39, 86 and
//! 99 % lie inside 1, 2 and 3 of it.
//!
//! [`SurfaceSigma::exact`] is that formula; [`SurfaceSigma::fill`] is fast enough for every point of a cloud and agrees
//! with it to [`TOLERANCE`](super::sigma_tables::TOLERANCE).

use std::sync::OnceLock;

use nalgebra::{Matrix2, Matrix2x3, Matrix3, Vector3};
use rayon::prelude::*;

use super::error_map::across_the_ray;
use super::scanner::ScannerModel;
use super::sigma_blocks::{BLOCK, Room, fill_block, is_direction};
use super::sigma_tables::{Cell, Face, make_faces};
use super::view_covariance::ViewCovariance;
use crate::error::{Error, Result};
use crate::geometry::{Pose, View};
use crate::render::LocalPlanes;

/// At a more grazing angle than this cosine the figure stays as it is.
pub(super) const MIN_COSINE: f64 = 1e-3;
/// Blocks per task.
const BLOCKS: usize = 32;

/// The errors of the points themselves.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum ObjectNoise {
    /// The same sigma in every direction, metres.
    Isotropic(f64),
    /// Range and angles of a scanner.
    Scanner(ScannerModel),
}

/// What is known of the surfaces' slopes. A point's own normal counts before the plane at its place; where there is neither
/// the surface is taken as facing the camera.
#[derive(Debug, Clone, Copy, Default)]
pub struct Slopes<'a> {
    /// One for each point, world frame, of any length; without length for none.
    pub normals: Option<&'a [[f64; 3]]>,
    /// What the view's depth buffer says.
    pub planes: Option<&'a LocalPlanes>,
}

impl<'a> Slopes<'a> {
    /// With the points' own normals alone.
    pub fn of(normals: Option<&'a [[f64; 3]]>) -> Self {
        Self { normals, planes: None }
    }

    /// The normal at the point of this number, in the world frame.
    pub(super) fn normal(&self, pose: &Pose, i: usize, xyz: &[f64; 3]) -> Option<[f64; 3]> {
        let own = self.normals.map(|normals| normals[i]).filter(|n| is_direction(n.map(|x| x as f32)));
        own.or_else(|| {
            let q = pose.transform(xyz).map(|x| x as f32);
            let n = self.planes?.normal(q.into())?;
            Some((pose.rotation.transpose() * Vector3::from(n.map(f64::from))).into())
        })
    }

    fn fits(&self, n: usize) -> bool {
        self.normals.is_none_or(|normals| normals.len() == n)
    }
}

/// The colour position error over a cloud, for one view.
#[derive(Debug, Clone)]
pub struct SurfaceSigma {
    pub(super) view: View,
    pub(super) covariance: ViewCovariance,
    pub(super) image_variance: f64,
    pub(super) object: ObjectNoise,
    /// Made when many points are first asked for: the formula alone needs none.
    faces: OnceLock<Vec<Face>>,
}

impl SurfaceSigma {
    /// `sigma_image`: of the pixel position where the colour is taken, px.
    pub fn new(view: &View, covariance: &ViewCovariance, sigma_image: f64, object: ObjectNoise) -> Result<Self> {
        let object_sigma = if let ObjectNoise::Isotropic(s) = object { s } else { 0.0 };
        for (name, value) in [("sigma_image", sigma_image), ("sigma_xyz", object_sigma)] {
            if !(value >= 0.0 && value.is_finite()) {
                return Err(Error::invalid(format!("{name} is {value}: it is not negative")));
            }
        }
        let image_variance = sigma_image * sigma_image;
        Ok(Self { view: *view, covariance: covariance.clone(), image_variance, object, faces: OnceLock::new() })
    }

    /// The tables. Made without holding the lock: their making is parallel, and a worker that steals a task which asks
    /// for them again would wait for itself. Two that come at once make the same tables; one is kept.
    fn faces(&self) -> &[Face] {
        if let Some(faces) = self.faces.get() {
            return faces;
        }
        let made = make_faces(&self.view, &self.covariance, self.image_variance);
        self.faces.get_or_init(|| made)
    }

    /// The tables, and an error where the planes lie on other faces: those of another camera would be taken for these.
    fn faces_for(&self, slopes: Slopes<'_>) -> Result<&[Face]> {
        let faces = self.faces();
        match slopes.planes.map(LocalPlanes::count) {
            Some(count) if count != faces.len() => {
                let other = if count == 1 { "forward" } else { "around" };
                Err(Error::invalid(format!("the planes are of another view, whose camera looks {other}")))
            }
            _ => Ok(faces),
        }
    }

    /// One sigma per axis on the surface, in the world's unit; NaN where the view does not see the point. A normal
    /// without length counts as none.
    pub fn exact(&self, xyz: &[f64; 3], normal: Option<&[f64; 3]>) -> f64 {
        let Some(j) = self.view.project_with_jacobian(xyz) else { return f64::NAN };
        let pixel = self.covariance.pixel_covariance(&self.view, &j) + Matrix2::identity() * self.image_variance;
        let arm = Vector3::from(*xyz) - self.view.pose.centre;
        let d = arm.normalize();
        let j_x = Matrix2x3::from_fn(|i, k| j.d_xyz[i][k]);
        let Some(across) = across_the_ray(&pixel, &j_x, &d) else { return f64::NAN };
        let n = unit_normal(normal).unwrap_or(d);
        let cosine = n.dot(&d);
        let cosine = if cosine.abs() >= MIN_COSINE { cosine } else { MIN_COSINE.copysign(cosine) };
        let m = Matrix3::identity() - d * n.transpose() / cosine;
        let point = match self.object {
            ObjectNoise::Isotropic(s) => Matrix3::identity() * (s * s),
            ObjectNoise::Scanner(scanner) => {
                let c = scanner.covariance(xyz);
                Matrix3::from_fn(|i, k| c[i][k])
            }
        };
        (0.5 * (m * (across + point) * m.transpose()).trace()).max(0.0).sqrt()
    }

    /// The share of the photo's table cells that use the exact formula.
    pub fn exact_share(&self) -> f64 {
        let count = |kind: Cell| self.faces().iter().map(|f| f.count(kind)).sum::<usize>() as f64;
        let exact = count(Cell::Exact);
        exact / (exact + count(Cell::Interpolated)).max(1.0)
    }

    /// One sigma per axis on the surface for every point, in parallel, into the caller's array; NaN outside the photo.
    pub fn fill(&self, xyz: &[[f64; 3]], slopes: Slopes<'_>, out: &mut [f32]) -> Result<()> {
        if out.len() != xyz.len() || !slopes.fits(xyz.len()) {
            return Err(Error::invalid(format!(
                "{} points with {} normals and room for {} sigmas",
                xyz.len(),
                slopes.normals.map_or(0, <[_]>::len),
                out.len()
            )));
        }
        let faces = self.faces_for(slopes)?;
        out.par_chunks_mut(BLOCKS * BLOCK).enumerate().for_each(|(task, out)| {
            let (mut first, mut room) = (task * BLOCKS * BLOCK, Room::new());
            for out in out.chunks_mut(BLOCK) {
                let here = first..first + out.len();
                first = here.end;
                let normals = slopes.normals.map(|n| &n[here.clone()]);
                fill_block(self, faces, &mut room, &xyz[here], Slopes { normals, ..slopes }, out);
            }
        });
        Ok(())
    }

    /// As [`SurfaceSigma::fill`], only for the points whose source is `number`: those that this view coloured. Rounded
    /// to eight binary places, 0.2 %: below what the figure means, and files of such numbers pack to a fifth.
    pub fn fill_where(
        &self,
        xyz: &[[f64; 3]],
        slopes: Slopes<'_>,
        source: &[u16],
        number: u16,
        out: &mut [f32],
    ) -> Result<()> {
        if source.len() != xyz.len() || out.len() != xyz.len() || !slopes.fits(xyz.len()) {
            return Err(Error::invalid(format!(
                "{} points with {} sources, {} normals and room for {} sigmas",
                xyz.len(),
                source.len(),
                slopes.normals.map_or(0, <[_]>::len),
                out.len()
            )));
        }
        let faces = self.faces_for(slopes)?;
        out.par_chunks_mut(BLOCKS * BLOCK).enumerate().for_each(|(task, out)| {
            let first = task * BLOCKS * BLOCK;
            let mut room = Room::new();
            let mut fill = |xyz: &[[f64; 3]], normals: Option<&[[f64; 3]]>, out: &mut [f32]| {
                fill_block(self, faces, &mut room, xyz, Slopes { normals, ..slopes }, out);
                out.iter_mut().for_each(|value| *value = stored(*value));
            };
            // Of blocks that are the view's in part points are kept until they fill one.
            let (mut kept, mut points, mut turned) = ([0usize; BLOCK], [[0.0; 3]; BLOCK], [[0.0; 3]; BLOCK]);
            let mut n = 0;
            for start in (0..out.len()).step_by(BLOCK) {
                let end = out.len().min(start + BLOCK);
                let here = first + start..first + end;
                let mine = source[here.clone()].iter().filter(|&&source| source == number).count();
                if mine == here.len() {
                    fill(&xyz[here.clone()], slopes.normals.map(|normals| &normals[here]), &mut out[start..end]);
                    continue;
                }
                for at in (start..end).filter(|at| mine > 0 && source[first + at] == number) {
                    (kept[n], points[n]) = (at, xyz[first + at]);
                    if let Some(normals) = slopes.normals {
                        turned[n] = normals[first + at];
                    }
                    n += 1;
                    if n == BLOCK {
                        scatter(&mut fill, &kept, &points, slopes.normals.map(|_| &turned[..]), out);
                        n = 0;
                    }
                }
            }
            if n > 0 {
                scatter(&mut fill, &kept[..n], &points[..n], slopes.normals.map(|_| &turned[..n]), out);
            }
        });
        Ok(())
    }
}

/// The figures of points that do not stand side by side.
fn scatter(
    fill: &mut impl FnMut(&[[f64; 3]], Option<&[[f64; 3]]>, &mut [f32]),
    places: &[usize],
    points: &[[f64; 3]],
    normals: Option<&[[f64; 3]]>,
    out: &mut [f32],
) {
    let mut found = [0.0; BLOCK];
    let found = &mut found[..places.len()];
    fill(points, normals, found);
    for (place, value) in places.iter().zip(found) {
        out[*place] = *value;
    }
}

/// The nearest number whose last fifteen bits are zero.
fn stored(value: f32) -> f32 {
    const DROPPED: u32 = 15;
    if !value.is_finite() {
        return value;
    }
    let half = 1 << (DROPPED - 1);
    f32::from_bits(value.to_bits().saturating_add(half) >> DROPPED << DROPPED)
}

fn unit_normal(normal: Option<&[f64; 3]>) -> Option<Vector3<f64>> {
    let n = Vector3::from(*normal?);
    let length = n.norm();
    (length > 0.0 && length.is_finite()).then(|| n / length)
}

#[cfg(test)]
mod tests {
    use super::stored;

    #[test]
    fn stored_numbers_are_the_nearest_of_eight_binary_places() {
        for k in 1..20_000 {
            let x = 1e-4 * 1.001f32.powi(k % 9000);
            let y = stored(x);
            assert!((y / x - 1.0).abs() <= 1.0 / 512.0 && y.to_bits() & 0x7fff == 0, "{x} {y}");
            assert_eq!(stored(y), y);
        }
        assert!(stored(f32::NAN).is_nan());
        assert_eq!(stored(0.0), 0.0);
        assert_eq!(stored(1.999_9), 2.0);
    }
}
