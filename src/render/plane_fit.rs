//! Planes through the samples of a small window, which may hold more than one surface.
//!
//! The inverse depth of a plane is an affine function of (X, Y)/Z, so that a plane is a line fit in two variables. Where
//! the least-squares plane leaves too much over, planes through three samples each are tried and the one with the most
//! samples near it is kept, as in RANSAC (Fischler and Bolles 1981), with a fixed sequence in place of a random one.

/// Planes through three samples that are tried.
const TRIALS: u32 = 16;
/// So many of all samples within the tolerance, and the least-squares plane needs no trial.
pub(super) const NEARLY_ALL: f32 = 0.9;
/// The fewest samples of a plane.
pub(super) const FEWEST: usize = 8;
/// The smallest share of a window's samples on its first plane, and on the second.
pub(super) const SHARE: [f32; LAYERS] = [0.3, 0.1];
/// Surfaces told apart in one window.
pub(super) const LAYERS: usize = 2;
/// How many sigmas a sample may lie off its plane.
pub(super) const SIGMAS: f32 = 3.0;
/// The square of the sine below which two directions are one.
const ONE_LINE: f64 = 1e-3;

/// A sample seen from the window's middle: (X, Y)/Z in units of the window's radius, and inverse depth.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Spot {
    pub a: f32,
    pub b: f32,
    pub w: f32,
}

/// How well a depth and a place are known.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Noise {
    /// Sigma of a depth, in the cloud's unit.
    pub depth: f32,
    /// By how much an inverse depth is rounded, relative.
    pub rounding: f32,
    /// By how much a place is rounded, in units of the window's radius.
    pub place: f32,
}

impl Noise {
    #[inline(always)]
    fn sigma(&self, w: f32, slope: f32) -> f32 {
        (self.depth * w + self.rounding) * w + self.place * slope
    }
}

/// What samples sum up to: their mean (a, b, w), and sums of products about it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Moments {
    pub mean: [f64; 3],
    /// aa ab bb
    pub spread: [f64; 3],
    /// aw bw
    pub rise: [f64; 2],
}

/// w = c + ga·a + gb·b
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Plane {
    pub c: f32,
    pub ga: f32,
    pub gb: f32,
    /// The root of the mean square of what its samples leave over.
    pub rms: f32,
    /// One over the root of the samples' spread in the direction where it is smallest: times the sigma of w that of the
    /// gradient.
    pub weakness: f32,
}

/// The least-squares plane of all samples of a window.
#[cfg_attr(not(target_arch = "x86_64"), allow(dead_code, reason = "made where there is a kernel for it"))]
#[derive(Debug, Clone, Copy)]
pub(super) struct Fit {
    pub plane: Option<Plane>,
    /// All samples.
    pub count: usize,
    /// Those that lie on the plane.
    pub near: usize,
}

impl Plane {
    #[inline(always)]
    fn off(&self, s: &Spot) -> f32 {
        (s.w - self.c - self.ga * s.a - self.gb * s.b).abs()
    }

    #[inline(always)]
    pub fn slope(&self) -> f32 {
        self.ga.abs() + self.gb.abs()
    }

    /// By least squares; `None` where the samples are too few or on one line.
    pub fn fitted<'a>(spots: impl Iterator<Item = &'a Spot> + Clone) -> Option<Self> {
        let (mut n, mut sum) = (0.0, [0.0; 3]);
        for s in spots.clone() {
            n += 1.0;
            sum[0] += f64::from(s.a);
            sum[1] += f64::from(s.b);
            sum[2] += f64::from(s.w);
        }
        if n < 3.0 {
            return None;
        }
        let [a, b, w] = sum.map(|x| x / n);
        let (mut aa, mut ab, mut bb, mut aw, mut bw, mut ww) = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0);
        for s in spots {
            let (x, y, z) = (f64::from(s.a) - a, f64::from(s.b) - b, f64::from(s.w) - w);
            aa += x * x;
            ab += x * y;
            bb += y * y;
            aw += x * z;
            bw += y * z;
            ww += z * z;
        }
        let (plane, [ga, gb]) = Self::of(&Moments { mean: [a, b, w], spread: [aa, ab, bb], rise: [aw, bw] })?;
        Some(plane.leaving(ww - ga * aw - gb * bw, n))
    }

    /// By least squares from what the samples sum up to, with the gradient in full; what they leave over is not known yet.
    /// `None` where they lie on one line.
    pub fn of(moments: &Moments) -> Option<(Self, [f64; 2])> {
        let Moments { mean: [a, b, w], spread: [aa, ab, bb], rise: [aw, bw] } = *moments;
        let det = aa * bb - ab * ab;
        let trace = aa + bb;
        if det.is_nan() || det <= ONE_LINE * trace * trace {
            return None;
        }
        let (ga, gb) = ((bb * aw - ab * bw) / det, (aa * bw - ab * aw) / det);
        let smallest = 0.5 * trace - (0.25 * trace * trace - det).max(0.0).sqrt();
        let plane = Self {
            c: (w - ga * a - gb * b) as f32,
            ga: ga as f32,
            gb: gb as f32,
            rms: 0.0,
            weakness: smallest.max(f64::MIN_POSITIVE).sqrt().recip() as f32,
        };
        Some((plane, [ga, gb]))
    }

    /// With the sum of the squares of what `n` samples leave over.
    pub fn leaving(self, squares: f64, n: f64) -> Self {
        Self { rms: (squares.max(0.0) / (n - 3.0).max(1.0)).sqrt() as f32, ..self }
    }

    /// Through three samples.
    fn through([p, q, r]: [&Spot; 3]) -> Option<Self> {
        let (x1, y1, z1) = (q.a - p.a, q.b - p.b, q.w - p.w);
        let (x2, y2, z2) = (r.a - p.a, r.b - p.b, r.w - p.w);
        let det = x1 * y2 - x2 * y1;
        if det.abs() < 0.02 {
            return None;
        }
        let (ga, gb) = ((z1 * y2 - z2 * y1) / det, (x1 * z2 - x2 * z1) / det);
        Some(Self { c: p.w - ga * p.a - gb * p.b, ga, gb, rms: 0.0, weakness: f32::INFINITY })
    }

    #[inline(always)]
    pub fn holds(&self, s: &Spot, noise: &Noise) -> bool {
        self.off(s) <= SIGMAS * noise.sigma(s.w, self.slope())
    }
}

/// The planes of a window, the one with the most samples first. `spots` is used up.
pub(super) fn planes_in(spots: &mut Vec<Spot>, noise: &Noise) -> [Option<Plane>; LAYERS] {
    let mut found = [None; LAYERS];
    let all = spots.len() as f32;
    for (found, share) in found.iter_mut().zip(SHARE) {
        let fewest = FEWEST.max((share * all) as usize);
        if spots.len() < fewest {
            break;
        }
        let Some(plane) = best(spots, noise) else { break };
        let before = spots.len();
        spots.retain(|s| !plane.holds(s, noise));
        if before - spots.len() < fewest {
            break;
        }
        *found = Some(plane);
    }
    found
}

fn best(spots: &[Spot], noise: &Noise) -> Option<Plane> {
    let count = |plane: &Plane| spots.iter().filter(|s| plane.holds(s, noise)).count();
    let mut best = Plane::fitted(spots.iter());
    if best.is_some_and(|plane| count(&plane) as f32 >= NEARLY_ALL * spots.len() as f32) {
        return best;
    }
    let mut most = best.as_ref().map_or(0, count);
    let mut state = 1u32;
    for _ in 0..TRIALS {
        let pick: [&Spot; 3] = std::array::from_fn(|_| {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            &spots[((u64::from(state) * spots.len() as u64) >> 32) as usize]
        });
        let Some(plane) = Plane::through(pick) else { continue };
        let n = count(&plane);
        if n > most {
            (best, most) = (Some(plane), n);
        }
    }
    // Three samples carry their own noise into the plane: those near it say better where it lies.
    for _ in 0..2 {
        let plane = best?;
        best = Plane::fitted(spots.iter().filter(|s| plane.holds(s, noise)));
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;

    const NOISE: Noise = Noise { depth: 0.002, rounding: 1e-5, place: 0.005 };

    fn window(plane_at: impl Fn(f32, f32, u32) -> f32) -> Vec<Spot> {
        let mut state = 7u32;
        let mut uniform = move || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) as f32 / (1 << 24) as f32
        };
        (0..200)
            .map(|i| {
                let (a, b) = (2.0 * uniform() - 1.0, 2.0 * uniform() - 1.0);
                let w = plane_at(a, b, i);
                Spot { a, b, w: w + 0.002 * w * w * 3.46 * (uniform() - 0.5) }
            })
            .collect()
    }

    #[test]
    fn one_plane_is_found_with_its_slope() {
        let [first, second] = planes_in(&mut window(|a, b, _| 0.1 + 0.004 * a - 0.002 * b), &NOISE);
        let plane = first.unwrap();
        assert!((plane.c - 0.1).abs() < 5e-6 && (plane.ga - 0.004).abs() < 1e-5 && (plane.gb + 0.002).abs() < 1e-5);
        assert!((plane.rms / 2e-5 - 1.0).abs() < 0.15, "{}", plane.rms);
        assert!(second.is_none());
    }

    #[test]
    fn two_surfaces_are_told_apart_even_where_they_touch() {
        // The edge of a house, and a post before a wall.
        for far in [|a: f32| 0.1 - 0.02 * a, |_: f32| 0.06] {
            let near = |a: f32| 0.1 + 0.01 * a;
            let mut spots = window(|a, _, _| if a < 0.2 { near(a) } else { far(a) });
            let [first, second] = planes_in(&mut spots, &NOISE);
            let (first, second) = (first.unwrap(), second.unwrap());
            assert!((first.ga - 0.01).abs() < 5e-4 && first.gb.abs() < 5e-4, "{first:?}");
            let wanted = far(1.0) - far(0.0);
            assert!((second.ga - wanted).abs() < 1e-3 && second.gb.abs() < 1e-3, "{second:?}");
        }
    }

    #[test]
    fn leaves_a_line_and_too_few_have_no_plane() {
        let leaves =
            |_: f32, _: f32, i: u32| 0.05 + 0.1 * (i.wrapping_mul(2_654_435_761) >> 8) as f32 / (1 << 24) as f32;
        assert_eq!(planes_in(&mut window(leaves), &NOISE), [None, None]);
        let mut line: Vec<Spot> = (0..40).map(|i| Spot { a: 0.02 * i as f32, b: 0.01 * i as f32, w: 0.1 }).collect();
        assert_eq!(planes_in(&mut line, &NOISE), [None, None]);
        let mut few = window(|_, _, _| 0.1)[..FEWEST - 1].to_vec();
        assert_eq!(planes_in(&mut few, &NOISE), [None, None]);
    }
}
