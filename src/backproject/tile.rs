//! A square of the image with the rays of its measured pixels, so that each is undistorted once.

use nalgebra::Vector3;

use super::surface::{MOST, Sample, Surface, Tolerance, surface};
use super::{BackprojectOptions, Backprojected, DepthImage, Origin, TILE, direction, point};
use crate::geometry::{Camera, Depth, View, tangents};

/// What curvature may do to a depth over one pixel, in pixels' sizes on the surface.
const CURVATURE: f64 = 0.05;

/// The largest incidence of a surface whose slope is believed, radians.
const GRAZING: f64 = 89.5 * std::f64::consts::PI / 180.0;

/// One in so many pixels is looked at for how wide openings a scan leaves.
const CHECKED: usize = 29;

/// The largest angle between a pixel's ray and those of its neighbours.
fn angle_of_a_pixel(camera: &Camera, xy: &[f64; 2]) -> f64 {
    let [x, y] = [xy[0].min(f64::from(camera.width) - 1.0), xy[1].min(f64::from(camera.height) - 1.0)];
    let angle = |p: [f64; 2], q: [f64; 2]| Some(camera.unproject(&p)?.cross(&camera.unproject(&q)?).norm());
    let angles = [angle([x, y], [x + 1.0, y]), angle([x, y], [x, y + 1.0])];
    let largest = angles.into_iter().flatten().fold(0.0, f64::max);
    // Outside a fisheye's circle there is no ray: any pixel's angle is near enough.
    if largest > 0.0 { largest } else { 2.0 * camera.max_angle().min(1.5) / f64::from(camera.width) }
}

/// A measured pixel.
#[derive(Debug, Clone, Copy)]
struct Measured {
    /// Its ray; zero where nothing was measured.
    ray: Vector3<f64>,
    inverse: f64,
    /// The point's true place, pixels.
    place: [f64; 2],
}

const EMPTY: Measured = Measured { ray: Vector3::new(0.0, 0.0, 0.0), inverse: 0.0, place: [0.0; 2] };

/// Measured pixels of a tile and its surroundings.
#[derive(Default)]
pub(super) struct Tile {
    x0: isize,
    y0: isize,
    side: isize,
    pixels: Vec<Measured>,
    /// Pixel offsets within reach, nearest first.
    around: Vec<(f64, isize, isize)>,
    rounding: f64,
    has_places: bool,
    /// The angle of a pixel, radians, which hardly changes over a tile.
    pixel: f64,
}

impl Tile {
    /// Reads the measured pixels of the tile that begins at (x0, y0).
    pub fn load(&mut self, view: &View, image: &DepthImage, options: &BackprojectOptions, x0: usize, y0: usize) {
        let margin = (options.radius + options.extension).ceil() as isize + 1;
        if self.around.is_empty() {
            let offsets = (-margin..=margin).flat_map(|j| (-margin..=margin).map(move |i| (i, j)));
            self.around = offsets
                .map(|(i, j)| ((i as f64).hypot(j as f64), i, j))
                .filter(|(d, ..)| *d <= options.radius + options.extension)
                .collect();
            self.around.sort_by(|a, b| a.0.total_cmp(&b.0));
        }
        (self.x0, self.y0) = (x0 as isize - margin, y0 as isize - margin);
        self.side = TILE as isize + 2 * margin;
        self.rounding = image.depth.rounding();
        self.has_places = image.subpixel.is_some();
        let middle = [(x0 + TILE / 2) as f64, (y0 + TILE / 2) as f64];
        self.pixel = angle_of_a_pixel(&view.camera, &middle);
        self.pixels.clear();
        self.pixels.resize((self.side * self.side) as usize, EMPTY);
        let (width, height) = (view.camera.width as isize, view.camera.height as isize);
        for y in self.y0.max(0)..(self.y0 + self.side).min(height) {
            for x in self.x0.max(0)..(self.x0 + self.side).min(width) {
                let i = (y * width + x) as usize;
                let depth = image.depth.at(i);
                if !(image.measured[i] && depth.is_finite() && depth > 0.0) {
                    continue;
                }
                let shift = image.subpixel.map_or([0.0; 2], |s| s[i].map(f64::from));
                let place = [x as f64 + shift[0], y as f64 + shift[1]];
                if let Some(ray) = direction(&view.camera, &place) {
                    let at = ((y - self.y0) * self.side + x - self.x0) as usize;
                    self.pixels[at] = Measured { ray, inverse: 1.0 / depth, place };
                }
            }
        }
    }

    fn get(&self, x: isize, y: isize) -> Option<&Measured> {
        let (i, j) = (x - self.x0, y - self.y0);
        let inside = (0..self.side).contains(&i) && (0..self.side).contains(&j);
        let pixel = inside.then(|| &self.pixels[(j * self.side + i) as usize])?;
        (pixel.inverse > 0.0).then_some(pixel)
    }

    /// How wide the scan's openings are, in spacings of their surfaces: at some corners of pixels, in their own as well as in
    /// between, so that those few between bars in a dense scan are not alone.
    pub fn openings(&self, view: &View, options: &BackprojectOptions) -> Vec<f64> {
        let margin = (self.side - TILE as isize) / 2;
        let opening = |at: usize| {
            let (x, y) = (self.x0 + margin + (at % TILE) as isize, self.y0 + margin + (at / TILE) as isize);
            let xy = [x as f64 + 0.5, y as f64 + 0.5];
            let basis = Basis::new(view.camera.depth_kind(), direction(&view.camera, &xy)?, self.pixel);
            let samples = self.samples(&basis, &xy, (x, y), options.radius);
            let found = self.surface(&basis, &samples, options.max_incidence, options)?;
            if !found.surrounds {
                return None;
            }
            found.opening(&samples, &self.tolerance(&basis, &samples, options)).map(|opening| opening.width)
        };
        (0..TILE * TILE).step_by(CHECKED).filter_map(opening).collect()
    }

    /// The point behind a place in the tile. Openings between samples may be as wide as `widest`, in their spacings.
    pub fn at(&self, view: &View, xy: &[f64; 2], widest: f64, options: &BackprojectOptions) -> Backprojected {
        let Some(ray) = direction(&view.camera, xy) else { return Backprojected::NONE };
        let (x, y) = ((xy[0] + 0.5).floor() as isize, (xy[1] + 0.5).floor() as isize);
        let basis = Basis::new(view.camera.depth_kind(), ray, self.pixel);
        if let Some(own) = self.get(x, y) {
            return self.measured(view, &basis, own, xy, options);
        }
        let Some(&(first, i, j)) = self.around.iter().find(|(_, i, j)| self.get(x + i, y + j).is_some()) else {
            return Backprojected::NONE;
        };
        // Beside the cloud the samples are gathered about the nearest one.
        let beside = first > 0.5 * options.radius;
        let about = if beside { (x + i, y + j) } else { (x, y) };
        let samples = self.samples(&basis, xy, about, options.radius);
        let Some(mut found) = self.surface(&basis, &samples, options.max_incidence, options) else {
            return Backprojected::NONE;
        };
        let origin = if found.surrounds {
            let opening = found.opening(&samples, &self.tolerance(&basis, &samples, options));
            let Some(opening) = opening.filter(|o| o.width <= widest && !o.edge) else { return Backprojected::NONE };
            found.sigma = found.sigma.hypot(opening.relief);
            Origin::Interpolated
        } else if !found.bounded && first <= options.extension && !self.another_beyond(&basis, &found, (x, y), options)
        {
            Origin::Extended
        } else {
            return Backprojected::NONE;
        };
        basis.point(view, origin, found.value.x, found.sigma, found.slope(&basis), options)
    }

    /// A pixel in which a point was measured: that point's depth, carried along its surface to the very place.
    fn measured(
        &self,
        view: &View,
        basis: &Basis,
        own: &Measured,
        xy: &[f64; 2],
        options: &BackprojectOptions,
    ) -> Backprojected {
        let shift = [own.place[0] - xy[0], own.place[1] - xy[1]];
        let distance = shift[0].hypot(shift[1]);
        let (cx, cy) = ((xy[0] + 0.5).floor() as isize, (xy[1] + 0.5).floor() as isize);
        let samples = self.samples(basis, &own.place, (cx, cy), options.radius.min(2.5));
        let found = self.surface(basis, &samples, options.max_incidence, options);
        let noise = options.depth_sigma * own.inverse * own.inverse;
        let unknown = if self.has_places { 0.0 } else { options.placement_sigma };
        match found {
            Some(found) => {
                // The surface tells the ratio, the point itself the depth.
                let at_place = found.value.dot(&basis.coefficients(&own.ray));
                let inverse = own.inverse * found.value.x / at_place;
                let slope = found.slope(basis);
                let moved = slope.tan() * basis.pixel * unknown * inverse;
                basis.point(view, Origin::Measured, inverse, noise.hypot(moved), slope, options)
            }
            None => {
                // At grazing incidence a plane may stand across a depth edge: it does not carry the point, but its slope
                // says how far off the point may be. Where there is none, 60 degrees are taken for what it may do.
                let grazing = self.surface(basis, &samples, GRAZING, options);
                let slope = grazing.map_or(std::f64::consts::FRAC_PI_3, |found| found.slope(basis));
                let moved = slope.tan() * basis.pixel * distance.hypot(unknown) * own.inverse;
                basis.point(view, Origin::Measured, own.inverse, noise.hypot(moved), slope, options)
            }
        }
    }

    /// Measured pixels about a pixel, the nearest to `xy` first.
    fn samples(&self, basis: &Basis, xy: &[f64; 2], (x, y): (isize, isize), radius: f64) -> Vec<Sample> {
        let mut samples = Vec::with_capacity(MOST);
        for &(distance, i, j) in &self.around {
            if distance > radius || samples.len() == MOST {
                break;
            }
            if let Some(pixel) = self.get(x + i, y + j) {
                let offset = [pixel.place[0] - xy[0], pixel.place[1] - xy[1]];
                samples.push(Sample { row: basis.coefficients(&pixel.ray), inverse: pixel.inverse, offset });
            }
        }
        samples.sort_by(|a, b| a.offset[0].hypot(a.offset[1]).total_cmp(&b.offset[0].hypot(b.offset[1])));
        samples
    }

    /// How far samples may be from a plane, the first of them being the nearest.
    fn tolerance(&self, basis: &Basis, samples: &[Sample], options: &BackprojectOptions) -> Tolerance {
        let inverse = samples.first().map_or(0.0, |s| s.inverse);
        Tolerance { sigma: options.depth_sigma * inverse, systematic: self.rounding + CURVATURE * basis.pixel }
    }

    fn surface(
        &self,
        basis: &Basis,
        samples: &[Sample],
        max_incidence: f64,
        options: &BackprojectOptions,
    ) -> Option<Surface> {
        let limit = max_incidence.cos();
        let tolerance = self.tolerance(basis, samples, options);
        surface(samples, options.radius, &tolerance, |value| basis.cosine(value) >= limit)
    }

    /// Whether something else was measured on the other side of an extended pixel, as near as the surface's own points.
    fn another_beyond(
        &self,
        basis: &Basis,
        found: &Surface,
        (x, y): (isize, isize),
        options: &BackprojectOptions,
    ) -> bool {
        let depth_tolerance =
            4.0 * options.depth_sigma * found.value.x + 20.0 * CURVATURE * basis.pixel + self.rounding;
        self.around.iter().filter_map(|(_, i, j)| self.get(x + i, y + j)).any(|pixel| {
            let predicted = found.value.dot(&basis.coefficients(&pixel.ray));
            (predicted - pixel.inverse).abs() > depth_tolerance * pixel.inverse
        })
    }
}

impl Surface {
    /// The angle between the ray and the surface's normal.
    fn slope(&self, basis: &Basis) -> f64 {
        basis.cosine(&self.value).min(1.0).acos()
    }
}

/// Directions in terms of a pixel's ray and two across.
struct Basis {
    ray: Vector3<f64>,
    kind: Depth,
    across: [Vector3<f64>; 2],
    /// The angle of a pixel, radians.
    pixel: f64,
}

impl Basis {
    fn new(kind: Depth, ray: Vector3<f64>, pixel: f64) -> Self {
        let across = match kind {
            Depth::AlongAxis => [Vector3::x(), Vector3::y()],
            Depth::Range => {
                let (first, second) = tangents(&ray);
                [first, second]
            }
        };
        Self { ray, kind, across, pixel }
    }

    /// Such that a direction is `c₀ ray + c₁ across₀ + c₂ across₁`.
    #[inline(always)]
    fn coefficients(&self, direction: &Vector3<f64>) -> Vector3<f64> {
        match self.kind {
            Depth::AlongAxis => Vector3::new(1.0, direction.x - self.ray.x, direction.y - self.ray.y),
            Depth::Range => {
                let [a, b] = &self.across;
                Vector3::new(direction.dot(&self.ray), direction.dot(a), direction.dot(b))
            }
        }
    }

    /// Cosine of the angle between the ray and the normal of a plane.
    fn cosine(&self, value: &Vector3<f64>) -> f64 {
        let normal = match self.kind {
            Depth::AlongAxis => Vector3::new(value.y, value.z, value.x - value.y * self.ray.x - value.z * self.ray.y),
            Depth::Range => self.ray * value.x + self.across[0] * value.y + self.across[1] * value.z,
        };
        (normal.dot(&self.ray) / (normal.norm() * self.ray.norm())).abs()
    }

    /// The point at an inverse depth, with what is uncertain about it.
    fn point(
        &self,
        view: &View,
        origin: Origin,
        inverse: f64,
        sigma_inverse: f64,
        slope: f64,
        options: &BackprojectOptions,
    ) -> Backprojected {
        let depth = 1.0 / inverse;
        let range = depth * self.ray.norm();
        let across = range * self.pixel * options.pixel_sigma;
        // A pixel aside on a slanted surface is farther or nearer.
        let along = (range * sigma_inverse * depth).hypot(across * slope.tan());
        Backprojected { xyz: point(view, &self.ray, depth), depth, origin, sigma_along: along, sigma_across: across }
    }
}
