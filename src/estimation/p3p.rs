//! The pose from three points and their directions: all solutions, at most four.
//!
//! With unit directions y₁ y₂ y₃ in the camera frame, the distances λ obey λᵢ² + λⱼ² − 2 λᵢλⱼ yᵢ·yⱼ = |Xᵢ − Xⱼ|².
//! Eliminating the constant leaves two homogeneous quadratic forms D₁, D₂ in λ. One real root γ of det(D₁ + γ D₂) = 0
//! makes a degenerate form, a pair of planes; each plane meets D₂ = 0 in at most two rays, and the size of λ follows. The
//! distances are then improved by Newton's method on the three equations, which removes the rounding of the elimination.
//!
//! Source: M. Persson and K. Nordberg, Lambda Twist: an accurate fast robust perspective three point solver, ECCV 2018.
//! Differences: both forms are scaled, the cubic is solved from its larger end, and the rays are found in an orthonormal
//! basis of each plane, so that no configuration divides by a small number.

use nalgebra::{Matrix3, Vector3};

use crate::error::{Error, Result};
use crate::geometry::{Camera, Pose, View};

/// Up to four of something, without an allocation.
#[derive(Debug, Clone, Copy)]
pub struct UpToFour<T> {
    items: [Option<T>; 4],
    count: usize,
}

impl<T: Copy> UpToFour<T> {
    fn new() -> Self {
        Self { items: [None; 4], count: 0 }
    }

    fn push(&mut self, item: T) {
        if self.count < 4 {
            self.items[self.count] = Some(item);
            self.count += 1;
        }
    }

    /// How many there are.
    pub fn len(&self) -> usize {
        self.count
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.count == 0
    }

    /// Each in turn.
    pub fn iter(&self) -> impl Iterator<Item = &T> {
        self.items.iter().flatten()
    }
}

/// Twice the triangle's area over the square of its longest side below which three points count as collinear.
pub const COLLINEAR: f64 = 1e-9;

/// All poses that see the world points `x` in the unit directions `y` of the camera frame.
///
/// Empty where there is none: collinear or coinciding points, directions that no pose fits, values that are not finite.
pub fn p3p(x: &[[f64; 3]; 3], y: &[Vector3<f64>; 3]) -> UpToFour<Pose> {
    let mut poses = UpToFour::new();
    let p = x.map(Vector3::from);
    let (d12, d13, d23) = (p[1] - p[0], p[2] - p[0], p[2] - p[1]);
    let a = [d12.norm_squared(), d13.norm_squared(), d23.norm_squared()];
    let size = a[0].max(a[1]).max(a[2]);
    let enough = d12.cross(&d13).norm() > COLLINEAR * size && size.is_finite();
    if !enough {
        return poses;
    }
    let a = a.map(|v| v / size);
    let unit = size.sqrt();
    for lambda in distances(&a, y).iter() {
        let q = [y[0] * (lambda[0] * unit), y[1] * (lambda[1] * unit), y[2] * (lambda[2] * unit)];
        let (Some(there), Some(here)) = (frame(&d12, &d13), frame(&(q[1] - q[0]), &(q[2] - q[0]))) else { continue };
        let rotation = here * there.transpose();
        // Through the triangle's centre, so that no corner is preferred.
        let third = 1.0 / 3.0;
        let centre = p[0] + (d12 + d13) * third - rotation.tr_mul(&((q[0] + q[1] + q[2]) * third));
        poses.push(Pose { rotation, centre });
    }
    poses
}

/// All views of a camera that see three world points at three pixels.
pub fn views_of_three(camera: &Camera, xyz: &[[f64; 3]; 3], xy: &[[f64; 2]; 3]) -> Result<Vec<View>> {
    if !xyz.iter().flatten().chain(xy.iter().flatten()).all(|v| v.is_finite()) {
        return Err(Error::invalid("p3p: the points hold values that are not finite"));
    }
    let [a, b, c] = xyz.map(Vector3::from);
    let (u, v) = (b - a, c - a);
    let size = u.norm_squared().max(v.norm_squared()).max((c - b).norm_squared());
    let flatness = if size > 0.0 { u.cross(&v).norm() / size } else { 0.0 };
    if flatness <= COLLINEAR {
        return Err(Error::Degenerate {
            what: "three points on one line leave the view free to turn about it".into(),
            quantity: "twice the triangle's area over its longest side squared",
            value: flatness,
            limit: COLLINEAR,
            remedy: "take points that span a triangle",
        });
    }
    let mut directions = [Vector3::zeros(); 3];
    for (d, q) in directions.iter_mut().zip(xy) {
        *d = camera.unproject(q).ok_or_else(|| {
            Error::invalid(format!("p3p: the pixel ({:.1}, {:.1}) is outside the lens's valid field", q[0], q[1]))
        })?;
    }
    Ok(p3p(xyz, &directions).iter().map(|pose| View::new(*camera, *pose)).collect())
}

/// The right-handed orthonormal frame of two edges.
fn frame(u: &Vector3<f64>, v: &Vector3<f64>) -> Option<Matrix3<f64>> {
    let e1 = u.try_normalize(0.0)?;
    let e3 = u.cross(v).try_normalize(0.0)?;
    Some(Matrix3::from_columns(&[e1, e3.cross(&e1), e3]))
}

/// The distances λ to the three points; `a` are the squared sides 12, 13, 23, the longest of them 1.
fn distances(a: &[f64; 3], y: &[Vector3<f64>; 3]) -> UpToFour<Vector3<f64>> {
    let mut found = UpToFour::new();
    let [a12, a13, a23] = *a;
    let b = [y[0].dot(&y[1]), y[0].dot(&y[2]), y[1].dot(&y[2])];
    let [b12, b13, b23] = b;
    // Λᵀ D Λ = 0: equation 12 against 23, and 13 against 23.
    let d1 = Matrix3::new(a23, -a23 * b12, 0.0, -a23 * b12, a23 - a12, a12 * b23, 0.0, a12 * b23, -a12);
    let d2 = Matrix3::new(a23, 0.0, -a23 * b13, 0.0, -a13, a13 * b23, -a23 * b13, a13 * b23, a23 - a13);
    let (d1, d2) = (d1 / d1.amax(), d2 / d2.amax());
    let (c0, c3) = (d1.determinant(), d2.determinant());
    let (c1, c2) = (mixed(&d1, &d2), mixed(&d2, &d1));
    // det(D₁ + γ D₂), or from the other end det(γ D₁ + D₂): the larger leading coefficient.
    let (d0, other) = if c3.abs() >= c0.abs() {
        let gamma = sharpest_root([c0, c1, c2, c3]);
        (d1 + d2 * gamma, if gamma.abs() < 1.0 { &d2 } else { &d1 })
    } else {
        let gamma = sharpest_root([c3, c2, c1, c0]);
        (d1 * gamma + d2, if gamma.abs() < 1.0 { &d1 } else { &d2 })
    };
    let Some((v0, planes)) = pair_of_planes(&d0) else { return found };
    for normal in planes {
        let Some(across) = normal.cross(&v0).try_normalize(0.0) else { continue };
        let quadratic = [v0.dot(&(other * v0)), v0.dot(&(other * across)), across.dot(&(other * across))];
        for [s, t] in projective_roots(quadratic).into_iter().flatten() {
            let ray = v0 * s + across * t;
            let ray = if ray.sum() < 0.0 { -ray } else { ray };
            if let Some(lambda) = sized(&ray, a, &b) {
                let known = found.iter().any(|l: &Vector3<f64>| (l - lambda).amax() < 1e-9 * lambda.amax());
                if !known {
                    found.push(lambda);
                }
            }
        }
    }
    found
}

/// tr(adj(A) B): the coefficient of γ in det(A + γ B).
fn mixed(a: &Matrix3<f64>, b: &Matrix3<f64>) -> f64 {
    (0..3)
        .map(|i| {
            let row = b.row(i).transpose();
            row.dot(&a.row((i + 1) % 3).transpose().cross(&a.row((i + 2) % 3).transpose()))
        })
        .sum()
}

/// The real root of c₀ + c₁ x + c₂ x² + c₃ x³ at which the cubic is steepest, the one that is best determined.
fn sharpest_root(c: [f64; 4]) -> f64 {
    if c[3] == 0.0 {
        return 0.0; // both forms are degenerate already
    }
    let (b, c1, c0) = (c[2] / c[3], c[1] / c[3], c[0] / c[3]);
    let value = |x: f64| ((x + b) * x + c1) * x + c0;
    let slope = |x: f64| (3.0 * x + 2.0 * b) * x + c1;
    let (shift, q) = (-b / 3.0, b * b / 9.0 - c1 / 3.0);
    let r = value(shift) / 2.0;
    let mut x = if q > 0.0 && r * r <= q * q * q {
        // Three real roots: one of the outer two, on the side away from the nearer pair.
        let size = q.sqrt();
        let angle = (-r / (size * q)).clamp(-1.0, 1.0).acos() / 3.0;
        let high = shift + 2.0 * size * angle.cos();
        let low = shift + 2.0 * size * (angle + 2.0 * std::f64::consts::FRAC_PI_3).cos();
        if slope(high) >= slope(low) { high } else { low }
    } else {
        let u = -r.signum() * (r.abs() + (r * r - q * q * q).max(0.0).sqrt()).cbrt();
        shift + u + if u == 0.0 { 0.0 } else { q / u }
    };
    for _ in 0..4 {
        let (v, s) = (value(x), slope(x));
        let next = x - v / s;
        if !next.is_finite() || value(next).abs() >= v.abs() {
            break;
        }
        x = next;
    }
    x
}

/// The null vector of a degenerate form and the normals of its two planes; `None` where they are not real.
fn pair_of_planes(d: &Matrix3<f64>) -> Option<(Vector3<f64>, [Vector3<f64>; 2])> {
    let row = |i: usize| d.row(i).transpose();
    let crosses = [row(0).cross(&row(1)), row(0).cross(&row(2)), row(1).cross(&row(2))];
    let v0 = crosses.iter().max_by(|p, q| p.norm_squared().total_cmp(&q.norm_squared()))?.try_normalize(0.0)?;
    // The form on the plane across v0, by one Jacobi rotation.
    let e1 = if v0.x.abs() < 0.6 { Vector3::x() } else { Vector3::y() };
    let e1 = (e1 - v0 * v0.dot(&e1)).normalize();
    let e2 = v0.cross(&e1);
    let (p, q, r) = (e1.dot(&(d * e1)), e1.dot(&(d * e2)), e2.dot(&(d * e2)));
    let angle = 0.5 * (2.0 * q).atan2(p - r);
    let (s, c) = angle.sin_cos();
    let spread = (0.5 * (p - r)).hypot(q);
    let (high, low) = (0.5 * (p + r) + spread, 0.5 * (p + r) - spread);
    let (v1, v2) = (e1 * c + e2 * s, e2 * c - e1 * s);
    // At a double solution one eigenvalue is zero, and rounding may push it across.
    if high < -1e-9 * low.abs() || low > 1e-9 * high.abs() {
        return None;
    }
    let (a, b) = (v1 * high.max(0.0).sqrt(), v2 * (-low).max(0.0).sqrt());
    Some((v0, [a + b, a - b]))
}

/// The (s : t) with q₀ s² + 2 q₁ s t + q₂ t² = 0.
fn projective_roots([q0, q1, q2]: [f64; 3]) -> [Option<[f64; 2]>; 2] {
    let scale = q0.abs().max(q1.abs()).max(q2.abs());
    let discriminant = q1 * q1 - q0 * q2;
    // A touching solution: rounding may make it complex. Newton's method decides below whether it is one.
    if discriminant < -1e-7 * scale * scale || scale == 0.0 {
        return [None, None];
    }
    let root = discriminant.max(0.0).sqrt();
    let w = -(q1 + root.copysign(q1));
    let normalised = |s: f64, t: f64| {
        let n = s.hypot(t);
        (n > 0.0).then(|| [s / n, t / n])
    };
    [normalised(w, q0), normalised(q2, w)]
}

/// The distances along a ray of λ: their size, then Newton's method on the three equations.
fn sized(ray: &Vector3<f64>, a: &[f64; 3], b: &[f64; 3]) -> Option<Vector3<f64>> {
    const PAIRS: [(usize, usize); 3] = [(0, 1), (0, 2), (1, 2)];
    let form = |l: &Vector3<f64>, k: usize| {
        let (i, j) = PAIRS[k];
        let d = l[i] - l[j];
        d * d + 2.0 * (1.0 - b[k]) * l[i] * l[j]
    };
    let whole: f64 = (0..3).map(|k| form(ray, k)).sum();
    if ray.min() < -1e-3 * ray.amax() || whole <= 0.0 || whole.is_nan() {
        return None;
    }
    let mut l = ray * ((a[0] + a[1] + a[2]) / whole).sqrt();
    let miss = |l: &Vector3<f64>| Vector3::from_fn(|k, _| form(l, k) - a[k]);
    let mut error = miss(&l);
    for _ in 0..12 {
        let size = error.amax();
        if size < 1e-15 {
            break;
        }
        let mut j = Matrix3::zeros();
        for (k, (m, n)) in PAIRS.into_iter().enumerate() {
            j[(k, m)] = 2.0 * (l[m] - b[k] * l[n]);
            j[(k, n)] = 2.0 * (l[n] - b[k] * l[m]);
        }
        let Some(inverse) = j.try_inverse() else { break };
        let next = l - inverse * error;
        let e = miss(&next);
        if e.amax() >= size || e.amax().is_nan() {
            break;
        }
        (l, error) = (next, e);
    }
    (error.amax() < 1e-9 && l.min() > 0.0).then_some(l)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimation::sampling::Random;
    use crate::geometry::rotation_exp;

    fn configuration(random: &mut Random, shift: &Vector3<f64>) -> (Pose, [[f64; 3]; 3], [Vector3<f64>; 3]) {
        let axis = Vector3::new(random.normal(), random.normal(), random.normal());
        let rotation = rotation_exp(&(axis * 1.5));
        let centre = Vector3::new(random.normal(), random.normal(), random.normal()) * 10.0 + shift;
        let y = [0, 1, 2]
            .map(|_| Vector3::new(2.0 * random.uniform() - 1.0, 2.0 * random.uniform() - 1.0, 1.0).normalize());
        let x = y.map(|y| (rotation.transpose() * (y * (2.0 + 48.0 * random.uniform())) + centre).into());
        // The points are rounded: at large coordinates the directions follow the rounded points.
        let y = x.map(|x: [f64; 3]| (rotation * (Vector3::from(x) - centre)).normalize());
        (Pose { rotation, centre }, x, y)
    }

    fn distance(a: &Pose, b: &Pose) -> f64 {
        let (turn, shift) = a.difference(b);
        turn.norm() + shift.norm() / 50.0
    }

    #[test]
    fn the_truth_is_among_the_solutions_of_200_000_configurations() {
        let mut random = Random::new(1);
        let (mut missed, mut counts, mut wrong) = (0, [0usize; 5], 0);
        for _ in 0..200_000 {
            let (truth, x, y) = configuration(&mut random, &Vector3::zeros());
            let poses = p3p(&x, &y);
            counts[poses.len()] += 1;
            missed += usize::from(!poses.iter().any(|p| distance(&truth, p) < 1e-5));
            // No false solution: each sees the points where they are.
            wrong +=
                poses.iter().filter(|p| (0..3).any(|i| (p.transform(&x[i]).normalize() - y[i]).norm() > 1e-6)).count();
        }
        assert_eq!(missed, 0, "counts {counts:?}");
        assert_eq!(wrong, 0);
        assert!(counts[2] > 1000 && counts[4] > 1000 && counts[0] == 0, "{counts:?}");
    }

    #[test]
    fn small_and_far_triangles_and_large_coordinates_keep_their_truth() {
        let mut random = Random::new(2);
        let shift = Vector3::new(456_789.0, 5_812_345.0, 143.0);
        let mut missed = 0;
        for _ in 0..50_000 {
            let (truth, x, y) = configuration(&mut random, &shift);
            missed += usize::from(!p3p(&x, &y).iter().any(|p| distance(&truth, p) < 1e-4));
        }
        assert!(missed <= 2, "{missed} of 50 000 missed at large coordinates");
        // A telephoto view: directions within a degree, where the four solutions crowd.
        let mut missed = 0;
        for _ in 0..50_000 {
            let (truth, x, _) = configuration(&mut random, &Vector3::zeros());
            let x = x.map(|p| {
                (truth.centre + truth.rotation.transpose() * Vector3::new(0.0, 0.0, 2000.0) + Vector3::from(p) * 0.5)
                    .into()
            });
            let y = x.map(|p: [f64; 3]| truth.transform(&p).normalize());
            let near = |p: &Pose| {
                let (turn, shift) = truth.difference(p);
                turn.norm() < 1e-3 && shift.norm() < 2.0
            };
            missed += usize::from(!p3p(&x, &y).iter().any(near));
        }
        assert!(missed <= 50, "{missed} of 50 000 telephoto views missed");
    }

    #[test]
    fn solutions_that_touch_are_found() {
        // The centre on the cylinder through the triangle's circumcircle: the solutions there are double.
        let mut random = Random::new(3);
        let mut missed = 0;
        for _ in 0..10_000 {
            let x = [0, 1, 2].map(|_| {
                let t = std::f64::consts::TAU * random.uniform();
                [t.cos(), t.sin(), 0.0]
            });
            let t = std::f64::consts::TAU * random.uniform();
            let centre = Vector3::new(t.cos(), t.sin(), 0.5 + 3.0 * random.uniform());
            let rotation = rotation_exp(&Vector3::new(random.normal(), random.normal(), random.normal()));
            let truth = Pose { rotation, centre };
            let y = x.map(|p| truth.transform(&p).normalize());
            let d = [0, 1, 2].map(|i| Vector3::from(x[i]) - Vector3::from(x[(i + 1) % 3]));
            if d.iter().any(|d| d.norm() < 0.1) {
                continue;
            }
            missed += usize::from(!p3p(&x, &y).iter().any(|p| distance(&truth, p) < 1e-3));
        }
        assert!(missed < 10, "{missed} of 10 000 double solutions missed");
    }

    #[test]
    fn collinear_points_and_nonsense_have_no_solution() {
        let y = [Vector3::z(), Vector3::new(0.1, 0.0, 1.0).normalize(), Vector3::new(0.2, 0.0, 1.0).normalize()];
        assert!(p3p(&[[0.0; 3], [1.0, 1.0, 1.0], [2.0, 2.0, 2.0]], &y).is_empty());
        assert!(p3p(&[[0.0; 3]; 3], &y).is_empty());
        assert!(p3p(&[[f64::NAN; 3]; 3], &y).is_empty());
        assert!(p3p(&[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], &[Vector3::zeros(); 3]).is_empty());
    }
}
