//! Projection of a block of points, coordinate by coordinate, so that the compiler can use wide registers.
//!
//! The arithmetic is that of [`View::project`], operation for operation: one point at a time and a block at a time give
//! the same bits, on every processor (no fused multiply-add, whose rounding depends on the hardware).

use super::camera::{Camera, Depth, Lens};
use super::polynomial::Polynomial;
use super::view::View;

/// Points in a block: in and out together stay in the innermost cache.
pub const LANES: usize = 256;

/// The projections of up to [`LANES`] points; what the camera cannot see is NaN in all three.
#[repr(align(64))]
pub struct Block {
    /// Pixels.
    pub x: [f64; LANES],
    /// Pixels.
    pub y: [f64; LANES],
    /// Along the optical axis, or the range, as the camera has it.
    pub depth: [f64; LANES],
}

impl Block {
    /// Room for the results.
    pub fn new() -> Self {
        Self { x: [f64::NAN; LANES], y: [f64::NAN; LANES], depth: [f64::NAN; LANES] }
    }
}

impl Default for Block {
    fn default() -> Self {
        Self::new()
    }
}

/// A view prepared for blocks.
pub struct BlockProjector {
    camera: Camera,
    /// World to camera, row by row.
    rotation: [[f64; 3]; 3],
    centre: [f64; 3],
    #[cfg(target_arch = "x86_64")]
    wide: bool,
}

impl BlockProjector {
    /// Prepares a view.
    pub fn new(view: &View) -> Self {
        Self {
            camera: view.camera,
            rotation: std::array::from_fn(|i| std::array::from_fn(|j| view.pose.rotation[(i, j)])),
            centre: view.pose.centre.into(),
            #[cfg(target_arch = "x86_64")]
            wide: std::arch::is_x86_feature_detected!("avx2"),
        }
    }

    /// Projects up to [`LANES`] points; what stands behind them in the block afterwards has no meaning.
    pub fn project(&self, points: &[[f64; 3]], block: &mut Block) {
        #[cfg(target_arch = "x86_64")]
        if self.wide {
            // SAFETY: the processor has the feature, as found out at birth.
            unsafe { self.project_avx2(points, block) };
            return;
        }
        self.project_here(points, block);
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    unsafe fn project_avx2(&self, points: &[[f64; 3]], block: &mut Block) {
        self.project_here(points, block);
    }

    #[inline(always)]
    fn project_here(&self, points: &[[f64; 3]], block: &mut Block) {
        self.to_camera(points, block);
        match &self.camera.lens {
            Lens::Polynomial(lens) if lens.k == [0.0; 8] => self.pinhole(block),
            Lens::Polynomial(lens) if lens.k[5..] == [0.0; 3] => self.polynomial(lens, block),
            Lens::Polynomial(lens) => self.rational(lens, block),
            Lens::Fisheye(_) | Lens::Equirectangular => self.one_by_one(points.len().min(LANES), block),
        }
    }

    /// World to camera: x, y and depth hold the three coordinates afterwards.
    #[inline(always)]
    fn to_camera(&self, points: &[[f64; 3]], block: &mut Block) {
        let [[a, b, c], [d, e, f], [g, h, k]] = self.rotation;
        let [cx, cy, cz] = self.centre;
        let n = points.len().min(LANES);
        let (xs, ys, zs) = (&mut block.x[..n], &mut block.y[..n], &mut block.depth[..n]);
        for (((p, bx), by), bz) in points[..n].iter().zip(xs).zip(ys).zip(zs) {
            let (x, y, z) = (p[0] - cx, p[1] - cy, p[2] - cz);
            *bx = a * x + b * y + c * z;
            *by = d * x + e * y + f * z;
            *bz = g * x + h * y + k * z;
        }
    }

    #[inline(always)]
    fn pinhole(&self, block: &mut Block) {
        self.each(block, f64::INFINITY, |x, y, _| [x, y]);
    }

    #[inline(always)]
    fn polynomial(&self, lens: &Polynomial, block: &mut Block) {
        let [k1, k2, p1, p2, k3, ..] = lens.k;
        self.each(block, lens.max_r2, |x, y, r2| {
            let g = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
            let xy2 = 2.0 * x * y;
            [x * g + p1 * xy2 + p2 * (r2 + 2.0 * x * x), y * g + p1 * (r2 + 2.0 * y * y) + p2 * xy2]
        });
    }

    #[inline(always)]
    fn rational(&self, lens: &Polynomial, block: &mut Block) {
        self.each(block, lens.max_r2, |x, y, r2| lens.distort_unchecked(x, y, r2));
    }

    #[inline(always)]
    fn each(&self, block: &mut Block, max_r2: f64, distort: impl Fn(f64, f64, f64) -> [f64; 2]) {
        let Camera { fx, fy, cx, cy, skew, .. } = self.camera;
        for i in 0..LANES {
            let z = block.depth[i];
            let iz = 1.0 / z;
            let (x, y) = (block.x[i] * iz, block.y[i] * iz);
            let r2 = x * x + y * y;
            let [xd, yd] = distort(x, y, r2);
            let seen = (z > 0.0) & (r2 <= max_r2);
            let keep = |v: f64| if seen { v } else { f64::NAN };
            block.x[i] = keep(fx * xd + skew * yd + cx);
            block.y[i] = keep(fy * yd + cy);
            block.depth[i] = keep(z);
        }
    }

    fn one_by_one(&self, n: usize, block: &mut Block) {
        for i in 0..n {
            let p = nalgebra::Vector3::new(block.x[i], block.y[i], block.depth[i]);
            let [x, y] = self.camera.project(&p).unwrap_or([f64::NAN; 2]);
            let depth = match self.camera.depth_kind() {
                Depth::AlongAxis => p.z,
                Depth::Range => p.norm(),
            };
            (block.x[i], block.y[i]) = (x, y);
            block.depth[i] = if x.is_nan() { f64::NAN } else { depth };
        }
    }
}
