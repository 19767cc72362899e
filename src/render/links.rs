//! The neighbours of a sample on its own surface: the nearest in each of four quadrants (east, south, west, north of the
//! diagonals), looked for ring by ring in the buffer and then, where they are farther away, in a pyramid whose cells
//! hold the foremost sample below them.

use rayon::prelude::*;

use super::pyramid::Pyramid;
use super::sample::Sample;
use super::zbuffer::Grid;

/// East, south, west, north.
pub(super) const QUADRANTS: usize = 4;
/// By how much two depths of one surface may differ beside what their distance makes, relative.
const TOLERANCE: f32 = 0.001;
/// The tangent of an incidence that is nothing special.
const USUAL: f32 = 1.7;
/// Rows of which one is looked at for the noise.
const EVERY: usize = 16;
/// Offsets in each quadrant.
const RING: usize = 12;

/// A sample and where its neighbours are, cells to the right and down; (0, 0) for none.
#[derive(Debug, Clone, Copy)]
pub(super) struct Links {
    pub cell: u32,
    near: [(i8, i8); QUADRANTS],
}

const NONE: (i8, i8) = (0, 0);

/// A neighbour as the sample sees it. `distance` is 0 for none.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Link {
    dx: f32,
    dy: f32,
    /// By how much its inverse depth is larger.
    rise: f32,
    pub distance: f32,
}

impl Link {
    #[inline(always)]
    pub fn found(&self) -> bool {
        self.distance > 0.0
    }

    #[inline(always)]
    fn slope(&self) -> f32 {
        self.rise / self.distance
    }
}

/// What the neighbours say of the surface at a sample.
#[derive(Debug, Clone, Copy)]
pub(super) struct Patch {
    /// Inverse depth of the sample.
    pub own: f32,
    /// Where it lies against its pixel's centre.
    pub place: [f32; 2],
    pub links: [Link; QUADRANTS],
}

impl Patch {
    /// The distance of the second nearest neighbour: two are needed to call it a surface.
    #[inline(always)]
    pub fn spacing(&self) -> Option<f32> {
        let (mut first, mut second) = (f32::INFINITY, f32::INFINITY);
        for link in self.links.iter().filter(|link| link.found()) {
            let d = link.distance;
            if d < first {
                (first, second) = (d, first);
            } else if d < second {
                second = d;
            }
        }
        (second < f32::INFINITY).then_some(second)
    }

    /// The spacing in quarters of a pixel; 0 for unknown.
    #[inline(always)]
    pub fn spacing_code(&self) -> u8 {
        self.spacing().map_or(0, |s| (4.0 * s + 1.0) as u8)
    }

    /// The plane through the sample that fits the neighbours best: the change of the inverse depth by one cell.
    #[inline(always)]
    pub fn gradient(&self) -> [f32; 2] {
        let (mut xx, mut xy, mut yy, mut xr, mut yr) = (0.0_f32, 0.0, 0.0, 0.0, 0.0);
        for link in self.links.iter().filter(|link| link.found()) {
            let w = 1.0 / (link.distance * link.distance);
            xx += w * link.dx * link.dx;
            xy += w * link.dx * link.dy;
            yy += w * link.dy * link.dy;
            xr += w * link.dx * link.rise;
            yr += w * link.dy * link.rise;
        }
        let ridge = 1e-3 * (xx + yy) + 1e-12;
        let (a, c) = (xx + ridge, yy + ridge);
        let det = a * c - xy * xy;
        [(c * xr - xy * yr) / det, (a * yr - xy * xr) / det]
    }

    /// How much nearer than the sample itself the plane with this gradient passes that fits sample and neighbours.
    #[inline(always)]
    pub fn lift(&self, [gx, gy]: [f32; 2]) -> f32 {
        let (mut sum, mut n) = (0.0, 1.0);
        for link in self.links.iter().filter(|link| link.found()) {
            sum += link.rise - gx * link.dx - gy * link.dy;
            n += 1.0;
        }
        sum / n
    }

    /// How far the sample lies off the line between two opposite neighbours; the sum for both pairs.
    #[inline(always)]
    pub fn misfit(&self) -> f32 {
        (0..2).filter_map(|k| self.off_line(k)).map(|(off, _)| off.abs()).sum()
    }

    /// The sample's inverse depth against the line between the neighbours of quadrants `k` and `k + 2`; and by how much
    /// its sigma exceeds that of one depth.
    #[inline(always)]
    fn off_line(&self, k: usize) -> Option<(f32, f32)> {
        let (a, b) = (self.links[k], self.links[k + 2]);
        (a.found() && b.found()).then(|| {
            let all = a.distance + b.distance;
            let (wa, wb) = (b.distance / all, a.distance / all);
            (wa * a.rise + wb * b.rise, (1.0 + wa * wa + wb * wb).sqrt())
        })
    }

    /// Drops what does not belong: of two opposite neighbours that are not on one line with the sample the steeper when
    /// it is steep, and what is too far for the spacing.
    #[inline(always)]
    fn prune(&mut self, s: &Surroundings<'_>) {
        for k in 0..2 {
            let (a, b) = (self.links[k], self.links[k + 2]);
            if a.found() && b.found() {
                let near = a.distance.min(b.distance);
                let (sa, sb) = (a.slope().abs(), b.slope().abs());
                let bend = (a.slope() + b.slope()).abs() * near;
                let allowed = self.own * (5.0 * s.noise * self.own + s.usual * near) + 0.5 * near * sa.min(sb);
                if bend > allowed && sa.max(sb) > self.own * s.usual {
                    self.links[if sa > sb { k } else { k + 2 }] = Link::default();
                }
            }
        }
        if let Some(spacing) = self.spacing() {
            let before = self.links;
            for (k, link) in self.links.iter_mut().enumerate() {
                let opposite = before[(k + 2) % QUADRANTS].distance;
                // A scan at a grazing angle has rows far apart, but on both sides; a bar has a gap on one.
                let ratio = if 2.0 * opposite > link.distance { s.row_ratio } else { s.gap_ratio };
                if link.distance > ratio * spacing {
                    *link = Link::default();
                }
            }
        }
    }
}

/// The samples, and what makes two of them neighbours on one surface.
pub(super) struct Surroundings<'a> {
    pub grid: Grid,
    pub samples: &'a [Sample],
    /// Sigma of a depth, in the cloud's unit.
    pub noise: f32,
    /// By how much two depths of one surface may differ in one place, relative.
    tolerance: f32,
    /// The largest relative change by one cell.
    steepest: f32,
    /// The largest relative change by one cell that is nothing special.
    usual: f32,
    /// How many times the spacing a gap may be wide.
    gap_ratio: f32,
    /// The same where gaps follow each other as the rows of a scan do.
    row_ratio: f32,
    rings: [[Probe; RING]; QUADRANTS],
}

/// Where to look for a neighbour.
#[derive(Debug, Clone, Copy)]
struct Probe {
    /// Cells in the buffer.
    step: isize,
    offset: (i8, i8),
    /// By how much its inverse depth may differ, relative.
    allowed: f32,
}

#[inline(always)]
fn larger(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
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
                Probe { step: dy * stride + dx, offset: (dx as i8, dy as i8), allowed }
            })
        });
        let [gap_ratio, row_ratio] = ratios;
        let usual = USUAL * pixel_angle;
        let mut this = Self { grid, samples, noise: 0.0, tolerance, steepest, usual, gap_ratio, row_ratio, rings };
        this.noise = this.depth_noise();
        this
    }

    #[inline(always)]
    fn one_surface(&self, own: f32, other: f32, distance: f32) -> bool {
        (other - own).abs() <= larger(own, other) * (self.tolerance + self.steepest * distance)
    }

    #[inline(always)]
    fn link(&self, own: f32, place: [f32; 2], other: Sample, (dx, dy): (i8, i8)) -> Link {
        let [right, down] = other.place();
        let (dx, dy) = (f32::from(dx) + right - place[0], f32::from(dy) + down - place[1]);
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
                *found = self.link(own, place, self.samples[at as usize], near);
            }
        }
        Patch { own, place, links: found }
    }

    #[inline(always)]
    fn pruned(&self, links: &mut Links) -> Patch {
        let mut patch = self.patch(links);
        patch.prune(self);
        for (near, link) in links.near.iter_mut().zip(&patch.links) {
            if !link.found() {
                *near = NONE;
            }
        }
        patch
    }

    /// Looks at the nearest cells.
    #[inline(always)]
    pub fn nearby(&self, cell: usize) -> (Links, Patch) {
        let own = self.samples[cell].inverse_depth();
        let mut links = Links { cell: cell as u32, near: [NONE; QUADRANTS] };
        for (near, ring) in links.near.iter_mut().zip(&self.rings) {
            for probe in ring {
                let other = self.samples[(cell as isize + probe.step) as usize];
                if other.found() {
                    let v = other.inverse_depth();
                    if (v - own).abs() <= larger(own, v) * probe.allowed {
                        *near = probe.offset;
                        break;
                    }
                }
            }
        }
        let patch = self.pruned(&mut links);
        (links, patch)
    }

    /// Whether looking farther than `reach` makes sense.
    pub fn may_find_more(&self, links: &Links, reach: f32) -> bool {
        links.near.contains(&NONE) && self.farthest(&self.patch(links)) > reach + 1.0
    }

    /// How far away a neighbour may lie that a patch still misses: what is farther would be pruned.
    #[inline(always)]
    pub fn farthest(&self, patch: &Patch) -> f32 {
        let Some(spacing) = patch.spacing() else { return f32::INFINITY };
        let mut farthest = 0.0;
        for (k, link) in patch.links.iter().enumerate() {
            if !link.found() {
                let rows = (2.0 * patch.links[(k + 2) % QUADRANTS].distance).min(self.row_ratio * spacing);
                farthest = larger(farthest, larger(rows, self.gap_ratio * spacing));
            }
        }
        farthest
    }

    /// The surface's spacing at a sample after looking farther.
    pub fn spacing_code(&self, links: &Links) -> u8 {
        self.patch(links).spacing_code()
    }

    /// The sigma of a depth in the cloud's unit, from samples against the lines between their neighbours: the median of
    /// a sixteenth of the rows, so that edges and leaves do not count. 0 where the samples stand too far apart.
    pub fn depth_noise(&self) -> f32 {
        let rows: Vec<usize> =
            (self.grid.first_row()..self.grid.rows() - self.grid.first_row()).step_by(EVERY).collect();
        let mut off: Vec<f32> = rows
            .into_par_iter()
            .flat_map_iter(|y| self.grid.used_columns().map(move |x| y * self.grid.stride() + x))
            .filter(|&cell| self.samples[cell].found())
            .flat_map_iter(|cell| {
                let patch = self.nearby(cell).1;
                let share = move |(off, share): (f32, f32)| off.abs() / (share * patch.own * patch.own);
                (0..2).filter_map(move |k| patch.off_line(k)).map(share)
            })
            .collect();
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
            let near = d <= reach && (its == 0 || d <= 0.25 * f32::from(its) * self.row_ratio);
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
}
