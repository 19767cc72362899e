//! What the neighbours of a sample say of the surface there: how far apart its points are, how it slopes, and which of
//! the neighbours belong to another one.

use super::extremes::{larger, smaller};

/// East, south, west, north.
pub(super) const QUADRANTS: usize = 4;

/// What a neighbour has to keep to.
#[derive(Debug, Clone, Copy)]
pub(super) struct Pruning {
    /// Sigma of a depth, in the cloud's unit.
    pub noise: f32,
    /// The largest relative change by one cell that is nothing special.
    pub usual: f32,
    /// How many times the spacing a gap may be wide.
    pub gap_ratio: f32,
    /// The same where gaps follow each other as the rows of a scan do.
    pub row_ratio: f32,
}

/// A neighbour as the sample sees it. `distance` is 0 for none.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Link {
    pub dx: f32,
    pub dy: f32,
    /// By how much its inverse depth is larger.
    pub rise: f32,
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

    /// Itself, or none.
    #[inline(always)]
    pub fn unless(&self, dropped: bool) -> Self {
        let kept = |v: f32| if dropped { 0.0 } else { v };
        Self { dx: kept(self.dx), dy: kept(self.dy), rise: kept(self.rise), distance: kept(self.distance) }
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
    /// The distance of the second nearest neighbour: two are needed to call it a surface. Infinite without.
    #[inline(always)]
    pub fn spacing(&self) -> f32 {
        let (mut first, mut second) = (f32::INFINITY, f32::INFINITY);
        for link in &self.links {
            let d = if link.found() { link.distance } else { f32::INFINITY };
            second = smaller(second, larger(first, d));
            first = smaller(first, d);
        }
        second
    }

    /// The spacing in quarters of a pixel; 0 for unknown.
    #[inline(always)]
    pub fn spacing_code(&self) -> u8 {
        let spacing = self.spacing();
        if spacing < f32::INFINITY { (4.0 * spacing + 1.0) as u8 } else { 0 }
    }

    /// The plane through the sample that fits the neighbours best: the change of the inverse depth by one cell.
    #[inline(always)]
    pub fn gradient(&self) -> [f32; 2] {
        let (mut xx, mut xy, mut yy, mut xr, mut yr) = (0.0_f32, 0.0, 0.0, 0.0, 0.0);
        for link in &self.links {
            // One that is not there has zeros everywhere.
            let w = if link.found() { 1.0 / (link.distance * link.distance) } else { 0.0 };
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
        for link in &self.links {
            sum += link.rise - gx * link.dx - gy * link.dy;
            n += if link.found() { 1.0 } else { 0.0 };
        }
        sum / n
    }

    /// How far the sample lies off the line between two opposite neighbours; the sum for both pairs.
    #[inline(always)]
    pub fn misfit(&self) -> f32 {
        let off = |k| if self.between(k) { self.off_line(k).0.abs() } else { 0.0 };
        off(0) + off(1)
    }

    /// Whether there are neighbours in quadrants `k` and `k + 2`.
    #[inline(always)]
    pub fn between(&self, k: usize) -> bool {
        self.links[k].found() & self.links[k + 2].found()
    }

    /// The sample's inverse depth against the line between the neighbours of quadrants `k` and `k + 2`; and by how much
    /// its sigma exceeds that of one depth.
    #[inline(always)]
    pub fn off_line(&self, k: usize) -> (f32, f32) {
        let (a, b) = (self.links[k], self.links[k + 2]);
        let all = a.distance + b.distance;
        let (wa, wb) = (b.distance / all, a.distance / all);
        (wa * a.rise + wb * b.rise, (1.0 + wa * wa + wb * wb).sqrt())
    }

    /// Drops what does not belong: of two opposite neighbours that are not on one line with the sample the steeper when
    /// it is steep, and what is too far for the spacing.
    #[inline(always)]
    pub fn prune(&mut self, s: &Pruning) {
        for k in 0..2 {
            let (a, b) = (self.links[k], self.links[k + 2]);
            let near = smaller(a.distance, b.distance);
            let (sa, sb) = (a.slope().abs(), b.slope().abs());
            let bend = (a.slope() + b.slope()).abs() * near;
            let allowed = self.own * (5.0 * s.noise * self.own + s.usual * near) + 0.5 * near * smaller(sa, sb);
            let bent = self.between(k) & (bend > allowed) & (larger(sa, sb) > self.own * s.usual);
            self.links[k] = a.unless(bent & (sa > sb));
            self.links[k + 2] = b.unless(bent & (sa <= sb));
        }
        let (before, spacing) = (self.links, self.spacing());
        for (k, link) in self.links.iter_mut().enumerate() {
            let opposite = before[(k + 2) % QUADRANTS].distance;
            // A scan at a grazing angle has rows far apart, but on both sides; a bar has a gap on one.
            let ratio = if 2.0 * opposite > link.distance { s.row_ratio } else { s.gap_ratio };
            *link = link.unless(link.distance > ratio * spacing);
        }
    }
}
