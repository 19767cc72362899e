//! The neighbours of a sample on its own surface: the nearest in each of four quadrants (east, south, west, north of the
//! diagonals), looked for ring by ring in the buffer and then, where they are farther away, in a pyramid whose cells
//! hold the foremost sample below them.
//!
//! The first look, which every sample takes, goes over [`LANES`] samples at once, and what it makes of them has no branches,
//! so that the compiler can use wide registers.

use rayon::prelude::*;

use super::extremes::{larger, smaller};
use super::flat::BLOCK;
use super::patch::{Link, Patch, Pruning, QUADRANTS};
use super::pyramid::Pyramid;
use super::sample::Sample;
use super::zbuffer::{Grid, PAD};

/// Samples that are looked at together.
pub(super) const LANES: usize = 8;
/// By how much two depths of one surface may differ beside what their distance makes, relative.
const TOLERANCE: f32 = 0.001;
/// The tangent of an incidence that is nothing special.
const USUAL: f32 = 1.7;
/// Of so many rows one is looked at for the noise, but of no more than [`ROWS`] or so.
const EVERY: usize = 16;
/// Rows that tell the noise well enough.
const ROWS: usize = 64;
/// Offsets in each quadrant.
const RING: usize = 12;

/// A sample and where its neighbours are, cells to the right and down; (0, 0) for none.
#[derive(Debug, Clone, Copy)]
pub(super) struct Links {
    pub cell: u32,
    near: [(i8, i8); QUADRANTS],
}

const NONE: (i8, i8) = (0, 0);

/// The samples, and what makes two of them neighbours on one surface.
pub(super) struct Surroundings<'a> {
    pub grid: Grid,
    pub samples: &'a [Sample],
    /// By how much two depths of one surface may differ in one place, relative.
    tolerance: f32,
    /// The largest relative change by one cell.
    steepest: f32,
    pruning: Pruning,
    rings: [[Probe; RING]; QUADRANTS],
}

/// The neighbours of [`LANES`] samples in the cells about them: zeros for none.
#[derive(Debug, Clone, Default, PartialEq)]
#[repr(align(32))]
pub(super) struct Nearby {
    other: [[u32; LANES]; QUADRANTS],
    /// Cells to the right.
    dx: [[f32; LANES]; QUADRANTS],
    /// Cells down.
    dy: [[f32; LANES]; QUADRANTS],
}

/// Where to look for a neighbour.
#[derive(Debug, Clone, Copy)]
struct Probe {
    /// Cells in the buffer.
    step: i32,
    dx: f32,
    dy: f32,
    /// By how much its inverse depth may differ, relative.
    allowed: f32,
}

/// All samples at once, until each has found its neighbour.
///
/// # Safety
/// Every cell and every step from it has to lie in `samples`.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
unsafe fn nearby_avx2(samples: &[Sample], rings: &[[Probe; RING]; QUADRANTS], cells: &[u32; LANES]) -> Nearby {
    use std::arch::x86_64::*;
    let memory = samples.as_ptr().cast::<i32>();
    // SAFETY: the caller's; positions in a buffer are below 2³¹.
    let gather = |at: __m256i| unsafe { _mm256_i32gather_epi32::<4>(memory, at) };
    let depth = |samples: __m256i| _mm256_castsi256_ps(Sample::inverse_depth_bits(samples));
    let at = _mm256_setr_epi32(
        cells[0] as i32,
        cells[1] as i32,
        cells[2] as i32,
        cells[3] as i32,
        cells[4] as i32,
        cells[5] as i32,
        cells[6] as i32,
        cells[7] as i32,
    );
    let own = depth(gather(at));
    let (none, no_sign) = (_mm256_setzero_si256(), _mm256_castsi256_ps(_mm256_set1_epi32(i32::MAX)));
    let mut nearby = Nearby::default();
    for (k, ring) in rings.iter().enumerate() {
        let (mut best, mut dx, mut dy) = (none, _mm256_setzero_ps(), _mm256_setzero_ps());
        let mut missing = _mm256_cmpeq_epi32(none, none);
        for probe in ring {
            let other = gather(_mm256_add_epi32(at, _mm256_set1_epi32(probe.step)));
            let v = depth(other);
            let apart = _mm256_and_ps(_mm256_sub_ps(v, own), no_sign);
            let allowed = _mm256_mul_ps(_mm256_max_ps(own, v), _mm256_set1_ps(probe.allowed));
            let one_surface = _mm256_castps_si256(_mm256_cmp_ps::<_CMP_LE_OQ>(apart, allowed));
            let empty = _mm256_cmpeq_epi32(other, none);
            let taken = _mm256_andnot_si256(empty, _mm256_and_si256(one_surface, missing));
            let mask = _mm256_castsi256_ps(taken);
            best = _mm256_blendv_epi8(best, other, taken);
            dx = _mm256_blendv_ps(dx, _mm256_set1_ps(probe.dx), mask);
            dy = _mm256_blendv_ps(dy, _mm256_set1_ps(probe.dy), mask);
            missing = _mm256_andnot_si256(taken, missing);
            if _mm256_testz_si256(missing, missing) == 1 {
                break;
            }
        }
        // SAFETY: the arrays hold eight numbers.
        unsafe {
            _mm256_storeu_si256(nearby.other[k].as_mut_ptr().cast(), best);
            _mm256_storeu_ps(nearby.dx[k].as_mut_ptr(), dx);
            _mm256_storeu_ps(nearby.dy[k].as_mut_ptr(), dy);
        }
    }
    nearby
}

/// Up to [`LANES`] cells, the last one repeated.
#[inline(always)]
pub(super) fn filled(cells: &[u32]) -> [u32; LANES] {
    std::array::from_fn(|l| cells[l.min(cells.len() - 1)])
}

/// The quadrant of an offset.
fn quadrant(dx: isize, dy: isize) -> usize {
    if dx > 0 && -dx < dy && dy <= dx {
        0
    } else if dy > 0 && -dy <= dx && dx < dy {
        1
    } else if dx < 0 && dx <= dy && dy < -dx {
        2
    } else {
        3
    }
}

/// The offsets of the first quadrant, from the nearest; the others are this one turned.
const FIRST: [(isize, isize); RING] =
    [(1, 0), (1, 1), (2, 0), (2, 1), (2, -1), (2, 2), (3, 0), (3, 1), (3, -1), (3, 2), (3, -2), (3, 3)];

fn turned((dx, dy): (isize, isize), quadrant: usize) -> (isize, isize) {
    match quadrant {
        0 => (dx, dy),
        1 => (-dy, dx),
        2 => (-dx, -dy),
        _ => (dy, -dx),
    }
}

impl<'a> Surroundings<'a> {
    /// For samples whose depths are good to `tolerance`, with surfaces as steep as the tangent `steepest` of the incidence,
    /// seen with pixels of this angle.
    pub fn new(grid: Grid, samples: &'a [Sample], steepest: f32, pixel_angle: f32, ratios: [f32; 2]) -> Self {
        let (tolerance, steepest, stride) = (TOLERANCE, steepest * pixel_angle, grid.stride() as isize);
        let rings = std::array::from_fn(|k| {
            FIRST.map(|offset| {
                let (dx, dy) = turned(offset, k);
                let distance = ((dx * dx + dy * dy) as f32).sqrt();
                let allowed = tolerance + steepest * distance;
                Probe { step: (dy * stride + dx) as i32, dx: dx as f32, dy: dy as f32, allowed }
            })
        });
        let [gap_ratio, row_ratio] = ratios;
        let usual = USUAL * pixel_angle;
        let pruning = Pruning { noise: 0.0, usual, gap_ratio, row_ratio };
        Self { grid, samples, tolerance, steepest, pruning, rings }
    }

    /// With the sigma of a depth, in the cloud's unit.
    pub fn with_noise(mut self, noise: f32) -> Self {
        self.pruning.noise = noise;
        self
    }

    #[inline(always)]
    fn one_surface(&self, own: f32, other: f32, distance: f32) -> bool {
        (other - own).abs() <= larger(own, other) * (self.tolerance + self.steepest * distance)
    }

    #[inline(always)]
    fn link(&self, own: f32, place: [f32; 2], other: Sample, dx: f32, dy: f32) -> Link {
        let [right, down] = other.place();
        let (dx, dy) = (dx + right - place[0], dy + down - place[1]);
        // Two samples in neighbouring cells may lie closer together than the positions tell.
        let distance = larger((dx * dx + dy * dy).sqrt(), 0.25);
        Link { dx, dy, rise: other.inverse_depth() - own, distance }
    }

    /// The surface at a sample.
    #[inline(always)]
    pub fn patch(&self, links: &Links) -> Patch {
        let sample = self.samples[links.cell as usize];
        let (own, place, stride) = (sample.inverse_depth(), sample.place(), self.grid.stride() as isize);
        // A loop: a closure given to the array's own `map` would not be compiled for the wide registers.
        let mut found = [Link::default(); QUADRANTS];
        for (found, &near) in found.iter_mut().zip(&links.near) {
            if near != NONE {
                let at = links.cell as isize + isize::from(near.1) * stride + isize::from(near.0);
                *found = self.link(own, place, self.samples[at as usize], f32::from(near.0), f32::from(near.1));
            }
        }
        Patch { own, place, links: found }
    }

    #[inline(always)]
    fn pruned(&self, links: &mut Links) -> Patch {
        let mut patch = self.patch(links);
        patch.prune(&self.pruning);
        for (near, link) in links.near.iter_mut().zip(&patch.links) {
            if !link.found() {
                *near = NONE;
            }
        }
        patch
    }

    /// The cells of a row that hold a sample and do not lie in its flat blocks, appended. The spacing of these, which
    /// `flat` knows, goes to `spacing`; both begin with the first column that may hold a sample.
    #[inline(always)]
    pub fn found_beside(&self, row: usize, flat: &[u8], cells: &mut Vec<u32>, spacing: &mut [u8]) {
        let columns = self.grid.used_columns();
        let mut from = columns.start;
        for (&code, spacing) in flat.iter().zip(spacing.chunks_mut(BLOCK)) {
            if code == 0 {
                self.found_in(row, from..from + BLOCK, cells);
            } else {
                spacing.fill(code);
            }
            from += BLOCK;
        }
        self.found_in(row, from..columns.end, cells);
    }

    /// The cells of a row that hold a sample, appended.
    #[inline(always)]
    fn found(&self, row: usize, cells: &mut Vec<u32>) {
        self.found_in(row, self.grid.used_columns(), cells);
    }

    #[inline(always)]
    fn found_in(&self, row: usize, columns: std::ops::Range<usize>, cells: &mut Vec<u32>) {
        let start = row * self.grid.stride();
        let first = cells.len();
        cells.resize(first + columns.len(), 0);
        let mut n = first;
        for x in columns {
            // Written always and counted when found: whether a cell is empty cannot be foreseen.
            cells[n] = (start + x) as u32;
            n += usize::from(self.samples[start + x].found());
        }
        cells.truncate(n);
    }

    /// Looks at the nearest cells about samples, which lie at least three from the rim.
    #[inline(always)]
    pub fn nearby(&self, cells: &[u32; LANES]) -> Nearby {
        let rim = PAD * (self.grid.stride() + 1);
        assert!(cells.iter().all(|&cell| (rim..self.samples.len() - rim).contains(&(cell as usize))));
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") {
            // SAFETY: the processor has the feature; no probe goes farther than the rim is wide.
            return unsafe { nearby_avx2(self.samples, &self.rings, cells) };
        }
        self.nearby_one_by_one(cells)
    }

    fn nearby_one_by_one(&self, cells: &[u32; LANES]) -> Nearby {
        let mut nearby = Nearby::default();
        for (k, ring) in self.rings.iter().enumerate() {
            for (l, &cell) in cells.iter().enumerate() {
                let own = self.samples[cell as usize].inverse_depth();
                for probe in ring {
                    let other = self.samples[(cell as i32 + probe.step) as usize];
                    let v = other.inverse_depth();
                    if other.found() && (v - own).abs() <= larger(own, v) * probe.allowed {
                        (nearby.other[k][l], nearby.dx[k][l], nearby.dy[k][l]) = (other.0, probe.dx, probe.dy);
                        break;
                    }
                }
            }
        }
        nearby
    }

    /// The surface at one of the samples, from the nearest cells.
    #[inline(always)]
    pub fn patch_nearby(&self, sample: Sample, nearby: &Nearby, lane: usize) -> Patch {
        let (own, place) = (sample.inverse_depth(), sample.place());
        let mut links = [Link::default(); QUADRANTS];
        for k in 0..QUADRANTS {
            let other = Sample(nearby.other[k][lane]);
            let link = self.link(own, place, other, nearby.dx[k][lane], nearby.dy[k][lane]);
            links[k] = link.unless(!other.found());
        }
        let mut patch = Patch { own, place, links };
        patch.prune(&self.pruning);
        patch
    }

    /// A sample whose surface the nearest cells do not end, for looking farther.
    #[inline(always)]
    pub fn links(&self, cell: u32, nearby: &Nearby, lane: usize) -> Links {
        let patch = self.patch_nearby(self.samples[cell as usize], nearby, lane);
        let near = |k: usize| (nearby.dx[k][lane] as i8, nearby.dy[k][lane] as i8);
        Links { cell, near: std::array::from_fn(|k| if patch.links[k].found() { near(k) } else { NONE }) }
    }

    /// Whether looking farther than `reach` makes sense.
    pub fn may_find_more(&self, links: &Links, reach: f32) -> bool {
        links.near.contains(&NONE) && self.farthest(&self.patch(links)) > reach + 1.0
    }

    /// How far away a neighbour may lie that a patch still misses: what is farther would be pruned.
    #[inline(always)]
    pub fn farthest(&self, patch: &Patch) -> f32 {
        let spacing = patch.spacing();
        let mut farthest = 0.0;
        for (k, link) in patch.links.iter().enumerate() {
            let (opposite, rows) = (patch.links[(k + 2) % QUADRANTS], self.pruning.row_ratio * spacing);
            // Between the rows of a grazing scan both are missing at first, and neither is to wait for the other.
            let rows = if opposite.found() { smaller(2.0 * opposite.distance, rows) } else { rows };
            let reach = larger(rows, self.pruning.gap_ratio * spacing);
            farthest = if link.found() { farthest } else { larger(farthest, reach) };
        }
        farthest
    }

    /// The surface's spacing at a sample after looking farther.
    pub fn spacing_code(&self, links: &Links) -> u8 {
        self.patch(links).spacing_code()
    }

    /// The sigma of a depth in the cloud's unit, from samples against the lines between their neighbours: the median of
    /// some of the rows, so that edges and leaves do not count. 0 where the samples stand too far apart.
    pub fn depth_noise(&self) -> f32 {
        let rows = self.grid.first_row()..self.grid.rows() - self.grid.first_row();
        let every = EVERY.max(rows.len() / ROWS);
        let rows: Vec<usize> = rows.step_by(every).collect();
        let of_row = |y: usize| {
            let mut off = Vec::new();
            let mut found = Vec::new();
            self.found(y, &mut found);
            for cells in found.chunks(LANES) {
                let nearby = self.nearby(&filled(cells));
                for (l, &cell) in cells.iter().enumerate() {
                    let patch = self.patch_nearby(self.samples[cell as usize], &nearby, l);
                    for k in (0..2).filter(|&k| patch.between(k)) {
                        let (by, share) = patch.off_line(k);
                        off.push(by.abs() / (share * patch.own * patch.own));
                    }
                }
            }
            off
        };
        let mut off: Vec<f32> = rows.into_par_iter().flat_map_iter(of_row).collect();
        if off.len() < 100 {
            return 0.0;
        }
        let middle = off.len() / 2;
        // The median of a normal distribution's absolute values is 0.6745 sigma.
        *off.select_nth_unstable_by(middle, f32::total_cmp).1 / 0.6745
    }

    /// Looks for what is missing at the pyramid's level; the new surface if anything was found.
    pub fn farther(&self, links: &mut Links, pyramid: &Pyramid, spacing: &[u8], max_gap: f32) -> Option<Patch> {
        let patch = self.patch(links);
        let stride = self.grid.stride() as isize;
        let (x, y) = (links.cell as isize % stride, links.cell as isize / stride);
        let reach = self.farthest(&patch).min(max_gap);
        let mut best = [f32::INFINITY; QUADRANTS];
        let before = *links;
        pyramid.around(x, y, reach, |other| {
            let (dx, dy) = (other as isize % stride - x, other as isize / stride - y);
            let k = quadrant(dx, dy);
            if (dx, dy) == (0, 0) || before.near[k] != NONE {
                return;
            }
            let d = ((dx * dx + dy * dy) as f32).sqrt();
            let its = spacing[other as usize];
            let near = d <= reach && (its == 0 || d <= 0.25 * f32::from(its) * self.pruning.row_ratio);
            if d < best[k] && near && self.one_surface(patch.own, self.samples[other as usize].inverse_depth(), d) {
                best[k] = d;
                links.near[k] = (dx as i8, dy as i8);
            }
        });
        let patch = self.pruned(links);
        (0..QUADRANTS).any(|k| links.near[k] != before.near[k]).then_some(patch)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quadrants_are_turns_of_the_first_and_hold_every_offset_once() {
        let mut seen = std::collections::HashSet::new();
        for k in 0..QUADRANTS {
            for offset in FIRST {
                let (dx, dy) = turned(offset, k);
                assert_eq!(quadrant(dx, dy), k, "{dx} {dy}");
                assert!(seen.insert((dx, dy)));
            }
        }
        assert_eq!(seen.len(), 48);
    }

    #[test]
    fn eight_samples_at_once_find_what_each_finds_alone() {
        let camera = crate::Camera::new(crate::Model::Pinhole, 96, 64, &[80.0, 80.0, 47.5, 31.5]).unwrap();
        let view = crate::View { camera, pose: crate::Pose::identity() };
        let grid = Grid::new(&view).unwrap();
        let mut state = 7_u32;
        let mut random = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            f64::from(state >> 8) as f32 / (1 << 24) as f32
        };
        let mut samples = vec![Sample::default(); grid.len()];
        for y in grid.first_row()..grid.rows() - grid.first_row() {
            for x in grid.used_columns() {
                if random() > 0.3 {
                    continue;
                }
                let inverse = if random() < 0.5 { 0.1 } else { 0.1 + 0.01 * random() };
                samples[y * grid.stride() + x] = Sample::new(inverse, [random(), random()]);
            }
        }
        let surroundings = Surroundings::new(grid, &samples, 20.0, 1.0 / 80.0, [2.0, 4.0]);
        let mut found = Vec::new();
        (0..grid.rows()).skip(PAD).take(grid.rows() - 2 * PAD).for_each(|y| surroundings.found(y, &mut found));
        assert!(found.len() > 1000);
        for cells in found.chunks(LANES) {
            let cells = filled(cells);
            assert_eq!(surroundings.nearby(&cells), surroundings.nearby_one_by_one(&cells));
        }
    }
}
