//! Many points at once, in parallel.

use nalgebra::Matrix3;
use rayon::prelude::*;

use super::block::{BlockProjector, LANES};
use super::camera::MAX_PARAMS;
use super::pose::skew_matrix;
use super::view::View;
use crate::error::{Error, Result};
use crate::memory::fresh;

/// Points per task of the scheduler.
const TASK: usize = 32 * LANES;
/// From this many points on results are larger than caches are.
const MANY: usize = 1 << 20;

/// World points to pixels and depths. What the camera cannot see is NaN in both.
pub fn project(view: &View, xyz: &[[f64; 3]]) -> (Vec<[f64; 2]>, Vec<f64>) {
    let mut xy = fresh(xyz.len());
    let mut depth = fresh(xyz.len());
    fill(view, xyz, &mut xy, &mut depth);
    (xy, depth)
}

/// As [`project()`], into arrays of the caller's.
pub fn project_into(view: &View, xyz: &[[f64; 3]], xy: &mut [[f64; 2]], depth: &mut [f64]) -> Result<()> {
    if xy.len() != xyz.len() || depth.len() != xyz.len() {
        return Err(Error::invalid(format!(
            "{} points do not fit into outputs of {} and {} rows",
            xyz.len(),
            xy.len(),
            depth.len()
        )));
    }
    fill(view, xyz, xy, depth);
    Ok(())
}

fn fill(view: &View, xyz: &[[f64; 3]], xy: &mut [[f64; 2]], depth: &mut [f64]) {
    fill_past_caches_from(MANY, view, xyz, xy, depth);
}

/// Past the caches from `many` points on.
fn fill_past_caches_from(many: usize, view: &View, xyz: &[[f64; 3]], xy: &mut [[f64; 2]], depth: &mut [f64]) {
    let (projector, past_caches) = (BlockProjector::new(view), xyz.len() >= many);
    let tasks = xyz.par_chunks(TASK).zip(xy.par_chunks_mut(TASK)).zip(depth.par_chunks_mut(TASK));
    tasks.for_each(|((points, xy), depth)| projector.fill(points, xy, depth, past_caches));
}

/// Pixels to unit directions in the world frame; NaN where nothing of the valid field is imaged.
pub fn unproject(view: &View, xy: &[[f64; 2]]) -> Vec<[f64; 3]> {
    xy.par_iter().with_min_len(256).map(|p| view.ray(p).map_or([f64::NAN; 3], Into::into)).collect()
}

/// The derivatives of one pixel position by everything that a view depends on.
#[derive(Debug, Clone, Copy)]
pub struct ViewJacobian {
    /// Pixels.
    pub xy: [f64; 2],
    /// d(x, y)/d(world point).
    pub d_xyz: [[f64; 3]; 2],
    /// d(x, y)/d(rotation vector on the left, projection centre).
    pub d_pose: [[f64; 6]; 2],
    /// d(x, y)/d(camera parameters), in the model's order; unused columns are zero.
    pub d_params: [[f64; MAX_PARAMS]; 2],
}

impl View {
    /// Pixel position of one world point and d(x, y)/d(rotation vector on the left, projection centre); `None` where the
    /// camera cannot see it.
    #[inline]
    pub fn project_with_pose_jacobian(&self, p_world: &[f64; 3]) -> Option<([f64; 2], [[f64; 6]; 2])> {
        let p = self.pose.transform(p_world);
        let (xy, j) = self.camera.project_with_point_jacobian(&p)?;
        let r = &self.pose.rotation;
        let row = |a: &[f64; 3]| {
            let by = |k: usize| -(a[0] * r[(0, k)] + a[1] * r[(1, k)] + a[2] * r[(2, k)]);
            // a · (δ × p) = δ · (p × a)
            [p.y * a[2] - p.z * a[1], p.z * a[0] - p.x * a[2], p.x * a[1] - p.y * a[0], by(0), by(1), by(2)]
        };
        Some((xy, [row(&j[0]), row(&j[1])]))
    }

    /// Pixel position and all derivatives of one world point; `None` where the camera cannot see it.
    pub fn project_with_jacobian(&self, p_world: &[f64; 3]) -> Option<ViewJacobian> {
        let p = self.pose.transform(p_world);
        let projection = self.camera.project_with_jacobian(&p)?;
        let j = &projection.d_point;
        let by = |m: &Matrix3<f64>, i: usize, k: usize| j[i][0] * m[(0, k)] + j[i][1] * m[(1, k)] + j[i][2] * m[(2, k)];
        let turned = -skew_matrix(&p);
        let mut d_xyz = [[0.0; 3]; 2];
        let mut d_pose = [[0.0; 6]; 2];
        for i in 0..2 {
            for k in 0..3 {
                d_xyz[i][k] = by(&self.pose.rotation, i, k);
                d_pose[i][k] = by(&turned, i, k);
                d_pose[i][k + 3] = -d_xyz[i][k];
            }
        }
        Some(ViewJacobian { xy: projection.xy, d_xyz, d_pose, d_params: projection.d_params })
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::super::{Camera, Model, Pose, rotation_exp};
    use super::*;

    #[test]
    fn many_points_and_few_give_the_same_bits_wherever_the_arrays_begin_and_end() {
        let camera = Camera::new(Model::OpenCv, 600, 400, &[330.0, 330.0, 299.5, 199.5, -0.1, 0.02, 1e-3, 0.0, 0.0]);
        let pose = Pose { rotation: rotation_exp(&Vector3::new(0.2, -0.4, 0.1)), centre: Vector3::new(0.5, 0.2, -1.0) };
        let view = View::new(camera.unwrap(), pose);
        let noise = |i: usize| 20.0 * ((i as f64 * 12.9898).sin() * 43758.5453).fract() - 1.0;
        let xyz: Vec<[f64; 3]> = (0..TASK + LANES + 3).map(|i| [0, 1, 2].map(|k| noise(3 * i + k))).collect();
        // The view sees some of the points, and not all.
        let seen = xyz.iter().filter(|p| view.project(p).is_some()).count();
        assert!(seen > 1000 && xyz.len() - seen > 1000, "{seen}");
        for n in [0, 1, 2, LANES - 1, LANES + 1, 3001, TASK, TASK + LANES + 3] {
            let (mut wanted_xy, mut wanted_depth) = (vec![[0.0; 2]; n], vec![0.0; n]);
            fill_past_caches_from(usize::MAX, &view, &xyz[..n], &mut wanted_xy, &mut wanted_depth);
            // Beginnings in numbers behind a multiple of 16 bytes.
            for (first_xy, first_depth) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
                let mut room = [vec![7.0_f64; 2 * n + 4], vec![7.0_f64; n + 4]];
                let [before_xy, before_depth] =
                    [room[0].as_ptr().align_offset(16) + first_xy, room[1].as_ptr().align_offset(16) + first_depth];
                let [xy, depth] = &mut room;
                let xy = &mut xy[before_xy..before_xy + 2 * n].as_chunks_mut::<2>().0[..n];
                let depth = &mut depth[before_depth..before_depth + n];
                fill_past_caches_from(0, &view, &xyz[..n], xy, depth);
                let bits = |v: &[f64]| v.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
                let case = format!("{n} points, {first_xy} and {first_depth} numbers off");
                assert!(bits(xy.as_flattened()) == bits(wanted_xy.as_flattened()), "xy of {case}");
                assert!(bits(depth) == bits(&wanted_depth), "depths of {case}");
                for (room, before, written) in [(&room[0], before_xy, 2 * n), (&room[1], before_depth, n)] {
                    let beside = room[..before].iter().chain(&room[before + written..]);
                    assert!(beside.into_iter().all(|&v| v == 7.0), "written beside the arrays: {case}");
                }
            }
        }
    }
}
