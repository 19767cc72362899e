//! A frame about one direction.

use nalgebra::Vector3;

/// Two unit vectors across the unit vector `normal` and across each other, such that the first, the second and `normal`
/// are a right-handed frame. The same normal gives the same two; they jump where it passes 26° from the z axis.
pub fn tangents(normal: &Vector3<f64>) -> (Vector3<f64>, Vector3<f64>) {
    let aside = if normal.z.abs() > 0.9 { Vector3::x() } else { Vector3::z() };
    let across = aside.cross(normal).normalize();
    (across, normal.cross(&across))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_normal_has_a_right_handed_frame() {
        for k in 0..500 {
            let (a, b) = (0.37 * f64::from(k), 2.11 * f64::from(k));
            let normal = Vector3::new(a.sin() * b.cos(), a.sin() * b.sin(), a.cos());
            let (first, second) = tangents(&normal);
            assert!((first.norm() - 1.0).abs() < 1e-14 && (second.norm() - 1.0).abs() < 1e-14);
            assert!((first.cross(&second) - normal).norm() < 1e-14);
        }
    }
}
