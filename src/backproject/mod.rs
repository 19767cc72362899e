//! From photo pixels back to points of space.
//!
//! A pixel fixes a ray, and a depth the point on it: `X = C + s Rᵀ w`, with `w` the pixel's direction in the camera frame
//! after its distortion was removed. For a DLT matrix whose third row is metric that is `X = M⁻¹ (s x̃ − p₄)`, the same
//! point as `P⁺ x̃ + λ C̃` with λ fixed by the depth `s` ([`invert_dlt`], [`invert_dlt_by_pseudo_inverse`]).
//!
//! Where the depth comes from is the other half ([`backproject_pixels`]): from the synthetic camera image in the same
//! view. A pixel with a measured point takes that point's depth, another one a depth interpolated within *one* surface;
//! beside the cloud a surface may be extended. Across a depth edge there is no depth.
//!
//! Source: Hartley and Zisserman, Multiple View Geometry, 6.2.2; the paper, 3.1.

mod opening;
mod surface;
mod tile;

use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;

use crate::error::{Error, Result};
use crate::geometry::{Camera, Depth, DltParts, View};
use tile::Tile;

/// Side of the tiles that are worked off at once, pixels.
const TILE: usize = 64;
/// So many tiles tell how regularly a scan samples its surfaces.
const TOLD: usize = 64;
/// An opening between samples may be wider than those of the scan usually are by this factor, and by the square of the
/// one from their lower quartile to their median.
const WIDER: f64 = 1.3;

/// Where a depth comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Origin {
    /// There is none.
    None = 0,
    /// A point was measured in this pixel.
    Measured = 1,
    /// Measured points of one surface lie around it.
    Interpolated = 2,
    /// Measured points of one surface lie beside it, and none of another on its other side.
    Extended = 3,
}

/// The depths of a synthetic camera image.
#[derive(Debug, Clone, Copy)]
pub enum Depths<'a> {
    /// As images hold them.
    Single(&'a [f32]),
    /// Where seven digits are not enough.
    Double(&'a [f64]),
}

impl Depths<'_> {
    fn len(&self) -> usize {
        match self {
            Self::Single(d) => d.len(),
            Self::Double(d) => d.len(),
        }
    }

    #[inline(always)]
    fn at(&self, i: usize) -> f64 {
        match self {
            Self::Single(d) => f64::from(d[i]),
            Self::Double(d) => d[i],
        }
    }

    /// What rounding leaves open, relative.
    fn rounding(&self) -> f64 {
        match self {
            Self::Single(_) => 1.2e-7,
            Self::Double(_) => 1e-13,
        }
    }
}

/// A synthetic camera image of the view, row by row.
#[derive(Debug, Clone, Copy)]
pub struct DepthImage<'a> {
    /// As the camera has it; NaN or 0 where empty.
    pub depth: Depths<'a>,
    /// Whether a point lies in the pixel; other depths are not looked at.
    pub measured: &'a [bool],
    /// The point's true place from the pixel's centre, x and y; the centre itself if there is none.
    pub subpixel: Option<&'a [[f32; 2]]>,
}

/// How depths are found, and how sure their sources are.
#[derive(Debug, Clone, Copy)]
pub struct BackprojectOptions {
    /// Samples within this radius make a surface, pixels.
    pub radius: f64,
    /// How far a surface is extended beside the cloud, pixels; 0 for not at all.
    pub extension: f64,
    /// The largest angle between a ray and a surface's normal at which it is interpolated or extended, radians.
    pub max_incidence: f64,
    /// Noise of the depths, one sigma, metres.
    pub depth_sigma: f64,
    /// Of a pixel's place, by the registration and the photo, one sigma per axis, pixels.
    pub pixel_sigma: f64,
    /// Of a measured point's place in its pixel where `subpixel` is not given, one sigma per axis, pixels.
    pub placement_sigma: f64,
}

impl Default for BackprojectOptions {
    fn default() -> Self {
        Self {
            radius: 4.0,
            extension: 0.0,
            max_incidence: 85f64.to_radians(),
            depth_sigma: 0.003,
            pixel_sigma: 0.5,
            placement_sigma: 12f64.sqrt().recip(),
        }
    }
}

impl BackprojectOptions {
    fn check(&self) -> Result<()> {
        let refuse = |what: &str, value: f64| Err(Error::invalid(format!("{what} of {value} is not possible")));
        if !(self.radius >= 1.5 && self.radius <= 32.0) {
            return refuse("a radius (1.5 to 32 pixels)", self.radius);
        }
        if !(self.extension >= 0.0 && self.extension <= 1000.0) {
            return refuse("an extension (0 to 1000 pixels)", self.extension);
        }
        if !(self.max_incidence > 0.0 && self.max_incidence < std::f64::consts::FRAC_PI_2) {
            return refuse("a largest angle of incidence", self.max_incidence);
        }
        for (what, sigma) in [
            ("a depth sigma", self.depth_sigma),
            ("a pixel sigma", self.pixel_sigma),
            ("a placement sigma", self.placement_sigma),
        ] {
            if !(sigma.is_finite() && sigma >= 0.0) {
                return refuse(what, sigma);
            }
        }
        Ok(())
    }
}

/// The point behind a pixel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Backprojected {
    /// World; NaN where there is none.
    pub xyz: [f64; 3],
    /// As the camera has it.
    pub depth: f64,
    /// Where the depth comes from.
    pub origin: Origin,
    /// Along the ray, one sigma, metres.
    pub sigma_along: f64,
    /// Across the ray, one sigma per axis, metres.
    pub sigma_across: f64,
}

impl Backprojected {
    /// Nothing is known of this pixel.
    pub const NONE: Self = Self {
        xyz: [f64::NAN; 3],
        depth: f64::NAN,
        origin: Origin::None,
        sigma_along: f64::NAN,
        sigma_across: f64::NAN,
    };
}

/// The direction of a pixel in the camera frame such that a point is `depth · direction`: third coordinate 1 for depths
/// along the axis, a unit vector for ranges.
#[inline]
pub(crate) fn direction(camera: &Camera, xy: &[f64; 2]) -> Option<Vector3<f64>> {
    let unit = camera.unproject(xy)?;
    match camera.depth_kind() {
        Depth::AlongAxis => (unit.z > 0.0).then(|| unit / unit.z),
        Depth::Range => Some(unit),
    }
}

/// The point at a depth along a direction.
#[inline]
fn point(view: &View, direction: &Vector3<f64>, depth: f64) -> [f64; 3] {
    // The difference to the centre is formed first: large coordinates lose nothing.
    (view.pose.rotation.transpose() * direction * depth + view.pose.centre).into()
}

/// Pixels with given depths to points of the world; NaN where the lens images nothing or the depth is not positive.
pub fn backproject(view: &View, xy: &[[f64; 2]], depth: &[f64]) -> Result<Vec<[f64; 3]>> {
    if xy.len() != depth.len() {
        return Err(Error::invalid(format!("{} pixels have {} depths", xy.len(), depth.len())));
    }
    let one = |(xy, &depth): (&[f64; 2], &f64)| {
        let ray = if depth > 0.0 { direction(&view.camera, xy) } else { None };
        ray.map_or([f64::NAN; 3], |ray| point(view, &ray, depth))
    };
    Ok(xy.par_iter().zip(depth).with_min_len(256).map(one).collect())
}

/// `X = M⁻¹ (s x̃ − p₄)` for the matrix scaled so that its third row gives the depth.
pub fn invert_dlt(p: &[[f64; 4]; 3], xy: &[[f64; 2]], depth: &[f64]) -> Result<Vec<[f64; 3]>> {
    if xy.len() != depth.len() {
        return Err(Error::invalid(format!("{} pixels have {} depths", xy.len(), depth.len())));
    }
    let parts = DltParts::from_matrix(p)?;
    let m = Matrix3::from_fn(|i, j| parts.scaled[i][j]);
    let inverse = m.try_inverse().ok_or_else(|| Error::Internal("singular M after its check".into()))?;
    // −M⁻¹ p₄ is the projection centre.
    let one = |(xy, s): (&[f64; 2], &f64)| (parts.centre + inverse * Vector3::new(xy[0], xy[1], 1.0) * *s).into();
    Ok(xy.iter().zip(depth).map(one).collect())
}

/// The same points as [`invert_dlt`] by the pseudo-inverse: `P⁺ x̃ + λ C̃`.
///
/// Multiplied by P that is x̃ for any λ, and the homogeneous scale of the point is one over its depth: so λ is fixed by
/// the depth. Coordinates far from the origin lose digits in P⁺; [`invert_dlt`] does not.
pub fn invert_dlt_by_pseudo_inverse(p: &[[f64; 4]; 3], xy: &[[f64; 2]], depth: &[f64]) -> Result<Vec<[f64; 3]>> {
    if xy.len() != depth.len() {
        return Err(Error::invalid(format!("{} pixels have {} depths", xy.len(), depth.len())));
    }
    let parts = DltParts::from_matrix(p)?;
    let p = nalgebra::Matrix3x4::from_fn(|i, j| parts.scaled[i][j]);
    // P⁺ = Pᵀ (P Pᵀ)⁻¹ for a matrix of full rank.
    let gram = (p * p.transpose()).try_inverse();
    let pseudo = p.transpose() * gram.ok_or_else(|| Error::Internal("singular P Pᵀ after its check".into()))?;
    let centre = nalgebra::Vector4::new(parts.centre.x, parts.centre.y, parts.centre.z, 1.0);
    let one = |(xy, s): (&[f64; 2], &f64)| {
        let some = pseudo * Vector3::new(xy[0], xy[1], 1.0);
        let lambda = 1.0 / s - some.w;
        let x = some + centre * lambda;
        [x.x / x.w, x.y / x.w, x.z / x.w]
    };
    Ok(xy.iter().zip(depth).map(one).collect())
}

fn check(view: &View, image: &DepthImage, options: &BackprojectOptions) -> Result<()> {
    options.check()?;
    let (w, h) = (view.camera.width as usize, view.camera.height as usize);
    let subpixel = image.subpixel.map_or(w * h, <[_]>::len);
    for (what, n) in [("depths", image.depth.len()), ("measured", image.measured.len()), ("subpixel", subpixel)] {
        if n != w * h {
            return Err(Error::invalid(format!(
                "{what} has {n} pixels, but the view's image has {w} × {h}: render it in this view"
            )));
        }
    }
    Ok(())
}

/// How wide an opening between the samples of a surface may be, in their spacings, before something else is seen through
/// it: the scan's own openings tell. Those of a regular grid are all the same, so that one missing row of samples stands
/// out; points strewn at random leave far wider ones beside narrow ones. The lower half of them tells how far they spread,
/// as the space between bars and leaves is in the upper one.
fn widest(view: &View, image: &DepthImage, options: &BackprojectOptions) -> f64 {
    let columns = (view.camera.width as usize).div_ceil(TILE);
    let tiles = columns * (view.camera.height as usize).div_ceil(TILE);
    let chosen: Vec<usize> = (0..tiles).step_by(tiles.div_ceil(TOLD)).collect();
    let told: Vec<Vec<f64>> = chosen
        .par_iter()
        .map_init(Tile::default, |tile, number| {
            tile.load(view, image, options, number % columns * TILE, number / columns * TILE);
            tile.openings(view, options)
        })
        .collect();
    let mut told: Vec<f64> = told.into_iter().flatten().collect();
    if told.is_empty() {
        return f64::INFINITY;
    }
    told.sort_unstable_by(f64::total_cmp);
    let (lower, middle) = (told[told.len() / 4], told[told.len() / 2]);
    WIDER * middle * (middle / lower).powi(2)
}

/// The points behind given pixels, each anywhere in the image.
pub fn backproject_pixels(
    view: &View,
    image: &DepthImage,
    xy: &[[f64; 2]],
    options: &BackprojectOptions,
) -> Result<Vec<Backprojected>> {
    check(view, image, options)?;
    let widest = widest(view, image, options);
    let columns = (view.camera.width as usize).div_ceil(TILE);
    let tile_of = |p: &[f64; 2]| {
        let inside = view.camera.contains(p);
        let cell = |v: f64| (v + 0.5).max(0.0) as usize / TILE;
        if inside { (cell(p[1]) * columns + cell(p[0])) as u32 } else { u32::MAX }
    };
    let mut order: Vec<(u32, u32)> = xy.iter().enumerate().map(|(i, p)| (tile_of(p), i as u32)).collect();
    order.par_sort_unstable();
    let groups: Vec<&[(u32, u32)]> = order.chunk_by(|a, b| a.0 == b.0).filter(|g| g[0].0 != u32::MAX).collect();
    let found: Vec<Vec<(u32, Backprojected)>> = groups
        .par_iter()
        .map_init(Tile::default, |tile, group| {
            let number = group[0].0 as usize;
            tile.load(view, image, options, number % columns * TILE, number / columns * TILE);
            group.iter().map(|&(_, i)| (i, tile.at(view, &xy[i as usize], widest, options))).collect()
        })
        .collect();
    let mut out = vec![Backprojected::NONE; xy.len()];
    for (i, one) in found.into_iter().flatten() {
        out[i as usize] = one;
    }
    Ok(out)
}

/// The points behind all pixels' centres that have one, with the pixels' numbers (row · width + column), in their order.
pub fn backproject_image(
    view: &View,
    image: &DepthImage,
    options: &BackprojectOptions,
) -> Result<(Vec<u32>, Vec<Backprojected>)> {
    check(view, image, options)?;
    let (width, height) = (view.camera.width as usize, view.camera.height as usize);
    let widest = widest(view, image, options);
    let bands: Vec<usize> = (0..height).step_by(TILE).collect();
    let found: Vec<Vec<(u32, Backprojected)>> = bands
        .par_iter()
        .map_init(Tile::default, |tile, &y0| {
            let mut band = Vec::new();
            for x0 in (0..width).step_by(TILE) {
                tile.load(view, image, options, x0, y0);
                for y in y0..(y0 + TILE).min(height) {
                    for x in x0..(x0 + TILE).min(width) {
                        let one = tile.at(view, &[x as f64, y as f64], widest, options);
                        if one.origin != Origin::None {
                            band.push(((y * width + x) as u32, one));
                        }
                    }
                }
            }
            band.sort_unstable_by_key(|(i, _)| *i);
            band
        })
        .collect();
    Ok(found.into_iter().flatten().unzip())
}

#[cfg(test)]
mod tests;
