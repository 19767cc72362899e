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

    /// The first results, as many as there is room for.
    fn put(&self, xy: &mut [[f64; 2]], depth: &mut [f64]) {
        for (i, (xy, d)) in xy.iter_mut().zip(depth).enumerate() {
            *xy = [self.x[i], self.y[i]];
            *d = self.depth[i];
        }
    }

    /// The same past the caches, which large results do not fit into anyway: otherwise what was there before is fetched
    /// for nothing. Of memory that does not lie as large arrays do nothing is asked.
    ///
    /// # Safety
    /// A fence has to follow before anything else is done with the slices: until then others need not see the stores.
    #[cfg(target_arch = "x86_64")]
    unsafe fn put_past_caches(&self, xy: &mut [[f64; 2]], depth: &mut [f64]) {
        use std::arch::x86_64::{_mm_loadu_pd, _mm_set_pd, _mm_stream_pd, _mm_stream_si64};
        let aligned = |address: usize| address.is_multiple_of(16);
        let n = depth.len();
        if !aligned(xy.as_ptr().addr()) || n > LANES || n != xy.len() {
            return self.put(xy, depth);
        }
        // SAFETY: every store goes to one element, or to two successive ones, of the slices, at an address that is a
        // multiple of 16 where two numbers are stored; every load is within the block, as `n` is.
        unsafe {
            for (i, xy) in xy.iter_mut().enumerate() {
                _mm_stream_pd(xy.as_mut_ptr(), _mm_set_pd(self.y[i], self.x[i]));
            }
            let out = depth.as_mut_ptr();
            let one = |i: usize| _mm_stream_si64(out.add(i).cast(), self.depth[i].to_bits().cast_signed());
            let first = usize::from(!aligned(out.addr())).min(n);
            (0..first).for_each(one);
            let pairs = (n - first) / 2;
            for i in (first..).step_by(2).take(pairs) {
                _mm_stream_pd(out.add(i), _mm_loadu_pd(self.depth.as_ptr().add(i)));
            }
            (first + 2 * pairs..n).for_each(one);
        }
    }
}

/// After it, others see what was put past the caches.
#[cfg(target_arch = "x86_64")]
#[allow(unused_unsafe, reason = "newer compilers know that it is safe")]
fn fence() {
    // SAFETY: every processor of this kind has it.
    unsafe { std::arch::x86_64::_mm_sfence() };
}

impl Default for Block {
    fn default() -> Self {
        Self::new()
    }
}

/// The widest registers of the processor.
#[cfg(target_arch = "x86_64")]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Registers {
    /// Those that all processors of the kind have.
    Any,
    Avx2,
    /// AVX-512 F with VL, DQ and BW, which all processors with such registers have had but Knights Landing and Knights Mill.
    Avx512,
}

#[cfg(target_arch = "x86_64")]
impl Registers {
    /// What this processor has.
    #[inline]
    pub fn here() -> Self {
        use std::arch::is_x86_feature_detected as has;
        if has!("avx512f") && has!("avx512vl") && has!("avx512dq") && has!("avx512bw") {
            Self::Avx512
        } else if has!("avx2") {
            Self::Avx2
        } else {
            Self::Any
        }
    }
}

/// A view prepared for blocks.
pub struct BlockProjector {
    camera: Camera,
    /// World to camera, row by row.
    rotation: [[f64; 3]; 3],
    centre: [f64; 3],
    #[cfg(target_arch = "x86_64")]
    registers: Registers,
}

impl BlockProjector {
    /// Prepares a view.
    pub fn new(view: &View) -> Self {
        Self {
            camera: view.camera,
            rotation: std::array::from_fn(|i| std::array::from_fn(|j| view.pose.rotation[(i, j)])),
            centre: view.pose.centre.into(),
            #[cfg(target_arch = "x86_64")]
            registers: Registers::here(),
        }
    }

    /// Projects any number of points into arrays of as many rows: past the caches if the results of all threads together
    /// are larger than these are, where the processor can do that.
    pub(super) fn fill(&self, points: &[[f64; 3]], xy: &mut [[f64; 2]], depth: &mut [f64], past_caches: bool) {
        let mut block = Block::new();
        for ((points, xy), depth) in points.chunks(LANES).zip(xy.chunks_mut(LANES)).zip(depth.chunks_mut(LANES)) {
            self.project(points, &mut block);
            #[cfg(target_arch = "x86_64")]
            if past_caches {
                // SAFETY: the fence is below.
                unsafe { block.put_past_caches(xy, depth) };
                continue;
            }
            block.put(xy, depth);
        }
        #[cfg(target_arch = "x86_64")]
        if past_caches {
            fence();
        }
    }

    /// Projects up to [`LANES`] points; what stands behind them in the block afterwards has no meaning.
    pub fn project(&self, points: &[[f64; 3]], block: &mut Block) {
        #[cfg(target_arch = "x86_64")]
        match self.registers {
            // SAFETY: the processor has the features, as found out at birth.
            Registers::Avx512 => return unsafe { self.project_avx512(points, block) },
            // SAFETY: as above.
            Registers::Avx2 => return unsafe { self.project_avx2(points, block) },
            Registers::Any => {}
        }
        self.project_here(points, block);
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    unsafe fn project_avx512(&self, points: &[[f64; 3]], block: &mut Block) {
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    #[cfg(target_arch = "x86_64")]
    fn puts_the_same_past_the_caches_wherever_the_arrays_begin_and_end() {
        let mut block = Block::new();
        for i in 0..LANES {
            (block.x[i], block.y[i], block.depth[i]) = (i as f64, -(i as f64), 0.5 + i as f64);
        }
        let mut room = vec![0.0_f64; 4 * LANES];
        let even = room.as_ptr().align_offset(16);
        // Where xy and the depths begin, in numbers behind a multiple of 16 bytes, and how many rows there are. Only with an
        // even first one the stores go past the caches; with an odd second one, one depth is stored before the pairs.
        let mut ways = [false; 3];
        for (first_xy, first_depth, n) in [
            (0, 0, LANES),
            (0, 1, LANES),
            (0, 0, 7),
            (0, 1, 7),
            (0, 1, 8),
            (0, 1, 1),
            (0, 1, 0),
            (0, 0, 0),
            (1, 0, LANES),
            (1, 0, 8),
            (1, 1, 7),
        ] {
            room.fill(7.0);
            let (xy, depth) = room[even..].split_at_mut(2 * LANES + 6);
            let xy = &mut xy[first_xy..first_xy + 2 * n].as_chunks_mut::<2>().0[..n];
            let depth = &mut depth[first_depth..first_depth + n];
            assert_eq!(xy.as_ptr().addr() % 16, 8 * first_xy);
            assert_eq!(depth.as_ptr().addr() % 16, 8 * first_depth);
            ways[if first_xy == 1 { 2 } else { first_depth }] |= n > 1;
            // SAFETY: the fence follows.
            unsafe { block.put_past_caches(xy, depth) };
            fence();
            let (mut wanted_xy, mut wanted_depth) = (vec![[0.0; 2]; n], vec![0.0; n]);
            block.put(&mut wanted_xy, &mut wanted_depth);
            assert_eq!((&xy[..], &depth[..]), (&wanted_xy[..], &wanted_depth[..]));
            let others = room.iter().filter(|&&v| v == 7.0).count();
            let sevens = wanted_xy.as_flattened().iter().chain(&wanted_depth).filter(|&&v| v == 7.0).count();
            assert_eq!(others - sevens, room.len() - 3 * n, "written beside the slices");
        }
        assert_eq!(ways, [true; 3]);
    }
}
