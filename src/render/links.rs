//! The neighbours of a sample on its own surface: the nearest in each of four quadrants (east, south, west, north of the
//! diagonals), looked for ring by ring in the buffer and then, where they are farther away, in a pyramid whose cells
//! hold the foremost sample below them.

use rayon::prelude::*;

use super::sample::Sample;
use super::zbuffer::Grid;

/// East, south, west, north.
pub(super) const QUADRANTS: usize = 4;
/// Cells that are looked at on each side, at every level.
const WINDOW: isize = 3;
/// Offsets in each quadrant.
const RING: usize = 12;

/// A sample and the cells of its neighbours, 0 for none.
#[derive(Debug, Clone, Copy)]
pub(super) struct Links {
    pub cell: u32,
    near: [u32; QUADRANTS],
}

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
    pub fn found(&self) -> bool {
        self.distance > 0.0
    }

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

    /// The plane through the sample that fits the neighbours best: the change of the inverse depth by one cell.
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
    pub fn lift(&self, [gx, gy]: [f32; 2]) -> f32 {
        let (mut sum, mut n) = (0.0, 1.0);
        for link in self.links.iter().filter(|link| link.found()) {
            sum += link.rise - gx * link.dx - gy * link.dy;
            n += 1.0;
        }
        sum / n
    }

    /// How far the sample lies off the line between two opposite neighbours; the sum for both pairs.
    pub fn misfit(&self) -> f32 {
        (0..2).filter_map(|k| self.off_line(k)).map(|(off, _)| off.abs()).sum()
    }

    /// The sample's inverse depth against the line between the neighbours of quadrants `k` and `k + 2`; and by how much
    /// its sigma exceeds that of one depth.
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
    /// Relative noise of a depth.
    pub tolerance: f32,
    /// The largest relative change by one cell.
    pub steepest: f32,
    /// The largest relative change by one cell that is nothing special.
    pub usual: f32,
    /// How many times the spacing a gap may be wide.
    pub gap_ratio: f32,
    /// The same where gaps follow each other as the rows of a scan do.
    pub row_ratio: f32,
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

impl Surroundings<'_> {
    #[inline(always)]
    fn one_surface(&self, own: f32, other: f32, distance: f32) -> bool {
        (other - own).abs() <= own.max(other) * (self.tolerance + self.steepest * distance)
    }

    fn link(&self, cell: usize, other: usize) -> Link {
        let stride = self.grid.stride();
        let (a, b) = (self.samples[cell], self.samples[other]);
        let ([ax, ay], [bx, by]) = (a.place(), b.place());
        let dx = (other % stride) as f32 - (cell % stride) as f32 + bx - ax;
        let dy = (other / stride) as f32 - (cell / stride) as f32 + by - ay;
        // Two samples in neighbouring cells may lie closer together than the positions tell.
        let distance = dx.hypot(dy).max(0.25);
        Link { dx, dy, rise: b.inverse_depth() - a.inverse_depth(), distance }
    }

    /// The surface at a sample.
    pub fn patch(&self, links: &Links) -> Patch {
        let cell = links.cell as usize;
        let link = |&near: &u32| if near == 0 { Link::default() } else { self.link(cell, near as usize) };
        let sample = self.samples[cell];
        let links: [Link; QUADRANTS] = std::array::from_fn(|k| link(&links.near[k]));
        Patch { own: sample.inverse_depth(), place: sample.place(), links }
    }

    fn pruned(&self, links: &mut Links) -> Patch {
        let mut patch = self.patch(links);
        patch.prune(self);
        for (near, link) in links.near.iter_mut().zip(&patch.links) {
            if !link.found() {
                *near = 0;
            }
        }
        patch
    }

    /// Looks at the nearest cells.
    pub fn nearby(&self, cell: usize) -> (Links, Patch) {
        let own = self.samples[cell].inverse_depth();
        let stride = self.grid.stride() as isize;
        let mut links = Links { cell: cell as u32, near: [0; QUADRANTS] };
        for (k, near) in links.near.iter_mut().enumerate() {
            for &offset in &FIRST {
                let (dx, dy) = turned(offset, k);
                let at = (cell as isize + dy * stride + dx) as usize;
                let other = self.samples[at];
                if other.found() && self.one_surface(own, other.inverse_depth(), ((dx * dx + dy * dy) as f32).sqrt()) {
                    *near = at as u32;
                    break;
                }
            }
        }
        let patch = self.pruned(&mut links);
        (links, patch)
    }

    /// Whether looking farther than `reach` makes sense.
    pub fn may_find_more(&self, links: &Links, reach: f32) -> bool {
        links.near.contains(&0) && self.patch(links).spacing().is_none_or(|s| s * self.row_ratio > reach)
    }

    /// The spacing at a sample in quarters of a pixel; 0 for unknown.
    pub fn spacing_code(&self, links: &Links) -> u8 {
        self.patch(links).spacing().map_or(0, |s| (4.0 * s).ceil().min(255.0) as u8)
    }

    /// The sigma of a depth in the cloud's unit, from samples against the lines between their neighbours: the median of
    /// a sixteenth of the rows, so that edges and leaves do not count. 0 where the samples stand too far apart.
    pub fn depth_noise(&self) -> f32 {
        let rows: Vec<usize> = (self.grid.first_row()..self.grid.rows() - self.grid.first_row()).step_by(16).collect();
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
        let reach = patch.spacing().map_or(max_gap, |s| (s * self.row_ratio).min(max_gap));
        let mut best = [f32::INFINITY; QUADRANTS];
        let before = *links;
        pyramid.around(x, y, |other| {
            let (dx, dy) = (other as isize % stride - x, other as isize / stride - y);
            let k = quadrant(dx, dy);
            if (dx, dy) == (0, 0) || before.near[k] != 0 {
                return;
            }
            let d = ((dx * dx + dy * dy) as f32).sqrt();
            let its = spacing[other as usize];
            let near = d <= reach && (its == 0 || d <= 0.25 * f32::from(its) * self.row_ratio);
            if d < best[k] && near && self.one_surface(patch.own, self.samples[other as usize].inverse_depth(), d) {
                best[k] = d;
                links.near[k] = other;
            }
        });
        let patch = self.pruned(links);
        (0..QUADRANTS).any(|k| links.near[k] != before.near[k]).then_some(patch)
    }
}

/// Cells of growing width, each with the foremost sample below it.
pub(super) struct Pyramid {
    level: u32,
    stride: usize,
    rows: usize,
    /// The cell of the buffer, 0 for none.
    front: Vec<u32>,
}

impl Pyramid {
    /// The buffer itself.
    pub fn new(grid: &Grid) -> Self {
        Self { level: 0, stride: grid.stride(), rows: grid.rows(), front: Vec::new() }
    }

    /// One level up.
    pub fn coarsen(&mut self, samples: &[Sample]) {
        let (stride, rows) = (self.stride.div_ceil(2), self.rows.div_ceil(2));
        let mut front = vec![0_u32; stride * rows];
        let (old, old_stride, old_rows, base) = (&self.front, self.stride, self.rows, self.level == 0);
        front.par_chunks_mut(stride).enumerate().for_each(|(y, row)| {
            for (x, best) in row.iter_mut().enumerate() {
                for cy in 2 * y..(2 * y + 2).min(old_rows) {
                    for cx in 2 * x..(2 * x + 2).min(old_stride) {
                        let cell = cy * old_stride + cx;
                        let candidate = if base { cell as u32 } else { old[cell] };
                        if samples[candidate as usize] > samples[*best as usize] {
                            *best = candidate;
                        }
                    }
                }
            }
        });
        *self = Self { level: self.level + 1, stride, rows, front };
    }

    /// The foremost samples in the cells around a position.
    fn around(&self, x: isize, y: isize, mut see: impl FnMut(u32)) {
        let (cx, cy) = (x >> self.level, y >> self.level);
        let (left, right) = ((cx - WINDOW).max(0), (cx + WINDOW).min(self.stride as isize - 1));
        for row in (cy - WINDOW).max(0)..=(cy + WINDOW).min(self.rows as isize - 1) {
            let start = row as usize * self.stride;
            for &cell in &self.front[start + left as usize..=start + right as usize] {
                if cell != 0 {
                    see(cell);
                }
            }
        }
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
