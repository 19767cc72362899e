//! Which surfaces hide what lies behind them, found from the merged depth buffer alone.
//!
//! A scan is points, not surfaces: between the points of a near wall the far façade shows. Where the wall's points lie
//! *around* a place, the wall covers it; where they lie on one side only, the place is beside the wall. So a place is
//! covered as deep as the shallowest of two samples that lie opposite each other about it, seen in at least two
//! directions. On a slanted surface one of two opposite samples is never in front of the place between them, so that
//! a surface seen at a grazing angle does not hide itself; and beyond a straight edge there are no opposite samples, so
//! that surfaces do not grow.
//!
//! How far apart opposite samples may lie follows the samples' own spacing: a pyramid of buffers, each with cells twice
//! as wide, where a sample that has neighbours on its own surface in two directions goes up no more than one level.
//! "Its own surface": three samples in a row whose inverse depths lie on a line, since the inverse depth of a plane is
//! an affine function of the pixel position.
//!
//! Everything here is a function of the merged buffer: chunks, their order and threads cannot be seen in it. The idea of
//! judging a point by the sectors in which samples lie before it is that of Pintus, Gobbetti and Agus, Real-time
//! rendering of massive unstructured raw point clouds using screen-space operators, 2011.

use rayon::prelude::*;

use super::zbuffer::{DepthBuffer, Grid, PAD};
use crate::error::{Error, Result};
use crate::geometry::View;

/// How surfaces are told from gaps, and how much in front "in front" is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Footprint {
    /// Noise of the depths, relative: what is in front by less hides nothing.
    pub tolerance: f32,
    /// The tangent of the steepest incidence at which a surface of unknown slope is expected.
    pub roughness: f32,
    /// How many cells along the local slope count as the same place.
    pub slope_cells: f32,
    /// How far from a line, relative, three samples of one surface may lie.
    pub flatness: f32,
    /// The widest cell, as a power of two pixels.
    pub max_level: usize,
}

impl Default for Footprint {
    fn default() -> Self {
        Self { tolerance: 0.003, roughness: 1.7, slope_cells: 1.25, flatness: 0.01, max_level: 4 }
    }
}

impl Footprint {
    /// With a given relative tolerance and a widest gap in pixels that may be closed, or the defaults.
    pub fn new(tolerance: Option<f64>, max_gap: Option<f64>) -> Result<Self> {
        let mut this = Self::default();
        if let Some(tolerance) = tolerance {
            if !(0.0..1.0).contains(&tolerance) {
                return Err(Error::invalid(format!("a relative tolerance of {tolerance} is not between 0 and 1")));
            }
            this.tolerance = tolerance as f32;
        }
        if let Some(gap) = max_gap {
            if !(0.0..=1e4).contains(&gap) {
                return Err(Error::invalid(format!("a widest gap of {gap} pixels is not between 0 and 10000")));
            }
            // Opposite samples are up to four cells apart.
            this.max_level = ((gap / 4.0).max(1.0).log2().round()) as usize;
        }
        Ok(this)
    }
}

/// The surfaces of a finished depth buffer.
pub struct Surfaces {
    /// How the cells lie.
    pub grid: Grid,
    /// Inverse depth of the nearest point in each cell, 0 where empty.
    pub inverse_depth: Vec<f32>,
    /// A point in this cell is hidden when its inverse depth is below this; 0 where nothing hides.
    pub limit: Vec<f32>,
}

impl Surfaces {
    /// From a depth buffer that everything was put into.
    pub fn new(buffer: DepthBuffer, footprint: &Footprint) -> Self {
        let (view, grid) = (*buffer.view(), buffer.grid());
        Self::from_inverse_depth(&view, grid, buffer.into_inverse_depth(), footprint)
    }

    /// From the inverse depths in the cells of a grid.
    pub fn from_inverse_depth(view: &View, grid: Grid, inverse_depth: Vec<f32>, footprint: &Footprint) -> Self {
        let mut level = Level {
            width: grid.stride() - 2 * PAD,
            height: grid.rows() - 2 * PAD,
            samples: inverse_depth,
            last_time: Vec::new(),
        };
        let pixel_angle = pixel_angle(view);
        let levels = (grid.width.max(grid.height) / 64).max(1).ilog2().min(footprint.max_level as u32) as usize;
        let mut finest: Option<Vec<f32>> = None;
        let mut limits: Vec<(usize, Vec<f32>)> = Vec::new();
        for k in 0..=levels {
            if grid.wraps {
                level.wrap();
            }
            let cell = (1_u32 << k) as f32;
            let rule = Rule {
                relative: footprint.tolerance + footprint.roughness * cell * pixel_angle,
                slope_cells: footprint.slope_cells,
                flatness: footprint.flatness,
                own_cell: k == 0,
            };
            let (limit, next) = level.analyse(&rule);
            let stride = level.stride();
            let done = std::mem::replace(&mut level, next);
            limits.push((stride, limit));
            finest.get_or_insert(done.samples);
        }
        // Coarse limits hold in all the cells below them.
        while limits.len() > 1 {
            if let (Some((coarse_stride, coarse)), Some((stride, fine))) = (limits.pop(), limits.last_mut()) {
                fine.par_chunks_mut(2 * *stride).enumerate().skip(PAD / 2).for_each(|(y, rows)| {
                    let Some(parents) = coarse.chunks(coarse_stride).nth(y - PAD / 2 + PAD) else { return };
                    for row in rows.chunks_mut(*stride) {
                        for (pair, &parent) in row[PAD..].chunks_mut(2).zip(&parents[PAD..]) {
                            for limit in pair {
                                *limit = if *limit > parent { *limit } else { parent };
                            }
                        }
                    }
                });
            }
        }
        let limit = limits.pop().map(|(_, limit)| limit).unwrap_or_default();
        Self { grid, inverse_depth: finest.unwrap_or_default(), limit }
    }
}

/// Radians that a pixel spans in the middle of the photo.
pub(crate) fn pixel_angle(view: &View) -> f32 {
    let camera = &view.camera;
    let (x, y) = (0.5 * f64::from(camera.width), 0.5 * f64::from(camera.height));
    let fallback = 2.0 * std::f64::consts::PI / f64::from(camera.width);
    match (camera.unproject(&[x - 0.5, y]), camera.unproject(&[x + 0.5, y])) {
        (Some(a), Some(b)) => (a - b).norm() as f32,
        _ => fallback as f32,
    }
}

/// The constants of one level.
struct Rule {
    relative: f32,
    slope_cells: f32,
    flatness: f32,
    /// Whether a sample covers its cell without neighbours.
    own_cell: bool,
}

/// The samples in cells of one size, with a rim of [`PAD`] cells.
struct Level {
    width: usize,
    height: usize,
    /// Inverse depths, 0 where empty.
    samples: Vec<f32>,
    /// Samples whose surface was resolved one level below: they go no further up. Empty for "none".
    last_time: Vec<bool>,
}

/// Offsets (x, y) of the first of two opposite cells, three in each of four directions.
const DIRECTIONS: [[(isize, isize); 3]; 4] =
    [[(1, 0), (2, 0), (2, 1)], [(1, 1), (2, 2), (1, 2)], [(0, 1), (0, 2), (-1, 2)], [(-1, 1), (-2, 2), (-2, 1)]];

#[inline(always)]
fn min(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}

#[inline(always)]
fn max(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

impl Level {
    fn stride(&self) -> usize {
        self.width + 2 * PAD
    }

    /// Fills the rim of a panorama: left and right are neighbours, and beyond a pole lies the other side.
    fn wrap(&mut self) {
        let (w, h, stride) = (self.width, self.height, self.stride());
        for y in PAD..PAD + h {
            let row = &mut self.samples[y * stride..(y + 1) * stride];
            for k in 0..PAD {
                row[k] = row[w + k];
                row[PAD + w + k] = row[PAD + k];
            }
        }
        for k in 0..PAD.min(h) {
            for x in 0..stride {
                let other = PAD + (x + 2 * w - PAD + w / 2) % w;
                self.samples[(PAD - 1 - k) * stride + x] = self.samples[(PAD + k) * stride + other];
                self.samples[(PAD + h + k) * stride + x] = self.samples[(PAD + h - 1 - k) * stride + other];
            }
        }
    }

    /// The limits of this level, in its own layout, and the samples of the next.
    fn analyse(&self, rule: &Rule) -> (Vec<f32>, Level) {
        let stride = self.stride();
        let (next_width, next_height) = (self.width.div_ceil(2), self.height.div_ceil(2));
        let next_stride = next_width + 2 * PAD;
        let mut limit = vec![0.0_f32; self.samples.len()];
        let mut samples = vec![0.0_f32; next_stride * (next_height + 2 * PAD)];
        let mut last_time = vec![false; samples.len()];
        let below = limit.par_chunks_mut(2 * stride).skip(PAD / 2);
        let above = samples.par_chunks_mut(next_stride).zip(last_time.par_chunks_mut(next_stride)).skip(PAD);
        below.zip(above).take(next_height).enumerate().for_each(|(pair, (limits, (up, up_last)))| {
            let mut resolved = vec![false; stride];
            for (k, limit) in limits.chunks_mut(stride).enumerate() {
                let y = PAD + 2 * pair + k;
                if y >= PAD + self.height {
                    break;
                }
                self.analyse_row(y, rule, &mut limit[PAD..PAD + self.width], &mut resolved[PAD..]);
                for x in PAD..PAD + self.width {
                    let i = y * stride + x;
                    let going = self.last_time.is_empty() || !self.last_time[i];
                    let to = PAD + (x - PAD) / 2;
                    if going && self.samples[i] > up[to] {
                        up[to] = self.samples[i];
                        up_last[to] = resolved[x];
                    }
                }
            }
        });
        (limit, Level { width: next_width, height: next_height, samples, last_time })
    }

    fn analyse_row(&self, y: usize, rule: &Rule, limit: &mut [f32], resolved: &mut [bool]) {
        let stride = self.stride();
        let rows: [&[f32]; 5] = std::array::from_fn(|k| &self.samples[(y + k - 2) * stride..][..stride]);
        for x in 0..self.width {
            let at = |dx: isize, dy: isize| rows[(2 + dy) as usize][(x as isize + 2 + dx) as usize];
            resolved[x] = false;
            let own = at(0, 0);
            let mut covered = [0.0_f32; 4];
            for (class, offsets) in covered.iter_mut().zip(&DIRECTIONS) {
                for &(dx, dy) in offsets {
                    *class = max(*class, min(at(dx, dy), at(-dx, -dy)));
                }
            }
            let [a, b, c, d] = covered;
            // The second largest.
            let cover = max(min(max(a, b), max(c, d)), max(min(a, b), min(c, d)));
            let front = max(own, cover);
            if front == 0.0 {
                continue;
            }
            let (mut slope, mut directions) = (0.0_f32, 0);
            for offsets in &DIRECTIONS {
                let mut in_line = false;
                for &(dx, dy) in offsets {
                    let (a, b) = (at(dx, dy), at(-dx, -dy));
                    let one_surface = min(a, b) > 0.0
                        && (a + b - 2.0 * front).abs() <= 2.0 * rule.flatness * front
                        && (a - b).abs() <= 0.3 * front;
                    if one_surface {
                        let reach = 2.0 * ((dx * dx + dy * dy) as f32).sqrt();
                        slope = max(slope, (a - b).abs() / reach);
                        in_line = true;
                    }
                }
                directions += i32::from(in_line);
            }
            let own_in_front = own >= cover;
            resolved[x] = own_in_front && directions >= 2;
            let covers = rule.own_cell || (own_in_front && directions >= 1);
            let surface = if covers { front } else { cover };
            limit[x] = max(surface - front * rule.relative - rule.slope_cells * slope, 0.0);
        }
    }
}
