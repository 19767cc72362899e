//! Templates of the SCI searched in the photo: many at once, in parallel, the same at any number of threads.

use rayon::prelude::*;

use super::channels::{ChannelOptions, Channels, channels, masked_blur};
use super::correlation::{Placement, Surface, Template};
use super::fourier::Fourier;
use super::mutual;
use super::peak::{best_is_at_the_border, highest};
use super::plane::Plane;
use crate::error::{Error, Result};

/// What is compared.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Measure {
    /// Oriented gradient channels by zero-mean normalised correlation.
    Channels(ChannelOptions),
    /// Grey values, blurred by this sigma (px), by zero-mean normalised correlation.
    Grey(f32),
    /// Grey values in this many bins of equal population, by normalised mutual information.
    MutualInformation(usize),
}

/// What a picture is compared by.
#[derive(Debug, Clone)]
pub struct Features {
    measure: Measure,
    stack: Channels,
}

impl Features {
    /// How they were made.
    pub fn measure(&self) -> Measure {
        self.measure
    }

    /// Width and height of the picture.
    pub fn size(&self) -> (usize, usize) {
        (self.stack.weight.width, self.stack.weight.height)
    }
}

impl Measure {
    /// What a picture is compared by. `known` is 1 where a pixel is known and 0 elsewhere.
    pub fn features(&self, image: &Plane, known: Option<&Plane>) -> Result<Features> {
        Ok(Features { measure: *self, stack: self.stack(image, known)? })
    }

    fn stack(&self, image: &Plane, known: Option<&Plane>) -> Result<Channels> {
        if let Some(known) = known
            && !known.same_size(image)
        {
            return Err(Error::invalid("the mask has not the size of its image"));
        }
        let weight = || match known {
            Some(known) => known.map(|k| f32::from(u8::from(k > 0.0))),
            None => Plane::filled(image.width, image.height, 1.0),
        };
        match self {
            Self::Channels(options) => channels(image, known, options),
            Self::Grey(sigma) => {
                let weight = weight();
                let plane = masked_blur(image, known, *sigma).zip(&weight, |v, k| v * k);
                Ok(Channels { planes: vec![plane], weight })
            }
            Self::MutualInformation(bins) => {
                if !(2..=64).contains(bins) {
                    return Err(Error::invalid(format!("mutual information takes 2 to 64 bins, not {bins}")));
                }
                let weight = weight();
                let plane = binned(image, &weight, *bins);
                Ok(Channels { planes: vec![plane], weight })
            }
        }
    }
}

/// Bin numbers of equal population.
fn binned(image: &Plane, weight: &Plane, bins: usize) -> Plane {
    let mut sorted: Vec<f32> =
        image.values.iter().zip(&weight.values).filter(|(_, w)| **w > 0.0).map(|(v, _)| *v).collect();
    sorted.par_sort_unstable_by(f32::total_cmp);
    let limits: Vec<f32> = (1..bins).filter_map(|b| sorted.get(b * sorted.len() / bins).copied()).collect();
    image.zip(weight, |v, w| if w > 0.0 { limits.partition_point(|l| *l <= v) as f32 } else { 0.0 })
}

/// How templates are searched.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TemplateOptions {
    /// A template has 2 half + 1 pixels a side.
    pub half: usize,
    /// Shifts up to this many pixels in x and y are tried.
    pub radius: usize,
    /// The share of a template that has to be known.
    pub least_known: f32,
    /// A score below this is no match.
    pub least_score: f32,
    /// A second peak above this share of the best makes a match ambiguous.
    pub largest_second: f32,
    /// Second peaks count when they are farther from the best than this, px.
    pub apart: usize,
    /// How many peaks of a template are returned; more than one for a search by consensus, which is then the one to
    /// settle ambiguities.
    pub hypotheses: usize,
}

impl Default for TemplateOptions {
    fn default() -> Self {
        Self { half: 24, radius: 12, least_known: 0.5, least_score: 0.2, largest_second: 0.85, apart: 3, hypotheses: 1 }
    }
}

/// What became of a template, or of one of its peaks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Outcome {
    /// One clear peak.
    Matched,
    /// The template does not lie wholly in the picture, or too little of it is known.
    Unknown,
    /// The best score lies at the border of the window: the true one may lie outside.
    AtTheBorder,
    /// The best score is too low.
    Weak,
    /// A second peak is nearly as high.
    Ambiguous,
    /// The surface is a ridge: the shift is determined in one direction only.
    Ridge,
}

impl Outcome {
    /// All outcomes, in the order of their codes.
    pub const ALL: [Self; 6] =
        [Self::Matched, Self::Unknown, Self::AtTheBorder, Self::Weak, Self::Ambiguous, Self::Ridge];

    /// A word for tables.
    pub fn name(self) -> &'static str {
        match self {
            Self::Matched => "matched",
            Self::Unknown => "unknown",
            Self::AtTheBorder => "border",
            Self::Weak => "weak",
            Self::Ambiguous => "ambiguous",
            Self::Ridge => "ridge",
        }
    }
}

/// A template's place in the photo.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Match {
    /// The number of the template.
    pub template: usize,
    /// Photo minus SCI, px; NaN unless there is a peak.
    pub shift: [f64; 2],
    /// Its covariance, xx xy yy, px²; NaN unless the peak is curved in all directions.
    pub covariance: [f64; 3],
    /// The score of the peak.
    pub score: f32,
    /// The score of the next peak, 0 if there is none.
    pub second: f32,
    /// The score without any shift; NaN where it is not known.
    pub here: f32,
    /// Whether it may be used.
    pub outcome: Outcome,
}

impl Match {
    fn refused(template: usize, outcome: Outcome, here: f32) -> Self {
        Self {
            template,
            shift: [f64::NAN; 2],
            covariance: [f64::NAN; 3],
            score: f32::NAN,
            second: f32::NAN,
            here,
            outcome,
        }
    }
}

/// Searches the template around each of `points` (column, row of the SCI) in the photo, around the same pixel. Both
/// pictures have the same size. One row for each template in its order, or, with several hypotheses, one for each peak.
pub fn match_templates(
    sci: &Features,
    photo: &Features,
    points: &[[usize; 2]],
    options: &TemplateOptions,
) -> Result<Vec<Match>> {
    let (taper, fourier) = prepared(sci, photo, options)?;
    let rows: Result<Vec<Vec<Match>>> = points
        .par_iter()
        .enumerate()
        .map(|(i, p)| search_one(sci, photo, i, *p, options, &taper, fourier.as_ref()))
        .collect();
    Ok(rows?.into_iter().flatten().collect())
}

/// The taper of the templates, and the transform where it is the quicker way.
fn prepared(sci: &Features, photo: &Features, options: &TemplateOptions) -> Result<(Vec<f32>, Option<Fourier>)> {
    let (found, wanted) = (photo.size(), sci.size());
    if found != wanted {
        return Err(Error::invalid(format!(
            "the photo of {} × {} pixels has to be brought to the size of the SCI, {} × {}",
            found.0, found.1, wanted.0, wanted.1
        )));
    }
    if sci.measure != photo.measure {
        return Err(Error::invalid("SCI and photo were prepared for different measures"));
    }
    if options.half < 3 || options.radius < 2 || options.half > 512 || options.radius > 1024 {
        return Err(Error::invalid(format!(
            "templates of half size {} searched within {} px are not possible (3 to 512, 2 to 1024)",
            options.half, options.radius
        )));
    }
    let side = 2 * options.half + 1;
    let window = side + 2 * options.radius;
    let fourier =
        by_spectra_is_quicker(side, options.radius, sci.stack.planes.len()).then(|| Fourier::at_least(window, window));
    Ok((taper(options.half), fourier))
}

/// Multiplications of the sums against those of the transforms, whose constant was measured.
fn by_spectra_is_quicker(side: usize, radius: usize, planes: usize) -> bool {
    let shifts = (2 * radius + 1) as f64;
    let sums = (side * side) as f64 * shifts * shifts * (2 * planes + 1) as f64;
    let window = (side + 2 * radius) as f64;
    let spectra = (3 * planes + 4) as f64 * window * window * window.log2() * 6.0;
    spectra < sums
}

/// A raised cosine: pixels at the border of a template count less, so that nothing enters it with a jump.
fn taper(half: usize) -> Vec<f32> {
    let side = 2 * half + 1;
    let line: Vec<f32> = (0..side)
        .map(|i| {
            let t = (i as f32 - half as f32).abs() / (half as f32 + 1.0);
            if t < 0.5 { 1.0 } else { 0.5 + 0.5 * (std::f32::consts::PI * (2.0 * t - 1.0)).cos() }
        })
        .collect();
    line.iter().flat_map(|a| line.iter().map(move |b| a * b)).collect()
}

fn search_one(
    sci: &Features,
    photo: &Features,
    index: usize,
    point: [usize; 2],
    options: &TemplateOptions,
    taper: &[f32],
    fourier: Option<&Fourier>,
) -> Result<Vec<Match>> {
    Ok(match surface(sci, photo, point, options, taper, fourier)? {
        Some((surface, samples)) => judge(&surface, samples, index, options),
        None => vec![Match::refused(index, Outcome::Unknown, f32::NAN)],
    })
}

/// The scores of one template at all shifts and its number of independent pixels; `None` where too little is known.
fn surface(
    sci: &Features,
    photo: &Features,
    point: [usize; 2],
    options: &TemplateOptions,
    taper: &[f32],
    fourier: Option<&Fourier>,
) -> Result<Option<(Surface, f64)>> {
    let at = Placement { x: point[0], y: point[1], half: options.half, radius: options.radius, least_overlap: 0.6 };
    let measure = sci.measure;
    let (sci, photo) = (&sci.stack, &photo.stack);
    let (surface, pixels) = match measure {
        Measure::MutualInformation(bins) => match mutual::search(sci, photo, &at, bins, options.least_known) {
            Some((surface, pixels, known)) if known >= options.least_known => (surface, pixels),
            _ => return Ok(None),
        },
        _ => match Template::cut(sci, &at, taper) {
            Some(template) if template.known() >= options.least_known => {
                (template.search(photo, &at, fourier)?, template.pixels())
            }
            _ => return Ok(None),
        },
    };
    Ok(Some((surface, f64::from(pixels) / independent_area(&measure))))
}

/// The scores of a template at all its shifts.
#[derive(Debug, Clone, PartialEq)]
pub struct Scores {
    /// (2 radius + 1)² scores, row by row from the shift (−radius, −radius); NaN where too little is known.
    pub scores: Vec<f32>,
    /// The number of independent pixels that each stands on; 0 where the template is not known.
    pub samples: f64,
}

/// The whole score surfaces of templates, for an estimate that takes them together: edges, which fix a shift in one
/// direction only, and repetitions, which no single template can tell apart, then help and do not mislead.
pub fn score_templates(
    sci: &Features,
    photo: &Features,
    points: &[[usize; 2]],
    options: &TemplateOptions,
) -> Result<Vec<Scores>> {
    let (taper, fourier) = prepared(sci, photo, options)?;
    let side = 2 * options.radius + 1;
    points
        .par_iter()
        .map(|p| {
            Ok(match surface(sci, photo, *p, options, &taper, fourier.as_ref())? {
                Some((surface, samples)) => Scores { scores: surface.scores, samples },
                None => Scores { scores: vec![f32::NAN; side * side], samples: 0.0 },
            })
        })
        .collect()
}

/// Pixels that share one independent value: 4π σ² of what was blurred.
fn independent_area(measure: &Measure) -> f64 {
    let variance = match measure {
        Measure::Channels(o) => o.sigma_gradient * o.sigma_gradient + o.sigma_channel * o.sigma_channel,
        Measure::Grey(sigma) => sigma * sigma,
        Measure::MutualInformation(_) => 0.0,
    };
    (4.0 * std::f64::consts::PI * f64::from(variance)).max(1.0)
}

fn judge(surface: &Surface, samples: f64, index: usize, options: &TemplateOptions) -> Vec<Match> {
    let wanted = options.hypotheses.max(1);
    let peaks = highest(surface, wanted.max(2), options.apart);
    let here = surface.scores[surface.scores.len() / 2];
    if peaks.is_empty() || (wanted == 1 && best_is_at_the_border(surface)) {
        return vec![Match::refused(index, Outcome::AtTheBorder, here)];
    }
    let second = peaks.get(1).map_or(0.0, |p| p.score.max(0.0));
    peaks
        .iter()
        .take(wanted)
        .map(|peak| {
            let covariance = peak.covariance(samples);
            let outcome = if peak.score < options.least_score {
                Outcome::Weak
            } else if wanted == 1 && second > options.largest_second * peak.score {
                Outcome::Ambiguous
            } else if covariance.is_none() {
                Outcome::Ridge
            } else {
                Outcome::Matched
            };
            Match {
                template: index,
                shift: peak.shift,
                covariance: covariance.unwrap_or([f64::NAN; 3]),
                score: peak.score,
                second,
                here,
                outcome,
            }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Smooth pseudo-random texture with value at real positions.
    fn texture(x: f64, y: f64, seed: f64) -> f64 {
        (0..40)
            .map(|k| {
                let k = f64::from(k) + seed;
                let (a, f) = ((k * 12.9898).sin() * 43758.5453, 0.05 + 0.25 * ((k * 78.233).sin() * 0.5 + 0.5));
                let angle = a.fract() * std::f64::consts::TAU;
                (f * (x * angle.cos() + y * angle.sin()) + 6.0 * (k * 3.7).sin()).sin()
            })
            .sum()
    }

    fn picture(shift: [f64; 2], seed: f64, curve: impl Fn(f64) -> f64 + Sync) -> Plane {
        Plane::by_rows(160, 140, |y, row| {
            for (x, v) in row.iter_mut().enumerate() {
                *v = curve(texture(x as f64 - shift[0], y as f64 - shift[1], seed)) as f32;
            }
        })
    }

    const POINTS: [[usize; 2]; 4] = [[60, 60], [80, 60], [70, 80], [100, 70]];

    #[test]
    fn every_measure_finds_a_shift_to_a_fraction_of_a_pixel() {
        let shift = [3.37, -2.21];
        let sci = picture([0.0; 2], 1.0, |v| v);
        // The photo answers with other grey values: reversed and bent, which only the second may see.
        let reversed = picture(shift, 1.0, |v| -v - 0.02 * v * v);
        let same = picture(shift, 1.0, |v| 2.0 * v + 5.0);
        for (measure, photo, limit) in [
            (Measure::Channels(ChannelOptions::default()), &reversed, 0.05),
            (Measure::Grey(0.7), &same, 0.05),
            (Measure::MutualInformation(12), &reversed, 0.15),
        ] {
            let options = TemplateOptions { radius: 8, ..TemplateOptions::default() };
            let (a, b) = (measure.features(&sci, None).unwrap(), measure.features(photo, None).unwrap());
            for m in match_templates(&a, &b, &POINTS, &options).unwrap() {
                assert_eq!(m.outcome, Outcome::Matched, "{m:?}");
                assert!((m.shift[0] - shift[0]).abs() < limit && (m.shift[1] - shift[1]).abs() < limit, "{m:?}");
            }
        }
    }

    #[test]
    fn the_stated_covariance_follows_the_scatter_under_noise() {
        // Independent noise in many photos: scatter against statement, within a factor of two.
        let sci = picture([0.0; 2], 2.0, |v| v);
        let clean = picture([1.4, 0.6], 2.0, |v| v);
        let measure = Measure::Grey(1.0);
        let options = TemplateOptions { radius: 5, half: 12, ..TemplateOptions::default() };
        let a = measure.features(&sci, None).unwrap();
        let (mut errors, mut stated) = (Vec::new(), Vec::new());
        for trial in 0..60u64 {
            let mut state = (trial + 1).wrapping_mul(0x9E37_79B9_7F4A_7C15);
            let mut noisy = clean.clone();
            for v in &mut noisy.values {
                let mut sum = 0.0;
                for _ in 0..12 {
                    state ^= state << 13;
                    state ^= state >> 7;
                    state ^= state << 17;
                    sum += (state >> 40) as f32 / (1u64 << 24) as f32 - 0.5;
                }
                *v += 15.0 * sum;
            }
            let b = measure.features(&noisy, None).unwrap();
            for m in match_templates(&a, &b, &POINTS, &options).unwrap() {
                if m.outcome == Outcome::Matched {
                    errors.push((m.shift[0] - 1.4).powi(2));
                    stated.push(m.covariance[0]);
                }
            }
        }
        assert!(errors.len() > 200, "{}", errors.len());
        let (scatter, statement) =
            (errors.iter().sum::<f64>() / errors.len() as f64, stated.iter().sum::<f64>() / stated.len() as f64);
        let ratio = (scatter / statement).sqrt();
        assert!((0.5..2.0).contains(&ratio), "scatter {scatter} stated {statement}");
    }

    #[test]
    fn repetition_is_ambiguous_and_a_ridge_is_a_ridge() {
        let stripes = |phase: f64| {
            Plane::by_rows(160, 140, move |y, row| {
                for (x, v) in row.iter_mut().enumerate() {
                    *v = ((x as f64 - phase) * 0.9).sin() as f32 + (y as f64 * 0.8).cos() as f32;
                }
            })
        };
        let measure = Measure::Channels(ChannelOptions::default());
        let options = TemplateOptions { radius: 12, ..TemplateOptions::default() };
        let features = |p: &Plane| measure.features(p, None).unwrap();
        let found = match_templates(&features(&stripes(0.0)), &features(&stripes(1.0)), &POINTS, &options).unwrap();
        assert!(found.iter().all(|m| m.outcome == Outcome::Ambiguous), "{found:?}");
        let edge = Plane::by_rows(160, 140, |y, row| {
            for (x, v) in row.iter_mut().enumerate() {
                *v = ((x as f32 + 0.5 * y as f32 - 110.0) / 3.0).tanh() + 1e-6 * (x * y) as f32;
            }
        });
        let found = match_templates(&features(&edge), &features(&edge), &[[80, 60]], &options).unwrap();
        assert_ne!(found[0].outcome, Outcome::Matched, "{found:?}");
    }

    #[test]
    fn templates_that_leave_the_picture_or_are_mostly_holes_are_refused() {
        let image = picture([0.0; 2], 3.0, |v| v);
        let known = Plane::by_rows(160, 140, |_, row| row.iter_mut().take(85).for_each(|v| *v = 1.0));
        let measure = Measure::Channels(ChannelOptions::default());
        let sci = measure.features(&image, Some(&known)).unwrap();
        let photo = measure.features(&image, None).unwrap();
        let options = TemplateOptions::default();
        let found = match_templates(&sci, &photo, &[[10, 70], [100, 70], [40, 70]], &options).unwrap();
        let outcomes: Vec<Outcome> = found.iter().map(|m| m.outcome).collect();
        assert_eq!(outcomes, [Outcome::Unknown, Outcome::Unknown, Outcome::Matched]);
    }
}
