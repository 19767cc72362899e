//! The faces of a cube about the projection centre, on which tables over all rays lie where a camera looks around.

/// Faces of the cube: those of the axes x, −x, y, −y, z, −z, in turn.
pub(crate) const CUBE_FACES: usize = 6;

/// The axes of u, v and depth of a face, in the camera frame, and the sign of the depth's axis.
pub(crate) fn cube_face(number: usize) -> ([usize; 3], f64) {
    let k = number / 2;
    ([(k + 1) % 3, (k + 2) % 3, k % 3], if number.is_multiple_of(2) { 1.0 } else { -1.0 })
}

/// The number of the face onto which a point of the camera frame falls.
#[inline(always)]
pub(crate) fn cube_face_of(q: [f32; 3]) -> usize {
    let size = [q[0].abs(), q[1].abs(), q[2].abs()];
    let k = if size[0] >= size[1] && size[0] >= size[2] {
        0
    } else if size[1] >= size[2] {
        1
    } else {
        2
    };
    2 * k + usize::from(q[k] < 0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_point_falls_onto_the_face_in_whose_axes_it_is_in_front_and_inside() {
        for i in 0..1000 {
            let q = [0.37, 0.71, 0.13].map(|f| (f64::from(i) * f).fract() as f32 - 0.5037);
            let (axes, sign) = cube_face(cube_face_of(q));
            let [u, v, depth] = axes.map(|a| q[a]);
            let depth = sign as f32 * depth;
            assert!(depth > 0.0 && u.abs() <= depth && v.abs() <= depth, "{q:?}");
        }
        for number in 0..CUBE_FACES {
            let (axes, sign) = cube_face(number);
            let mut q = [0.1; 3];
            q[axes[2]] = sign as f32;
            assert_eq!(cube_face_of(q), number);
        }
    }
}
