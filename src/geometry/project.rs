//! Many points at once, in parallel.

use nalgebra::Matrix3;
use rayon::prelude::*;

use super::block::{Block, BlockProjector, LANES};
use super::camera::MAX_PARAMS;
use super::pose::skew_matrix;
use super::view::View;
use crate::error::{Error, Result};
use crate::memory::fresh;

/// Points per task of the scheduler.
const TASK: usize = 32 * LANES;
/// From this many points on results are larger than caches are.
#[cfg(target_arch = "x86_64")]
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
    let projector = BlockProjector::new(view);
    #[cfg(target_arch = "x86_64")]
    let many = xyz.len() >= MANY;
    xyz.par_chunks(TASK).zip(xy.par_chunks_mut(TASK)).zip(depth.par_chunks_mut(TASK)).for_each(
        |((points, xy), depth)| {
            let mut block = Block::new();
            for ((points, xy), depth) in points.chunks(LANES).zip(xy.chunks_mut(LANES)).zip(depth.chunks_mut(LANES)) {
                projector.project(points, &mut block);
                #[cfg(target_arch = "x86_64")]
                if many {
                    block.put_past_caches(xy, depth);
                    continue;
                }
                block.put(xy, depth);
            }
            #[cfg(target_arch = "x86_64")]
            if many {
                Block::fence();
            }
        },
    );
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
