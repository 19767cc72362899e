//! How well a template fits at each shift of a window: the zero-mean normalised correlation of a stack of planes over
//! the pixels known on both sides (Padfield 2012 for the masks), by sums or by Fourier transforms, whichever is less
//! work.

use super::channels::Channels;
use super::fourier::{Fourier, add_correlation, correlation};
use crate::error::Result;

/// Scores at the shifts −radius … radius in x and y, row by row; NaN where too little is known to say.
#[derive(Debug, Clone)]
pub(super) struct Surface {
    pub radius: usize,
    pub scores: Vec<f32>,
}

impl Surface {
    pub fn side(&self) -> usize {
        2 * self.radius + 1
    }
}

/// Where a template lies and how far it is searched.
#[derive(Debug, Clone, Copy)]
pub(super) struct Placement {
    pub x: usize,
    pub y: usize,
    pub half: usize,
    pub radius: usize,
    /// The share of the template's weight that has to be known in the photo.
    pub least_overlap: f32,
}

impl Placement {
    fn side(&self) -> usize {
        2 * self.half + 1
    }

    fn window(&self) -> usize {
        2 * (self.half + self.radius) + 1
    }
}

/// A template cut out of the SCI: weighted values of each plane.
pub(super) struct Template {
    /// Weights: taper times known.
    weight: Vec<f32>,
    /// Values of each plane, their weighted mean taken off.
    centred: Vec<Vec<f32>>,
    /// Σ w.
    total: f32,
    /// Σ w over a template that is known everywhere.
    full: f32,
    /// Σ w T² of the centred planes.
    energy: f32,
}

impl Template {
    /// `None` where the template does not lie wholly in the picture.
    pub fn cut(sci: &Channels, at: &Placement, taper: &[f32]) -> Option<Self> {
        let (half, side) = (at.half, at.side());
        let inside = at.x >= half && at.y >= half && at.x + half < sci.weight.width && at.y + half < sci.weight.height;
        if !inside {
            return None;
        }
        let rows = |plane: &super::Plane| -> Vec<f32> {
            (0..side).flat_map(|v| plane.row(at.y - half + v)[at.x - half..=at.x + half].iter().copied()).collect()
        };
        let weight: Vec<f32> = rows(&sci.weight).iter().zip(taper).map(|(k, t)| k * t).collect();
        let total: f32 = weight.iter().sum();
        let mut centred: Vec<Vec<f32>> = sci.planes.iter().map(rows).collect();
        let mut energy = 0.0;
        for plane in &mut centred {
            let mean = dot(plane, &weight) / total.max(f32::MIN_POSITIVE);
            for (v, w) in plane.iter_mut().zip(&weight) {
                *v -= mean;
                energy += w * *v * *v;
            }
        }
        Some(Self { weight, centred, total, full: taper.iter().sum(), energy })
    }

    /// The share of the template that is known.
    pub fn known(&self) -> f32 {
        self.total / self.full
    }

    /// Σ w: the number of pixels that count.
    pub fn pixels(&self) -> f32 {
        self.total
    }

    /// The score of every shift.
    pub fn search(&self, photo: &Channels, at: &Placement, fourier: Option<&Fourier>) -> Result<Surface> {
        let window = Window::cut(photo, at);
        match fourier {
            Some(fourier) => self.by_fourier(&window, at, fourier),
            None => Ok(self.by_sums(&window, at)),
        }
    }

    fn by_sums(&self, window: &Window, at: &Placement) -> Surface {
        let (side, shifts) = (at.side(), 2 * at.radius + 1);
        let mut scores = vec![f32::NAN; shifts * shifts];
        for (i, score) in scores.iter_mut().enumerate() {
            let (dx, dy) = (i % shifts, i / shifts);
            let mut sums = Sums::default();
            for (c, plane) in window.planes.iter().enumerate() {
                let (mut product, mut mean) = (0.0, 0.0);
                let mut template_mean = 0.0;
                for v in 0..side {
                    let row = v * side..(v + 1) * side;
                    let (t, w) = (&self.centred[c][row.clone()], &self.weight[row]);
                    let p = &plane[(v + dy) * window.side + dx..][..side];
                    let (a, b) = weighted_products(t, w, p);
                    product += a;
                    mean += b;
                    if !window.complete {
                        let k = &window.known[(v + dy) * window.side + dx..][..side];
                        template_mean += weighted_products(t, w, k).0;
                    }
                }
                sums.covariance += product;
                sums.add_means(template_mean, mean);
            }
            let mut photo_energy = 0.0;
            for v in 0..side {
                let row = v * side..(v + 1) * side;
                photo_energy += dot(&self.weight[row], &window.squares[(v + dy) * window.side + dx..][..side]);
            }
            sums.photo_energy = photo_energy;
            if window.complete {
                (sums.total, sums.template_energy) = (self.total, self.energy);
            } else {
                for v in 0..side {
                    let row = v * side..(v + 1) * side;
                    let k = &window.known[(v + dy) * window.side + dx..][..side];
                    sums.total += dot(&self.weight[row.clone()], k);
                    for plane in &self.centred {
                        let t = &plane[row.clone()];
                        let w = &self.weight[row.clone()];
                        sums.template_energy += t.iter().zip(w).zip(k).map(|((t, w), k)| t * t * w * k).sum::<f32>();
                    }
                }
            }
            *score = sums.score(at.least_overlap * self.total);
        }
        Surface { radius: at.radius, scores }
    }

    fn by_fourier(&self, window: &Window, at: &Placement, fourier: &Fourier) -> Result<Surface> {
        let (side, shifts) = (at.side(), 2 * at.radius + 1);
        let template_rows = |values: &dyn Fn(usize) -> f32| {
            fourier.forward(side, |y, row| (0..side).for_each(|x| row[x] = values(y * side + x)))
        };
        let window_rows = |values: &[f32]| {
            fourier.forward(window.side, |y, row| {
                row[..window.side].copy_from_slice(&values[y * window.side..(y + 1) * window.side]);
            })
        };
        let weight = template_rows(&|i| self.weight[i])?;
        let mut product = fourier.zeros();
        let mut means = Vec::with_capacity(self.centred.len());
        let known = if window.complete { None } else { Some(window_rows(&window.known)?) };
        for (t, p) in self.centred.iter().zip(&window.planes) {
            let weighted = template_rows(&|i| t[i] * self.weight[i])?;
            let plane = window_rows(p)?;
            add_correlation(&mut product, &weighted, &plane);
            let photo_mean = fourier.inverse(correlation(&weight, &plane), shifts)?;
            let template_mean = match &known {
                Some(known) => Some(fourier.inverse(correlation(&weighted, known), shifts)?),
                None => None,
            };
            means.push((template_mean, photo_mean));
        }
        let product = fourier.inverse(product, shifts)?;
        let photo_energy = fourier.inverse(correlation(&weight, &window_rows(&window.squares)?), shifts)?;
        let partial = match &known {
            Some(known) => {
                let energy =
                    template_rows(&|i| self.weight[i] * self.centred.iter().map(|t| t[i] * t[i]).sum::<f32>())?;
                Some((
                    fourier.inverse(correlation(&weight, known), shifts)?,
                    fourier.inverse(correlation(&energy, known), shifts)?,
                ))
            }
            None => None,
        };
        let mut scores = vec![f32::NAN; shifts * shifts];
        for dy in 0..shifts {
            for dx in 0..shifts {
                let i = dy * fourier.width + dx;
                let mut sums = Sums { covariance: product[i], photo_energy: photo_energy[i], ..Sums::default() };
                (sums.total, sums.template_energy) = match &partial {
                    Some((total, energy)) => (total[i], energy[i]),
                    None => (self.total, self.energy),
                };
                for (template_mean, photo_mean) in &means {
                    sums.add_means(template_mean.as_ref().map_or(0.0, |m| m[i]), photo_mean[i]);
                }
                scores[dy * shifts + dx] = sums.score(at.least_overlap * self.total);
            }
        }
        Ok(Surface { radius: at.radius, scores })
    }
}

/// The part of the photo that a template is searched in.
struct Window {
    side: usize,
    planes: Vec<Vec<f32>>,
    /// Σ P² over the planes.
    squares: Vec<f32>,
    known: Vec<f32>,
    /// Whether every pixel is known.
    complete: bool,
}

impl Window {
    fn cut(photo: &Channels, at: &Placement) -> Self {
        let side = at.window();
        let reach = (at.half + at.radius) as isize;
        let (left, top) = (at.x as isize - reach, at.y as isize - reach);
        let (w, h) = (photo.weight.width as isize, photo.weight.height as isize);
        let (x0, x1) = (left.clamp(0, w), (left + side as isize).clamp(0, w));
        let rows = |plane: &super::Plane| {
            let mut out = vec![0.0; side * side];
            for v in 0..side {
                let y = top + v as isize;
                if (0..h).contains(&y) && x1 > x0 {
                    let row = &plane.row(y as usize)[x0 as usize..x1 as usize];
                    let start = v * side + (x0 - left) as usize;
                    out[start..start + row.len()].copy_from_slice(row);
                }
            }
            out
        };
        let planes: Vec<Vec<f32>> = photo.planes.iter().map(rows).collect();
        let known = rows(&photo.weight);
        let mut squares = vec![0.0; side * side];
        for plane in &planes {
            for (s, p) in squares.iter_mut().zip(plane) {
                *s += p * p;
            }
        }
        let complete = known.iter().all(|k| *k > 0.0);
        Self { side, planes, squares, known, complete }
    }
}

/// The sums over the pixels known on both sides that make up a score.
#[derive(Default)]
struct Sums {
    /// Σ w.
    total: f32,
    /// Σ w T P.
    covariance: f32,
    /// Σ over planes of (Σ w T)(Σ w P).
    means: f32,
    /// Σ w T².
    template_energy: f32,
    /// Σ over planes of (Σ w T)².
    template_means: f32,
    /// Σ w P².
    photo_energy: f32,
    /// Σ over planes of (Σ w P)².
    photo_means: f32,
}

impl Sums {
    fn add_means(&mut self, template: f32, photo: f32) {
        self.means += template * photo;
        self.template_means += template * template;
        self.photo_means += photo * photo;
    }

    fn score(&self, least: f32) -> f32 {
        if self.total < least || self.total <= 0.0 {
            return f32::NAN;
        }
        let template = self.template_energy - self.template_means / self.total;
        let photo = self.photo_energy - self.photo_means / self.total;
        // An even patch of the photo has no correlation with anything, and rounding must not make one up.
        if template <= 1e-6 * self.template_energy || photo <= 1e-5 * self.photo_energy || photo <= 0.0 {
            return 0.0;
        }
        ((self.covariance - self.means / self.total) / (template * photo).sqrt()).clamp(-1.0, 1.0)
    }
}

/// Sums in eight lanes: the compiler may not reorder a float sum by itself.
fn dot(a: &[f32], b: &[f32]) -> f32 {
    let (a_chunks, a_rest) = a.as_chunks::<8>();
    let (b_chunks, b_rest) = b.as_chunks::<8>();
    let mut lanes = [0.0f32; 8];
    for (a, b) in a_chunks.iter().zip(b_chunks) {
        for i in 0..8 {
            lanes[i] += a[i] * b[i];
        }
    }
    lanes.iter().sum::<f32>() + a_rest.iter().zip(b_rest).map(|(a, b)| a * b).sum::<f32>()
}

/// Σ t w p and Σ w p.
fn weighted_products(t: &[f32], w: &[f32], p: &[f32]) -> (f32, f32) {
    let (t_chunks, t_rest) = t.as_chunks::<8>();
    let (w_chunks, w_rest) = w.as_chunks::<8>();
    let (p_chunks, p_rest) = p.as_chunks::<8>();
    let (mut products, mut sums) = ([0.0f32; 8], [0.0f32; 8]);
    for ((t, w), p) in t_chunks.iter().zip(w_chunks).zip(p_chunks) {
        for i in 0..8 {
            let weighted = w[i] * p[i];
            sums[i] += weighted;
            products[i] += t[i] * weighted;
        }
    }
    let (mut product, mut sum) = (products.iter().sum::<f32>(), sums.iter().sum::<f32>());
    for ((t, w), p) in t_rest.iter().zip(w_rest).zip(p_rest) {
        sum += w * p;
        product += t * w * p;
    }
    (product, sum)
}

#[cfg(test)]
mod tests {
    use super::super::Plane;
    use super::*;

    fn noise(w: usize, h: usize, seed: u64) -> Plane {
        let mut state = seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1;
        Plane::new(
            w,
            h,
            (0..w * h)
                .map(|_| {
                    state ^= state << 13;
                    state ^= state >> 7;
                    state ^= state << 17;
                    (state >> 40) as f32 / (1u64 << 24) as f32
                })
                .collect(),
        )
        .unwrap()
    }

    fn stack(seed: u64, known: Plane) -> Channels {
        let planes = (0..3).map(|c| noise(60, 50, seed + c).zip(&known, |v, k| v * k)).collect();
        Channels { planes, weight: known }
    }

    /// The definition, written down once more: weighted Pearson correlation of stacked planes over common pixels.
    fn definition(sci: &Channels, photo: &Channels, at: &Placement, taper: &[f32], dx: isize, dy: isize) -> f64 {
        let half = at.half as isize;
        let mut rows = Vec::new();
        for v in -half..=half {
            for u in -half..=half {
                let (x, y) = (at.x as isize + u, at.y as isize + v);
                let (px, py) = (x + dx, y + dy);
                if px < 0 || py < 0 || px >= 60 || py >= 50 {
                    continue;
                }
                let (x, y, px, py) = (x as usize, y as usize, px as usize, py as usize);
                let index = ((v + half) * (2 * half + 1) + u + half) as usize;
                let w = f64::from(taper[index] * sci.weight.at(x, y) * photo.weight.at(px, py));
                for c in 0..3 {
                    rows.push((c, w, f64::from(sci.planes[c].at(x, y)), f64::from(photo.planes[c].at(px, py))));
                }
            }
        }
        let (mut st, mut sp, mut tp) = (0.0, 0.0, 0.0);
        for c in 0..3 {
            let of: Vec<_> = rows.iter().filter(|r| r.0 == c).collect();
            let total: f64 = of.iter().map(|r| r.1).sum();
            let mt = of.iter().map(|r| r.1 * r.2).sum::<f64>() / total;
            let mp = of.iter().map(|r| r.1 * r.3).sum::<f64>() / total;
            for r in of {
                st += r.1 * (r.2 - mt).powi(2);
                sp += r.1 * (r.3 - mp).powi(2);
                tp += r.1 * (r.2 - mt) * (r.3 - mp);
            }
        }
        tp / (st * sp).sqrt()
    }

    #[test]
    fn both_ways_agree_with_the_definition_with_and_without_masks() {
        let all = Plane::filled(60, 50, 1.0);
        let holes = noise(60, 50, 99).map(|v| f32::from(u8::from(v > 0.3)));
        let taper: Vec<f32> = noise(15, 15, 7).values;
        for (sci_known, photo_known, x) in [(&all, &all, 30), (&holes, &all, 30), (&holes, &holes, 30), (&all, &all, 9)]
        {
            let sci = stack(1, sci_known.clone());
            let photo = stack(2, photo_known.clone());
            let at = Placement { x, y: 25, half: 7, radius: 5, least_overlap: 0.2 };
            let template = Template::cut(&sci, &at, &taper).unwrap();
            let fourier = Fourier::at_least(25, 25);
            let sums = template.search(&photo, &at, None).unwrap();
            let spectra = template.search(&photo, &at, Some(&fourier)).unwrap();
            for dy in -5isize..=5 {
                for dx in -5isize..=5 {
                    let i = ((dy + 5) * 11 + dx + 5) as usize;
                    let expected = definition(&sci, &photo, &at, &taper, dx, dy);
                    assert!((f64::from(sums.scores[i]) - expected).abs() < 1e-4, "{dx} {dy}");
                    assert!((f64::from(spectra.scores[i]) - expected).abs() < 1e-4, "{dx} {dy}");
                }
            }
        }
    }
}
