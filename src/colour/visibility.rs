//! Which points a photo sees: inside the picture, in front of the camera, in the lens's valid field, and not behind a
//! surface of the scan.

use rayon::prelude::*;

use crate::error::{Error, Result};
use crate::geometry::{Block, BlockProjector, Depth, Frustum, LANES, Model, View};
use crate::render::{DepthBuffer, Footprint, LocalPlanes, Located, Sample, Surfaces, clamped};

/// Points per task of the scheduler.
const TASK: usize = 16 * LANES;
/// How far, cells, the surface around a point is looked at.
const REACH: usize = 4;
/// How far from a line, relative, three samples of one surface may lie.
const FLATNESS: f32 = 0.01;
/// A step of this much, relative, is a depth edge.
const EDGE: f32 = 0.05;
/// The part of a pixel that surfaces have to cover to hide a point in it.
const COVERED: f32 = 0.5;
/// The part of the photo's width in which a weight rises from the border.
const BORDER: f64 = 0.03;

/// What else a point has to fulfil.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Limits {
    /// The largest distance from the projection centre, in the cloud's unit.
    pub max_distance: f64,
    /// The largest angle between the ray and the surface's normal, radians.
    pub max_incidence: f64,
}

impl Default for Limits {
    fn default() -> Self {
        Self { max_distance: f64::INFINITY, max_incidence: std::f64::consts::FRAC_PI_2 }
    }
}

impl Limits {
    /// Itself, refused where it makes no sense.
    pub fn checked(self) -> Result<Self> {
        if self.max_distance.is_nan() || self.max_distance <= 0.0 {
            return Err(Error::invalid(format!("a largest distance of {} is not possible", self.max_distance)));
        }
        if !(self.max_incidence > 0.0 && self.max_incidence <= std::f64::consts::FRAC_PI_2) {
            return Err(Error::invalid(format!(
                "a largest incidence of {} radians is not possible: it lies between 0 and π/2",
                self.max_incidence
            )));
        }
        Ok(self)
    }
}

/// What one photo sees of the cloud. Does not change any more.
pub struct VisibilityMap {
    view: View,
    projector: BlockProjector,
    frustum: Frustum,
    surfaces: Surfaces,
    limits: Limits,
    pixel_angle: f64,
}

impl VisibilityMap {
    /// From a depth buffer that everything was put into.
    pub fn new(buffer: DepthBuffer, footprint: &Footprint, limits: Limits) -> Result<Self> {
        let limits = limits.checked()?;
        let view = *buffer.view();
        let surfaces = Surfaces::new(buffer, footprint)?;
        Ok(Self {
            view,
            projector: BlockProjector::new(&view),
            frustum: Frustum::new(&view, 0.0),
            pixel_angle: f64::from(crate::render::pixel_angle(&view)),
            surfaces,
            limits,
        })
    }

    /// The view.
    pub fn view(&self) -> &View {
        &self.view
    }

    /// Whether the photo is a panorama, whose left and right border are the same place.
    pub fn wraps(&self) -> bool {
        self.surfaces.grid.wraps
    }

    /// The slopes of the surfaces that the photo sees.
    pub fn planes(&self) -> LocalPlanes {
        let Surfaces { grid, samples, noise, .. } = &self.surfaces;
        LocalPlanes::new(&self.view, *grid, samples, *noise)
    }

    /// The nearest depth in each pixel of the photo, row by row; NaN where there is no point.
    pub fn depth(&self) -> Vec<f32> {
        let grid = &self.surfaces.grid;
        let pixel = |sample: &Sample| if sample.found() { 1.0 / sample.inverse_depth() } else { f32::NAN };
        (0..grid.height)
            .into_par_iter()
            .flat_map_iter(|row| grid.photo_row(&self.surfaces.samples, row).iter().map(pixel))
            .collect()
    }

    /// The depth in each pixel of the photo beyond which nothing is visible, row by row; infinite where nothing hides.
    pub fn limit(&self) -> Vec<f32> {
        let Surfaces { grid, limits, limit, .. } = &self.surfaces;
        let side = limits.fineness;
        // A pixel's is that of its part in which the farthest is visible.
        let of_pixel = |row: usize, column: usize| {
            let parts = (0..side).flat_map(|j| &limits.photo_row(limit, row * side + j)[column * side..][..side]);
            1.0 / parts.fold(f32::INFINITY, |least, limit| limit.min(least))
        };
        (0..grid.height)
            .into_par_iter()
            .flat_map_iter(|row| (0..grid.width).map(move |column| of_pixel(row, column)))
            .collect()
    }

    /// Whether the photo sees each of the points.
    pub fn visible(&self, xyz: &[[f64; 3]]) -> Vec<bool> {
        let mut seen = vec![false; xyz.len()];
        xyz.par_chunks(TASK).zip(seen.par_chunks_mut(TASK)).filter(|(points, _)| self.frustum.meets(points)).for_each(
            |(points, seen)| {
                let mut sight = Sight::new();
                for (points, seen) in points.chunks(LANES).zip(seen.chunks_mut(LANES)) {
                    self.look(points, &mut sight);
                    for (i, seen) in seen.iter_mut().enumerate() {
                        *seen = sight.cell(i).is_some();
                    }
                }
            },
        );
        seen
    }

    /// Whether any of these points may be visible.
    pub(super) fn meets(&self, xyz: &[[f64; 3]]) -> bool {
        self.frustum.meets(xyz)
    }

    /// Projects up to [`LANES`] points and finds which of them the photo sees.
    pub(super) fn look(&self, points: &[[f64; 3]], sight: &mut Sight) {
        self.projector.project(points, &mut sight.block);
        self.surfaces.limits.locate(&sight.block, 0, &mut sight.located);
        let (limit, stride) = (&self.surfaces.limit, self.surfaces.limits.stride() as u32);
        for i in 0..points.len() {
            let (cell, other) = sight.located.ahead_with_row(i, stride);
            crate::render::fetch(limit, cell);
            crate::render::fetch(limit, other);
            if let Some((cell, inverse)) = sight.located.get(i)
                && self.hidden(cell, clamped(inverse), sight.located.place(i))
            {
                sight.located.drop(i);
            }
        }
        if self.limits != Limits::default() {
            self.refuse(points, sight);
        }
    }

    /// Whether a point of this inverse depth lies behind a surface: by the four cells around it, as in bilinear
    /// interpolation, so that edges run between pixels and not along them.
    #[inline(always)]
    fn hidden(&self, cell: usize, inverse: f32, [right, down]: [f32; 2]) -> bool {
        let limit = &self.surfaces.limit;
        let stride = self.surfaces.limits.stride();
        let beside = if right < 0.5 { cell - 1 } else { cell + 1 };
        let above = if down < 0.5 { cell - stride } else { cell + stride };
        let across = above + beside - cell;
        let limits = [limit[cell], limit[beside], limit[above], limit[across]];
        // Most points lie before all four, and ask for no more.
        let hides = limits.map(|limit| inverse < limit);
        if hides == [false; 4] {
            return false;
        }
        let (a, b) = ((right - 0.5).abs(), (down - 0.5).abs());
        let weights = [(1.0 - a) * (1.0 - b), a * (1.0 - b), (1.0 - a) * b, a * b];
        let covered = |k: usize| if hides[k] { weights[k] } else { 0.0 };
        covered(0) + covered(1) + covered(2) + covered(3) > COVERED
    }

    #[cold]
    fn refuse(&self, points: &[[f64; 3]], sight: &mut Sight) {
        let least = self.limits.max_incidence.cos();
        for (i, p) in points.iter().enumerate() {
            let Some((cell, _)) = sight.located.get(i) else { continue };
            let far = self.distance(p) > self.limits.max_distance;
            if far || (least > 1e-9 && self.cos_incidence(p, cell, None) < least) {
                sight.located.drop(i);
            }
        }
    }

    fn distance(&self, p: &[f64; 3]) -> f64 {
        (nalgebra::Vector3::from(*p) - self.view.pose.centre).norm()
    }

    /// The derivative of the inverse depth by one step of the grid: from the nearest two samples opposite each other
    /// that lie on one line with this one. Zero where there are none.
    fn slope(&self, cell: usize, step: usize) -> f32 {
        let samples = &self.surfaces.samples;
        let own = samples[cell].inverse_depth();
        for k in 1..=REACH {
            if cell < k * step {
                break;
            }
            let (Some(a), Some(b)) = (samples.get(cell + k * step), samples.get(cell - k * step)) else { break };
            if a.found() && b.found() {
                let (a, b) = (a.inverse_depth(), b.inverse_depth());
                if (a + b - 2.0 * own).abs() <= 2.0 * FLATNESS * own {
                    return (a - b) / (2 * k) as f32;
                }
            }
        }
        0.0
    }

    /// The cosine of the angle between the ray to a point and the surface's normal, which is given (in the world frame)
    /// or taken from the depth buffer around the pixel of the point's cell.
    pub(super) fn cos_incidence(&self, p: &[f64; 3], cell: usize, normal: Option<&[f64; 3]>) -> f64 {
        let ray = nalgebra::Vector3::from(*p) - self.view.pose.centre;
        if let Some(normal) = normal.map(|n| nalgebra::Vector3::from(*n)) {
            let cos = (normal.dot(&ray) / (normal.norm() * ray.norm())).abs();
            if cos.is_finite() {
                return cos;
            }
        }
        let camera = &self.view.camera;
        let pixel = self.surfaces.limits.pixel_of(cell);
        let own = f64::from(self.surfaces.samples[pixel].inverse_depth());
        let stride = self.surfaces.grid.stride();
        let (gx, gy) = (f64::from(self.slope(pixel, 1)), f64::from(self.slope(pixel, stride)));
        let q = self.view.pose.transform(p);
        match camera.depth_kind() {
            Depth::AlongAxis => {
                // A plane n · X = 1 has inverse depth n · (u, v, 1).
                let (u, v) = (q.x / q.z, q.y / q.z);
                let params = camera.params();
                let (nu, nv) = (gx * params[0], gy * params[1]);
                let normal = nalgebra::Vector3::new(nu, nv, own - u * nu - v * nv);
                own / (normal.norm() * (u * u + v * v + 1.0).sqrt())
            }
            Depth::Range => {
                let squeeze = match camera.model() {
                    Model::Equirectangular => (q.x.hypot(q.z) / q.norm()).max(1e-3),
                    _ => 1.0,
                };
                let tan = (gx / squeeze).hypot(gy) / (own * self.pixel_angle);
                1.0 / (1.0 + tan * tan).sqrt()
            }
        }
    }

    /// How good the photo's view of a point is, for choosing among photos: pixels for each area of the surface (which
    /// falls with distance and incidence), less at the photo's border and beside depth edges.
    pub(super) fn weight(&self, p: &[f64; 3], xy: [f64; 2], cell: usize, normal: Option<&[f64; 3]>) -> f32 {
        let metres = self.distance(p) * self.pixel_angle;
        let density = self.cos_incidence(p, cell, normal).max(1e-3) / (metres * metres);
        let (w, h) = (f64::from(self.view.camera.width), f64::from(self.view.camera.height));
        let mut inside = (xy[1] + 0.5).min(h - 0.5 - xy[1]);
        if !self.surfaces.grid.wraps {
            inside = inside.min(xy[0] + 0.5).min(w - 0.5 - xy[0]);
        }
        let border = (inside / (BORDER * w.max(h))).clamp(0.05, 1.0);
        let edge = if self.near_an_edge(self.surfaces.limits.pixel_of(cell)) { 0.2 } else { 1.0 };
        (density * border * edge) as f32
    }

    /// Whether the depth steps within three cells.
    fn near_an_edge(&self, cell: usize) -> bool {
        let depth =
            |cell: usize| self.surfaces.samples.get(cell).filter(|s| s.found()).map_or(0.0, |s| s.inverse_depth());
        let own = depth(cell);
        let stride = self.surfaces.grid.stride();
        [3, 3 * stride, 2 + 2 * stride, 2 * stride - 2].iter().any(|&step| {
            let (a, b) = (depth(cell + step), cell.checked_sub(step).map_or(0.0, depth));
            // On one surface, however slanted, the two lie on a line with the middle.
            let stepped = |v: f32| v > 0.0 && (v - own).abs() > EDGE * own;
            let straight = a > 0.0 && b > 0.0 && (a + b - 2.0 * own).abs() <= EDGE * own;
            (stepped(a) || stepped(b)) && !straight
        })
    }
}

/// What a photo sees of a block of points.
pub(super) struct Sight {
    block: Block,
    located: Located,
}

impl Sight {
    pub fn new() -> Self {
        Self { block: Block::new(), located: Located::new() }
    }

    /// The cell of a point, if it is seen.
    #[inline(always)]
    pub fn cell(&self, i: usize) -> Option<usize> {
        self.located.get(i).map(|(cell, _)| cell)
    }

    /// Where in the photo the points lie, right and down.
    #[cfg(target_arch = "x86_64")]
    #[inline(always)]
    pub fn positions(&self) -> [&[f64; LANES]; 2] {
        [&self.block.x, &self.block.y]
    }

    /// Where in the photo a point lies.
    #[inline(always)]
    pub fn xy(&self, i: usize) -> [f64; 2] {
        [self.block.x[i], self.block.y[i]]
    }
}
