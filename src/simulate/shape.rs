//! The primitives of a scene and their exact intersection with rays, in float64.

use nalgebra::Vector3;

use crate::geometry::tangents;

/// What outline a primitive has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outline {
    /// All of `origin + a u + b v`, a and b in [0, 1].
    Parallelogram,
    /// The half of it with a + b ≤ 1.
    Triangle,
    /// The ellipse about `origin` with the semi-axes `u` and `v`.
    Ellipse,
    /// A leaf about `origin`: pointed at both ends of `u`, with the half width `v`.
    Leaf,
    /// The mantle of a cone frustum from `origin` along `u`, radii `v[0]` at the foot and `v[1]` at the head; not capped.
    Frustum,
    /// The sphere about `origin` with radius `v[0]`.
    Sphere,
}

impl Outline {
    /// The outline with this number in the order of the declaration.
    pub fn from_number(number: i64) -> Option<Self> {
        Some(match number {
            0 => Self::Parallelogram,
            1 => Self::Triangle,
            2 => Self::Ellipse,
            3 => Self::Leaf,
            4 => Self::Frustum,
            5 => Self::Sphere,
            _ => return None,
        })
    }
}

/// A surface patch, with what its intersection needs worked out beforehand.
#[derive(Clone, Debug)]
pub struct Primitive {
    /// What outline it has.
    pub outline: Outline,
    /// Its corner, centre or foot.
    pub origin: Vector3<f64>,
    /// First edge, semi-axis or axis.
    pub u: Vector3<f64>,
    /// Second edge or semi-axis, or the radii.
    pub v: Vector3<f64>,
    /// Surface coordinates, metres, of the origin.
    pub uv: [f64; 2],
    /// Number of its material.
    pub material: u32,
    /// Plane: unit normal, u × v. Frustum: unit axis. Sphere: not used.
    axis: Vector3<f64>,
    /// Plane: the dual vectors, so that a = (p − origin)·dual[0]. Frustum: two unit vectors across the axis.
    dual: [Vector3<f64>; 2],
    /// |u| and |v|.
    lengths: [f64; 2],
}

impl Primitive {
    /// The primitive; `None` when its vectors span no surface.
    pub fn new(
        outline: Outline,
        origin: Vector3<f64>,
        u: Vector3<f64>,
        v: Vector3<f64>,
        uv: [f64; 2],
        material: u32,
    ) -> Option<Self> {
        let finite = [origin, u, v].iter().all(|x| x.iter().all(|c| c.is_finite()));
        if !finite {
            return None;
        }
        let (axis, dual) = match outline {
            Outline::Sphere => {
                if v.x <= 0.0 {
                    return None;
                }
                (Vector3::z(), [Vector3::x(), Vector3::y()])
            }
            Outline::Frustum => {
                let axis = u.try_normalize(1e-12)?;
                if v.x < 0.0 || v.y < 0.0 || v.x + v.y <= 0.0 {
                    return None;
                }
                let (first, second) = tangents(&axis);
                (axis, [first, second])
            }
            _ => {
                let normal = u.cross(&v);
                let axis = normal.try_normalize(1e-14)?;
                let area2 = normal.norm_squared();
                (axis, [v.cross(&normal) / area2, normal.cross(&u) / area2])
            }
        };
        Some(Self { outline, origin, u, v, uv, material, axis, dual, lengths: [u.norm(), v.norm()] })
    }

    /// The box around it: minimum and maximum corner.
    pub fn bounds(&self) -> (Vector3<f64>, Vector3<f64>) {
        match self.outline {
            Outline::Parallelogram | Outline::Triangle => {
                let corners = [self.origin, self.origin + self.u, self.origin + self.v, self.origin + self.u + self.v];
                let last = if self.outline == Outline::Triangle { 3 } else { 4 };
                corners[1..last].iter().fold((corners[0], corners[0]), |(lo, hi), c| (lo.inf(c), hi.sup(c)))
            }
            Outline::Ellipse | Outline::Leaf => {
                let half = self.u.component_mul(&self.u) + self.v.component_mul(&self.v);
                let half = half.map(f64::sqrt);
                (self.origin - half, self.origin + half)
            }
            Outline::Frustum => {
                let r = self.axis.map(|c| (1.0 - c * c).max(0.0).sqrt());
                let head = self.origin + self.u;
                (
                    (self.origin - r * self.v.x).inf(&(head - r * self.v.y)),
                    (self.origin + r * self.v.x).sup(&(head + r * self.v.y)),
                )
            }
            Outline::Sphere => (self.origin.add_scalar(-self.v.x), self.origin.add_scalar(self.v.x)),
        }
    }

    /// The smallest distance along the ray, within (`near`, `far`), at which it meets the primitive.
    #[inline]
    pub fn intersect(&self, from: &Vector3<f64>, ray: &Vector3<f64>, near: f64, far: f64) -> Option<f64> {
        match self.outline {
            Outline::Frustum => self.intersect_frustum(from, ray, near, far),
            Outline::Sphere => {
                let o = from - self.origin;
                let (a, b) = (ray.norm_squared(), o.dot(ray));
                let c = o.norm_squared() - self.v.x * self.v.x;
                let root = (b * b - a * c).max(-1.0);
                if root < 0.0 {
                    return None;
                }
                let root = root.sqrt();
                [(-b - root) / a, (-b + root) / a].into_iter().find(|&t| t > near && t < far)
            }
            _ => {
                let slope = self.axis.dot(ray);
                if slope == 0.0 {
                    return None;
                }
                let t = self.axis.dot(&(self.origin - from)) / slope;
                if !(t > near && t < far) {
                    return None;
                }
                let p = from + ray * t - self.origin;
                let (a, b) = (p.dot(&self.dual[0]), p.dot(&self.dual[1]));
                let inside = match self.outline {
                    Outline::Parallelogram => (0.0..=1.0).contains(&a) && (0.0..=1.0).contains(&b),
                    Outline::Triangle => a >= 0.0 && b >= 0.0 && a + b <= 1.0,
                    Outline::Ellipse => a * a + b * b <= 1.0,
                    _ => a.abs() <= 1.0 && b.abs() <= 1.0 - a * a,
                };
                inside.then_some(t)
            }
        }
    }

    fn intersect_frustum(&self, from: &Vector3<f64>, ray: &Vector3<f64>, near: f64, far: f64) -> Option<f64> {
        let o = from - self.origin;
        let (height, foot) = (self.lengths[0], self.v.x);
        let taper = (self.v.y - foot) / height;
        let (oh, rh) = (o.dot(&self.axis), ray.dot(&self.axis));
        let (oa, ra) = (o - self.axis * oh, ray - self.axis * rh);
        let (or, rr) = (foot + taper * oh, taper * rh);
        let a = ra.norm_squared() - rr * rr;
        let b = oa.dot(&ra) - or * rr;
        let c = oa.norm_squared() - or * or;
        let root = b * b - a * c;
        if root < 0.0 || a == 0.0 {
            return None;
        }
        let root = root.sqrt();
        let (t0, t1) = ((-b - root) / a, (-b + root) / a);
        let on_mantle = |t: f64| t > near && t < far && (0.0..=height).contains(&(oh + rh * t)) && or + rr * t >= 0.0;
        [t0.min(t1), t0.max(t1)].into_iter().find(|&t| on_mantle(t))
    }

    /// The outward unit normal at a point of the surface (u × v for planes, away from the axis or centre otherwise).
    #[inline]
    pub fn normal(&self, point: &Vector3<f64>) -> Vector3<f64> {
        match self.outline {
            Outline::Sphere => (point - self.origin) / self.v.x,
            Outline::Frustum => {
                let p = point - self.origin;
                let across = p - self.axis * p.dot(&self.axis);
                let taper = (self.v.y - self.v.x) / self.lengths[0];
                let radius = across.norm().max(1e-12);
                (across / radius - self.axis * taper).normalize()
            }
            _ => self.axis,
        }
    }

    /// Surface coordinates in metres: along u and v; around and along a frustum; on a sphere length and height angle.
    #[inline]
    pub fn surface_coordinates(&self, point: &Vector3<f64>) -> [f64; 2] {
        let p = point - self.origin;
        let (a, b) = match self.outline {
            Outline::Sphere => (p.y.atan2(p.x) * self.v.x, (p.z / self.v.x).clamp(-1.0, 1.0).asin() * self.v.x),
            Outline::Frustum => {
                let angle = p.dot(&self.dual[1]).atan2(p.dot(&self.dual[0]));
                (angle * 0.5 * (self.v.x + self.v.y), p.dot(&self.axis))
            }
            _ => (p.dot(&self.dual[0]) * self.lengths[0], p.dot(&self.dual[1]) * self.lengths[1]),
        };
        [a + self.uv[0], b + self.uv[1]]
    }

    /// Length of the grid's two directions over the surface, metres.
    pub fn grid_lengths(&self) -> [f64; 2] {
        match self.outline {
            Outline::Ellipse | Outline::Leaf => self.lengths.map(|length| 2.0 * length),
            Outline::Frustum => [6.3 * self.v.x.max(self.v.y), self.lengths[0]],
            Outline::Sphere => [6.3 * self.v.x, 3.1 * self.v.x],
            _ => self.lengths,
        }
    }

    /// Number of nodes, about `spacing` metres apart, of a grid over the surface.
    pub fn grid_size(&self, spacing: f64, most: usize) -> [usize; 2] {
        let nodes = self.grid_lengths().map(|length| {
            if length < 0.5 * spacing { 1 } else { ((length / spacing).round() as usize + 1).clamp(2, most) }
        });
        match self.outline {
            Outline::Leaf => [1, 1],
            Outline::Frustum => [nodes[0].max(6), nodes[1]],
            Outline::Sphere => [8, 5],
            _ => nodes,
        }
    }

    /// The point at grid coordinates in [0, 1]²; inverse of [`Self::grid_coordinates`].
    pub fn grid_point(&self, g: [f64; 2]) -> Vector3<f64> {
        use std::f64::consts::{PI, TAU};
        match self.outline {
            Outline::Ellipse | Outline::Leaf => {
                let (a, b) = (2.0 * g[0] - 1.0, 2.0 * g[1] - 1.0);
                // Corners of the square about an ellipse are drawn in: a grid node has to lie on the surface.
                let shrink = (a * a + b * b).sqrt().max(1.0) * (1.0 + 1e-9);
                self.origin + self.u * (a / shrink) + self.v * (b / shrink)
            }
            Outline::Frustum => {
                let (sin, cos) = (TAU * g[0] - PI).sin_cos();
                let radius = self.v.x + (self.v.y - self.v.x) * g[1];
                self.origin + self.u * g[1] + (self.dual[0] * cos + self.dual[1] * sin) * radius
            }
            Outline::Sphere => {
                let (sl, cl) = (TAU * g[0] - PI).sin_cos();
                let (sh, ch) = (PI * (g[1] - 0.5)).sin_cos();
                self.origin + Vector3::new(ch * cl, ch * sl, sh) * self.v.x
            }
            Outline::Triangle if g[0] + g[1] > 1.0 => {
                // Just inside the long edge: on it, rounding decides.
                let excess = 0.5 * (g[0] + g[1] - 1.0 + 1e-9);
                self.origin + self.u * (g[0] - excess) + self.v * (g[1] - excess)
            }
            _ => self.origin + self.u * g[0] + self.v * g[1],
        }
    }

    /// Where a point of the surface lies on the grid, each in [0, 1].
    #[inline]
    pub fn grid_coordinates(&self, point: &Vector3<f64>) -> [f64; 2] {
        use std::f64::consts::{FRAC_1_PI, PI, TAU};
        let p = point - self.origin;
        match self.outline {
            Outline::Ellipse | Outline::Leaf => {
                [0.5 * (p.dot(&self.dual[0]) + 1.0), 0.5 * (p.dot(&self.dual[1]) + 1.0)]
            }
            Outline::Frustum => {
                let angle = p.dot(&self.dual[1]).atan2(p.dot(&self.dual[0]));
                [(angle + PI) / TAU, p.dot(&self.axis) / self.lengths[0]]
            }
            Outline::Sphere => {
                let height = (p.z / self.v.x).clamp(-1.0, 1.0).asin();
                [(p.y.atan2(p.x) + PI) / TAU, height * FRAC_1_PI + 0.5]
            }
            _ => [p.dot(&self.dual[0]), p.dot(&self.dual[1])],
        }
    }

    /// Whether the first grid coordinate runs around, so that its ends meet.
    pub fn is_round(&self) -> bool {
        matches!(self.outline, Outline::Frustum | Outline::Sphere)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn every_outline() -> Vec<Primitive> {
        let o = Vector3::new(0.3, -0.2, 0.1);
        let (u, v) = (Vector3::new(1.2, 0.1, 0.2), Vector3::new(-0.1, 0.8, 0.5));
        let radii = Vector3::new(0.6, 0.35, 0.0);
        [
            (Outline::Parallelogram, v),
            (Outline::Triangle, v),
            (Outline::Ellipse, v),
            (Outline::Leaf, v),
            (Outline::Frustum, radii),
            (Outline::Sphere, radii),
        ]
        .into_iter()
        .filter_map(|(outline, v)| Primitive::new(outline, o, u, v, [0.0, 0.0], 0))
        .collect()
    }

    #[test]
    fn a_ray_to_a_grid_point_meets_the_surface_there() {
        for primitive in every_outline() {
            for i in 0..64 {
                let g = [f64::from(i % 8) / 8.0 + 0.06, f64::from(i / 8) / 8.0 + 0.06];
                if primitive.outline == Outline::Leaf {
                    continue;
                }
                let p = primitive.grid_point(g);
                let n = primitive.normal(&p);
                let from = p + n * 0.05;
                let t = primitive.intersect(&from, &(p - from), 0.0, 2.0);
                let t = t.unwrap_or_else(|| panic!("{:?} missed at {g:?}", primitive.outline));
                assert!((t - 1.0).abs() < 1e-9, "{:?}: {t}", primitive.outline);
                let (lo, hi) = primitive.bounds();
                assert!((p - lo).min() > -1e-9 && (hi - p).min() > -1e-9);
            }
        }
    }

    #[test]
    fn grid_coordinates_invert_grid_points() {
        for primitive in every_outline() {
            for g in [[0.3, 0.4], [0.55, 0.2], [0.42, 0.53]] {
                let back = primitive.grid_coordinates(&primitive.grid_point(g));
                assert!((back[0] - g[0]).abs() < 1e-9 && (back[1] - g[1]).abs() < 1e-9, "{:?}", primitive.outline);
            }
        }
    }

    proptest! {
        #[test]
        fn hits_lie_on_the_surface(o in prop::array::uniform3(-3.0..3.0_f64), d in prop::array::uniform3(-1.0..1.0_f64)) {
            let (from, ray) = (Vector3::from(o), Vector3::from(d));
            prop_assume!(ray.norm() > 0.1);
            for primitive in every_outline() {
                if let Some(t) = primitive.intersect(&from, &ray, 1e-9, f64::INFINITY) {
                    let p = from + ray * t;
                    let off = match primitive.outline {
                        Outline::Sphere => (p - primitive.origin).norm() - primitive.v.x,
                        Outline::Frustum => {
                            let q = p - primitive.origin;
                            let h = q.dot(&primitive.axis);
                            let radius = primitive.v.x + (primitive.v.y - primitive.v.x) * h / primitive.lengths[0];
                            (q - primitive.axis * h).norm() - radius
                        }
                        _ => (p - primitive.origin).dot(&primitive.axis),
                    };
                    prop_assert!(off.abs() < 1e-9, "{:?}: {off}", primitive.outline);
                }
            }
        }
    }
}
