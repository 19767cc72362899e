//! The part of space that a photo sees, as half-spaces: whole chunks of points beside it need not be projected.

use nalgebra::Vector3;

use super::camera::{Depth, Model};
use super::view::View;

/// Border pixels looked at along each side: between them a distorted border bends by less than [`SLACK`].
const STEPS: u32 = 64;
/// By how much the field is widened, in normalised coordinates.
const SLACK: f64 = 0.02;

/// Half-spaces through the projection centre that hold all that is visible. A camera that sees beside itself has none.
pub struct Frustum {
    centre: Vector3<f64>,
    /// Inside is where the product with `X − C` is positive.
    inward: Vec<Vector3<f64>>,
}

impl Frustum {
    /// The frustum of a view, widened by a margin of pixels around the photo.
    pub fn new(view: &View, margin: f64) -> Self {
        let camera = &view.camera;
        let mut this = Self { centre: view.pose.centre, inward: Vec::new() };
        if camera.depth_kind() == Depth::Range || camera.model() == Model::Equirectangular {
            return this;
        }
        let edge = camera.max_angle().tan();
        let (w, h) = (f64::from(camera.width), f64::from(camera.height));
        let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        for k in 0..=STEPS {
            let t = f64::from(k) / f64::from(STEPS);
            let (x, y) = (t * (w + 2.0 * margin) - margin - 0.5, t * (h + 2.0 * margin) - margin - 0.5);
            let (last_x, last_y) = (w + margin - 0.5, h + margin - 0.5);
            for xy in [[x, -margin - 0.5], [x, last_y], [-margin - 0.5, y], [last_x, y]] {
                // A border beyond the valid field: that field's edge is the border, in every direction.
                let [u, v] = match camera.unproject(&xy) {
                    Some(d) => [[d.x / d.z; 2], [d.y / d.z; 2]],
                    None => [[-edge, edge]; 2],
                };
                for (k, ends) in [u, v].iter().enumerate() {
                    low[k] = low[k].min(ends[0]);
                    high[k] = high[k].max(ends[1]);
                }
            }
        }
        let mut planes = vec![Vector3::z()];
        for (k, axis) in [Vector3::x(), Vector3::y()].iter().enumerate() {
            for (sign, end) in [(1.0, low[k] - SLACK), (-1.0, high[k] + SLACK)] {
                if end.is_finite() {
                    planes.push((axis - Vector3::z() * end) * sign);
                }
            }
        }
        this.inward = planes.iter().map(|n| view.pose.rotation.transpose() * n).collect();
        this
    }

    /// Whether any point of the smallest box around these points may be visible. Points that are not finite are not.
    pub fn meets(&self, xyz: &[[f64; 3]]) -> bool {
        if self.inward.is_empty() {
            return true;
        }
        let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
        for p in xyz {
            for k in 0..3 {
                // NaN loses both comparisons.
                low[k] = if p[k] < low[k] { p[k] } else { low[k] };
                high[k] = if p[k] > high[k] { p[k] } else { high[k] };
            }
        }
        if low[0] > high[0] || low[1] > high[1] || low[2] > high[2] {
            return false;
        }
        let (low, high) = (Vector3::from(low) - self.centre, Vector3::from(high) - self.centre);
        self.inward.iter().all(|n| (0..3).map(|k| (n[k] * low[k]).max(n[k] * high[k])).sum::<f64>() > 0.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Camera, Pose};

    #[test]
    fn keeps_whatever_has_a_visible_point_and_drops_what_lies_behind_or_beside() {
        let terms = [800.0, 800.0, 500.0, 400.0, -0.2, 0.05, 0.001, -0.001, 0.0];
        let camera = Camera::new(Model::OpenCv, 1000, 800, &terms).unwrap();
        let view = View::new(
            camera,
            Pose {
                rotation: crate::geometry::rotation_exp(&Vector3::new(0.3, 1.0, -0.2)),
                centre: Vector3::new(5e5, 4e6, 100.0),
            },
        );
        let frustum = Frustum::new(&view, 0.0);
        let world =
            |p: [f64; 3]| -> [f64; 3] { (view.pose.rotation.transpose() * Vector3::from(p) + view.pose.centre).into() };
        let mut state = 12345_u64;
        let mut random = || {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (state >> 11) as f64 / (1_u64 << 53) as f64 * 2.0 - 1.0
        };
        let (mut met, mut passed) = (0, 0);
        for _ in 0..8000 {
            let p = world([random() * 20.0, random() * 20.0, random() * 10.0]);
            let q = [p[0] + random(), p[1] + random(), p[2] + random()];
            let seen = [p, q].iter().any(|p| view.project(p).is_some_and(|(xy, _)| camera.contains(&xy)));
            let meets = frustum.meets(&[p, q]);
            assert!(meets || !seen);
            met += usize::from(meets);
            passed += usize::from(seen);
        }
        assert!(passed > 60 && met < passed * 2, "{met} {passed}");
        assert!(!frustum.meets(&[[f64::NAN; 3]]));
    }
}
