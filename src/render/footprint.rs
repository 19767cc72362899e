//! Which surfaces hide what lies behind them, found from the merged depth buffer alone.
//!
//! A scan is points, not surfaces: between the points of a near wall the far façade shows. Each sample of the buffer
//! looks for its nearest neighbours *on its own surface*, one in each of four quadrants ([`super::links`]). They give
//! the local plane (the inverse depth of a plane is an affine function of the undistorted pixel position), the local
//! spacing, and how far the sample covers the picture in each direction: to the neighbour where there is one, half a
//! spacing where the surface ends. In that footprint the plane, not the sample's own depth, is what hides: a surface
//! seen at a grazing angle neither hides itself nor lets anything shine through, and an edge does not bleed. Where
//! all samples of a place lie on one plane anyway, one for all of them does ([`super::flat`]), in a fraction of the time.
//!
//! Everything here is a function of the merged buffer: chunks, their order and threads cannot be seen in it.

use std::ops::Range;
use std::sync::{Mutex, PoisonError};

use rayon::prelude::*;

use super::extremes::{larger, smaller};
use super::flat::Flat;
use super::links::{LANES, Links, Surroundings, filled};
use super::marks::{Canvas, MAX_REACH, Marks, Rule};
use super::planes::{PLACE, depth_noise};
use super::pyramid::Pyramid;
use super::sample::Sample;
use super::zbuffer::{DepthBuffer, Grid, PAD};
use crate::error::{Error, Result};
use crate::geometry::View;
use crate::memory::fetched;

/// How surfaces are told from gaps, and how much in front "in front" is. The defaults were set on simulated scans, where
/// they lose about two visible points in a hundred and pass one or two hidden ones.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Footprint {
    /// What is in front by less than this part of the depth hides nothing; `None` for what the noise of the depths
    /// themselves suggests.
    pub tolerance: Option<f32>,
    /// The tangent of the incidence beyond which neighbours are not taken for one surface.
    pub steepest: f32,
    /// How many times farther than the second nearest neighbour another one may lie.
    pub gap_ratio: f32,
    /// The same where there is one on the other side too, as between the rows of a scan at a grazing angle.
    pub row_ratio: f32,
    /// How far a sample covers towards a neighbour, as a part of the distance to it.
    pub inner: f32,
    /// The widest gap that is closed, pixels.
    pub max_gap: f32,
}

impl Default for Footprint {
    fn default() -> Self {
        Self { tolerance: None, steepest: 20.0, gap_ratio: 2.0, row_ratio: 6.0, inner: 0.9, max_gap: 32.0 }
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
            this.tolerance = Some(tolerance as f32);
        }
        if let Some(gap) = max_gap {
            if !(0.0..=MAX_REACH as f64).contains(&gap) {
                return Err(Error::invalid(format!("a widest gap of {gap} pixels is not between 0 and {MAX_REACH}")));
            }
            this.max_gap = gap as f32;
        }
        Ok(this)
    }

    /// An empty depth buffer for this. Where a contour runs it tells to about half a cell: a small photo, whose pixels are as
    /// coarse as the scan, gets cells that are parts of pixels.
    pub fn buffer(&self, view: View) -> Result<DepthBuffer> {
        let pixels = f64::from(view.camera.width) * f64::from(view.camera.height);
        let small = pixels * (PARTS * PARTS) as f64 <= MOST_PARTS as f64;
        let reached = self.max_gap * PARTS as f32 <= MAX_REACH as f32;
        let distinct = self.steepest * pixel_angle(&view) <= DISTINCT;
        DepthBuffer::finer(view, if small && reached && distinct { PARTS } else { 1 })
    }
}

/// The most cells that parts of pixels may come to: as many as a usual photo has pixels.
const MOST_PARTS: usize = 12_000_000;
/// Parts along the side of a pixel. On simulated scans three gained little over two.
const PARTS: usize = 2;

/// Of the pixels with a sample the share whose neighbour on the right has one too above which parts of pixels tell nothing new:
/// points lie as densely as pixels, and a depth camera's on the borders of the parts.
const DENSE: f64 = 0.8;
/// The relative step from pixel to pixel up to which a surface may be taken for one, in photos that get parts of pixels: where
/// it is larger, what shows through gaps is too easily taken for what is before it, and parts leave more gaps.
const DISTINCT: f32 = 0.1;

/// Sigma of a place, pixels, of which nothing is known but the pixel.
const ANYWHERE: f32 = 0.29;
/// How far the first look at the nearest cells goes, cells.
const NEARBY: f32 = 3.0;
/// Rows that one task looks after; it may write into half as many above and below.
const BAND: usize = 2 * MAX_REACH;

/// The surfaces of a finished depth buffer.
pub struct Surfaces {
    /// How the pixels lie.
    pub grid: Grid,
    /// The nearest point in each pixel.
    pub samples: Vec<Sample>,
    /// How the limits lie, in pixels or parts of them.
    pub limits: Grid,
    /// A point in this cell is hidden when its inverse depth is below this; 0 where nothing hides.
    pub limit: Vec<f32>,
    /// Sigma of a depth, in the cloud's unit, as samples scatter about planes.
    pub noise: f32,
}

impl Surfaces {
    /// From a depth buffer that everything was put into.
    pub fn new(buffer: DepthBuffer, footprint: &Footprint) -> Result<Self> {
        let (view, grid) = (*buffer.view(), buffer.grid());
        Self::from_samples(&view, grid, buffer.into_samples(), PLACE, footprint)
    }

    /// From the samples in the cells of a grid, of points of which nothing is known but their pixels.
    pub(super) fn from_centred(view: &View, grid: Grid, samples: Vec<Sample>, footprint: &Footprint) -> Result<Self> {
        Self::from_samples(view, grid, samples, ANYWHERE, footprint)
    }

    fn from_samples(
        view: &View,
        mut grid: Grid,
        mut samples: Vec<Sample>,
        place: f32,
        footprint: &Footprint,
    ) -> Result<Self> {
        grid.wrap(&mut samples);
        let pixels = grid.pixels();
        let mut in_pixels = if grid == pixels { None } else { Some(grid.in_pixels(&samples)?) };
        if let Some(dense) = in_pixels.take_if(|samples| neighboured(&pixels, samples) > DENSE) {
            (grid, samples) = (pixels, dense);
        }
        let limits = grid;
        let pixel_samples = in_pixels.as_deref().unwrap_or(&samples);
        let pixel_angle = pixel_angle(view);
        let surroundings = |grid: Grid, samples| {
            let ratios = [footprint.gap_ratio, footprint.row_ratio];
            Surroundings::new(grid, samples, footprint.steepest, pixel_angle / grid.fineness as f32, ratios)
        };
        // Of pixels: among parts of them neighbours may be too far away to tell the noise.
        let (noise, wide_noise) = rayon::join(
            || surroundings(pixels, pixel_samples).depth_noise(),
            || depth_noise(view, pixels, pixel_samples, place),
        );
        let Footprint { tolerance, inner, .. } = *footprint;
        let max_gap = (footprint.max_gap * grid.fineness as f32).min(MAX_REACH as f32);
        let pixel_angle = pixel_angle / grid.fineness as f32;
        let rule = Rule { tolerance, inner, pixel_angle, noise, wide_noise };
        let surroundings = surroundings(grid, &samples).with_noise(noise);
        let mut limit = fetched(grid.len(), "the surfaces of a depth buffer")?;
        let mut spacing: Vec<u8> = fetched(grid.len(), "the spacing of points")?;
        // Each band fills its own part.
        let parts: Vec<_> =
            spacing[grid.first_row() * grid.stride()..].chunks_mut(BAND * grid.stride()).map(Mutex::new).collect();
        let mut open = in_bands(&grid, &mut limit, |band, rows, canvas| {
            let mut part = parts[band].lock().unwrap_or_else(PoisonError::into_inner);
            FirstLook { spacing: &mut part, open: Vec::new() }.over(&surroundings, &rule, rows, canvas)
        });
        drop(parts);
        let mut reach = NEARBY;
        let cells = open.iter().flatten().map(|links| links.cell);
        let mut pyramid = Pyramid::new(&grid, cells, max_gap);
        while reach < max_gap {
            open.par_iter_mut().for_each(|band| band.retain(|links| surroundings.may_find_more(links, reach)));
            if open.iter().all(Vec::is_empty) {
                break;
            }
            pyramid.coarsen(&samples);
            reach *= 2.0;
            let pending: Vec<_> = open.into_iter().map(Mutex::new).collect();
            let looked = in_bands(&grid, &mut limit, |band, _, canvas| {
                let mut list = pending[band].lock().map(|mut list| std::mem::take(&mut *list)).unwrap_or_default();
                for links in &mut list {
                    if let Some(patch) = surroundings.farther(links, &pyramid, &spacing, max_gap) {
                        canvas.draw(&grid, grid.row_and_column(links.cell), &rule.mark(&patch));
                    }
                }
                let codes: Vec<u8> = list.iter().map(|links| surroundings.spacing_code(links)).collect();
                (list, codes)
            });
            open = Vec::with_capacity(looked.len());
            for (list, codes) in looked {
                list.iter().zip(codes).for_each(|(links, code)| spacing[links.cell as usize] = code);
                open.push(list);
            }
        }
        close(&grid, &mut limit);
        let samples = in_pixels.unwrap_or(samples);
        Ok(Self { grid: pixels, samples, limits, limit, noise: wide_noise })
    }
}

/// What a band's samples found in the nearest cells.
struct FirstLook<'a> {
    /// The samples' spacing in all cells of the band.
    spacing: &'a mut [u8],
    /// The samples that may have neighbours farther away.
    open: Vec<Links>,
}

impl FirstLook<'_> {
    fn over(self, s: &Surroundings<'_>, rule: &Rule, rows: Range<usize>, canvas: &mut Canvas<'_>) -> Vec<Links> {
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") {
            // SAFETY: the processor has the feature.
            return unsafe { self.over_avx2(s, rule, rows, canvas) };
        }
        self.over_here(s, rule, rows, canvas)
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    unsafe fn over_avx2(
        self,
        s: &Surroundings<'_>,
        rule: &Rule,
        rows: Range<usize>,
        canvas: &mut Canvas<'_>,
    ) -> Vec<Links> {
        self.over_here(s, rule, rows, canvas)
    }

    #[inline(always)]
    fn over_here(
        mut self,
        s: &Surroundings<'_>,
        rule: &Rule,
        rows: Range<usize>,
        canvas: &mut Canvas<'_>,
    ) -> Vec<Links> {
        let stride = s.grid.stride();
        let start = rows.start * stride;
        let mut found = Vec::new();
        let flat = Flat::over(&s.grid, s.samples, rule, rows.clone(), canvas);
        for y in rows {
            found.clear();
            let codes = &mut self.spacing[y * stride - start + PAD..];
            s.found_beside(y, flat.row(y), &mut found, codes);
            for cells in found.chunks(LANES) {
                let all = filled(cells);
                let nearby = s.nearby(&all);
                let mut marks = Marks::new();
                let (mut spacing, mut farthest) = ([0_u8; LANES], [0.0_f32; LANES]);
                let samples = all.map(|cell| s.samples[cell as usize]);
                for l in 0..LANES {
                    let patch = s.patch_nearby(samples[l], &nearby, l);
                    marks.set(l, &rule.mark(&patch));
                    spacing[l] = patch.spacing_code();
                    farthest[l] = s.farthest(&patch);
                }
                for (l, &cell) in cells.iter().enumerate() {
                    canvas.draw(&s.grid, [y, cell as usize - y * stride], &marks.get(l));
                    self.spacing[cell as usize - start] = spacing[l];
                    if farthest[l] > NEARBY + 1.0 {
                        self.open.push(s.links(cell, &nearby, l));
                    }
                }
            }
        }
        self.open
    }
}

/// Of the photo's cells with a sample the share whose neighbour on the right has one too.
fn neighboured(grid: &Grid, samples: &[Sample]) -> f64 {
    let of_row = |row: usize| {
        let row = grid.photo_row(samples, row);
        let pairs = row.windows(2).filter(|pair| pair[0].found() && pair[1].found()).count();
        [row.iter().filter(|sample| sample.found()).count(), pairs]
    };
    let rows = (0..grid.height).into_par_iter().map(of_row);
    let [found, pairs] = rows.reduce(|| [0; 2], |a, b| [a[0] + b[0], a[1] + b[1]]);
    pairs as f64 / found.max(1) as f64
}

/// Closes holes up to three cells wide, which the chance of where points fall leaves in a surface: where limits lie opposite
/// each other in at least two of four directions, the lower of two opposite ones holds in between. Beyond a straight
/// edge there are none, so that surfaces do not grow; and of a plane the lower is never in front.
fn close(grid: &Grid, limit: &mut [f32]) {
    let (stride, rows) = (grid.stride(), grid.rows());
    // Each band works from copies of two rows on either side, which are taken before anything changes.
    let bands = rows.div_ceil(CLOSED_ROWS);
    let beside: Vec<[Vec<f32>; 2]> = (0..bands)
        .map(|band| {
            let (start, end) = (band * CLOSED_ROWS, ((band + 1) * CLOSED_ROWS).min(rows));
            [start.saturating_sub(2)..start, end..(end + 2).min(rows)]
                .map(|rows| limit[rows.start * stride..rows.end * stride].to_vec())
        })
        .collect();
    limit.par_chunks_mut(CLOSED_ROWS * stride).zip(beside).enumerate().for_each(|(band, (cells, [above, below]))| {
        let first = band * CLOSED_ROWS;
        // The two rows before have changed by now: they and the row itself are kept as they were, so that all stays in
        // the cache.
        let mut kept: [Vec<f32>; 3] = std::array::from_fn(|_| vec![0.0; stride]);
        for (row, old) in above.chunks(stride).enumerate() {
            kept[(first + row + 3 - above.len() / stride) % 3].copy_from_slice(old);
        }
        for y in 0..cells.len() / stride {
            let (done, next) = cells.split_at_mut((y + 1) * stride);
            let row = &mut done[y * stride..];
            kept[(first + y) % 3].copy_from_slice(row);
            // The outermost two rows belong to the rim.
            if (2..rows - 2).contains(&(first + y)) {
                let after = |k: usize| {
                    let ahead = next.get(k * stride..(k + 1) * stride);
                    ahead.unwrap_or_else(|| &below[(k - next.len() / stride) * stride..][..stride])
                };
                let before = |k: usize| &kept[(first + y + 3 - k) % 3][..];
                close_row(&[before(2), before(1), before(0), after(0), after(1)], row);
            }
        }
    });
}

/// Rows that are closed together.
const CLOSED_ROWS: usize = 32;

fn close_row(rows: &[&[f32]; 5], row: &mut [f32]) {
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("avx2") {
        // SAFETY: the processor has the feature.
        return unsafe { close_row_avx2(rows, row) };
    }
    close_row_here(rows, row);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
unsafe fn close_row_avx2(rows: &[&[f32]; 5], row: &mut [f32]) {
    close_row_here(rows, row);
}

/// One row, from five rows of limits about it.
#[inline(always)]
fn close_row_here(rows: &[&[f32]; 5], row: &mut [f32]) {
    let n = row.len();
    // Of one length, so that nothing is left to check in the loop.
    let (r0, r1, r2, r3, r4) = (&rows[0][..n], &rows[1][..n], &rows[2][..n], &rows[3][..n], &rows[4][..n]);
    for x in 2..n - 2 {
        let a = smaller(larger(r2[x + 1], r2[x + 2]), larger(r2[x - 1], r2[x - 2]));
        let b = smaller(larger(r3[x], r4[x]), larger(r1[x], r0[x]));
        let c = smaller(larger(r3[x + 1], r4[x + 2]), larger(r1[x - 1], r0[x - 2]));
        let d = smaller(larger(r3[x - 1], r4[x - 2]), larger(r1[x + 1], r0[x + 2]));
        // The second largest of the four.
        let cover = larger(smaller(larger(a, b), larger(c, d)), larger(smaller(a, b), smaller(c, d)));
        row[x] = larger(r2[x], cover);
    }
}

fn band_count(grid: &Grid) -> usize {
    (grid.rows() - 2 * grid.first_row()).div_ceil(BAND)
}

/// Runs `work(band, rows, canvas)` for bands of rows, all in parallel but no two neighbours at once, since each may write into
/// its neighbours' rows.
fn in_bands<T: Send>(
    grid: &Grid,
    limit: &mut [f32],
    work: impl Fn(usize, Range<usize>, &mut Canvas<'_>) -> T + Sync,
) -> Vec<T> {
    let (stride, rows, first) = (grid.stride(), grid.rows(), grid.first_row());
    let count = band_count(grid);
    let mut results: Vec<(usize, T)> = Vec::new();
    for parity in 0..2 {
        // Band k owns rows first + k·BAND …; its canvas begins half a band above.
        let mut tasks = Vec::new();
        let mut rest = &mut *limit;
        let mut done = 0;
        for k in (parity..count).step_by(2) {
            let start = first + k * BAND;
            let (from, to) = (start.saturating_sub(BAND / 2), (start + BAND + BAND / 2).min(rows));
            let (_, tail) = std::mem::take(&mut rest).split_at_mut((from - done) * stride);
            let (cells, tail) = tail.split_at_mut((to - from) * stride);
            rest = tail;
            done = to;
            tasks.push((k, start..(start + BAND).min(rows - first), Canvas { first_row: from, cells }));
        }
        results.par_extend(tasks.into_par_iter().map(|(k, rows, mut canvas)| (k, work(k, rows, &mut canvas))));
    }
    results.sort_by_key(|(k, _)| *k);
    results.into_iter().map(|(_, result)| result).collect()
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn small_photos_get_parts_of_pixels_unless_gaps_or_pixels_are_too_wide_for_them() {
        let fineness = |width, height, gap| {
            let camera = crate::Camera::new(crate::Model::Equirectangular, width, height, &[]).unwrap();
            let footprint = Footprint::new(None, gap).unwrap();
            footprint.buffer(View { camera, pose: crate::Pose::identity() }).unwrap().grid().fineness
        };
        assert_eq!(fineness(2000, 1000, None), PARTS);
        assert_eq!(fineness(2000, 1000, Some(40.0)), 1);
        assert_eq!(fineness(2600, 1300, None), 1);
        assert_eq!(fineness(600, 300, None), 1);
    }
}
