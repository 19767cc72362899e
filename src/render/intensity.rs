//! Intensity as a scanner gives it, made to look like the surface.
//!
//! By the laser radar equation the returned power of a surface that fills the beam is ρ cos θ / r² times what the
//! instrument does (Höfle and Pfeifer 2007). What the instrument does is seldom known: many correct for range already,
//! all are dimmer than the law near by, and rough surfaces fall off more slowly than the cosine. So the exponents are
//! found in the data, log I = a + b log r + c log cos θ by iteratively reweighted least squares, and kept within what
//! physics allows; a scanner that has corrected its intensity gives exponents near 0 and is left alone.

use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;

use crate::error::{Error, Result};
use crate::memory::fresh;

/// The powers of range and of the cosine of incidence that an intensity follows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Exponents {
    /// Of the range: −2 by the law, 0 for a corrected instrument.
    pub range: f64,
    /// Of the cosine of the incidence: 1 for a perfectly diffuse surface.
    pub incidence: f64,
}

impl Exponents {
    /// No correction.
    pub const NONE: Self = Self { range: 0.0, incidence: 0.0 };
}

/// Samples that the fit looks at, at most.
const MOST: usize = 100_000;
/// Cosines below this are of no use: the normal's own error is larger.
const LEAST_COSINE: f64 = 0.08;

/// The exponents of an intensity. `cosines` of the incidence may be empty (unknown) or hold NaN.
pub fn fit_exponents(intensity: &[f32], ranges: &[f32], cosines: &[f32]) -> Result<Exponents> {
    check(intensity, ranges, cosines)?;
    let step = intensity.len().div_ceil(MOST).max(1);
    let rows: Vec<[f64; 3]> = (0..intensity.len())
        .step_by(step)
        .filter_map(|i| {
            let (value, range) = (f64::from(intensity[i]), f64::from(ranges[i]));
            let cosine = cosines.get(i).map_or(1.0, |c| f64::from(*c).abs());
            let usable = value > 0.0 && range > 0.0 && value.is_finite() && range.is_finite() && cosine > LEAST_COSINE;
            usable.then(|| [value.ln(), range.ln(), cosine.ln()])
        })
        .collect();
    if rows.len() < 100 {
        return Ok(Exponents::NONE);
    }
    let n = rows.len() as f64;
    let mean = |k: usize| rows.iter().map(|r| r[k]).sum::<f64>() / n;
    let centre = [mean(0), mean(1), mean(2)];
    let mut coefficients = Vector3::new(centre[0], 0.0, 0.0);
    let mut scale = f64::INFINITY;
    for _ in 0..20 {
        // A weak prior holds what the data do not show: 1 % of the samples with the range's spread of e^0.1.
        let mut normal = Matrix3::from_diagonal(&Vector3::new(0.0, 1e-4 * n, 1e-4 * n));
        let mut right = Vector3::zeros();
        let residual =
            |r: &[f64; 3], c: &Vector3<f64>| r[0] - c[0] - c[1] * (r[1] - centre[1]) - c[2] * (r[2] - centre[2]);
        for r in &rows {
            // Tukey's biweight: signs and wet patches are not the law.
            let t = residual(r, &coefficients) / (4.685 * scale);
            let w = if t.abs() < 1.0 { (1.0 - t * t).powi(2) } else { 0.0 };
            let a = Vector3::new(1.0, r[1] - centre[1], r[2] - centre[2]);
            normal += a * a.transpose() * w;
            right += a * (w * r[0]);
        }
        let Some(solution) = normal.cholesky().map(|c| c.solve(&right)) else { return Ok(Exponents::NONE) };
        let change = (solution - coefficients).amax();
        coefficients = solution;
        let mut sizes: Vec<f64> = rows.iter().map(|r| residual(r, &coefficients).abs()).collect();
        let middle = sizes.len() / 2;
        scale = (1.4826 * *sizes.select_nth_unstable_by(middle, f64::total_cmp).1).max(1e-6);
        if change < 1e-5 {
            break;
        }
    }
    Ok(Exponents { range: coefficients[1].clamp(-2.5, 0.0), incidence: coefficients[2].clamp(0.0, 1.5) })
}

/// The intensity as it would be at the median range and at normal incidence.
pub fn corrected(intensity: &[f32], ranges: &[f32], cosines: &[f32], exponents: &Exponents) -> Result<Vec<f32>> {
    check(intensity, ranges, cosines)?;
    let Some(reference) = median_range(ranges) else { return Ok(intensity.to_vec()) };
    let reference = f64::from(reference);
    let mut out: Vec<f32> = fresh(intensity.len());
    out.par_iter_mut().enumerate().with_min_len(4096).for_each(|(i, out)| {
        let range = f64::from(ranges[i]);
        let mut factor =
            if range > 0.0 && range.is_finite() { (range / reference).powf(-exponents.range) } else { 1.0 };
        if let Some(cosine) = cosines.get(i).filter(|c| c.is_finite()) {
            factor *= f64::from(*cosine).abs().max(LEAST_COSINE).powf(-exponents.incidence);
        }
        *out = (f64::from(intensity[i]) * factor) as f32;
    });
    Ok(out)
}

/// Of the positive, finite ranges the middle one. The bits of positive floats are in the numbers' order: a histogram of their
/// upper half leaves few to be looked at.
fn median_range(ranges: &[f32]) -> Option<f32> {
    const DROPPED: u32 = 16;
    let usable = |r: &&f32| **r > 0.0 && r.is_finite();
    let bin = |r: &f32| (r.to_bits() >> DROPPED) as usize;
    let counts = ranges
        .par_chunks(1 << 20)
        .map(|part| {
            let mut counts = vec![0usize; 1 << (31 - DROPPED)];
            part.iter().filter(usable).for_each(|r| counts[bin(r)] += 1);
            counts
        })
        .reduce_with(|a, b| a.iter().zip(&b).map(|(a, b)| a + b).collect())?;
    let mut rank = counts.iter().sum::<usize>() / 2;
    let middle = counts.iter().position(|&count| {
        let within = rank < count;
        rank -= if within { 0 } else { count };
        within
    })?;
    let mut bin: Vec<f32> = ranges.par_iter().filter(usable).filter(|r| bin(r) == middle).copied().collect();
    Some(*bin.select_nth_unstable_by(rank, f32::total_cmp).1)
}

fn check(intensity: &[f32], ranges: &[f32], cosines: &[f32]) -> Result<()> {
    let n = intensity.len();
    if ranges.len() != n || !(cosines.is_empty() || cosines.len() == n) {
        return Err(Error::invalid(format!(
            "{n} intensities have {} ranges and {} cosines of incidence",
            ranges.len(),
            cosines.len()
        )));
    }
    Ok(())
}

/// Grey values by rank: every grey is used equally often. NaN becomes 0, and so does the lowest value.
///
/// Found from a histogram of the values' order-preserving bits, so that it costs two passes and no sort.
pub fn stretched_by_rank(values: &[f32], top: u16) -> Vec<u16> {
    const BITS: u32 = 18;
    // Of finite floats the bits, with the sign folded, are in the numbers' order; the upper 18 keep 9 of the mantissa.
    let key = |v: f32| {
        let bits = v.to_bits();
        ((if bits >> 31 == 1 { !bits } else { bits | 1 << 31 }) >> (32 - BITS)) as usize
    };
    let block = values.len().div_ceil(16).max(1 << 16);
    let counts = values
        .par_chunks(block)
        .map(|part| {
            let mut counts = vec![0u32; 1 << BITS];
            for v in part.iter().filter(|v| !v.is_nan()) {
                counts[key(*v)] += 1;
            }
            counts
        })
        .reduce_with(|mut a, b| {
            for (a, b) in a.iter_mut().zip(b) {
                *a += b;
            }
            a
        })
        .unwrap_or_default();
    let total: u64 = counts.iter().map(|c| u64::from(*c)).sum();
    let mut below = 0u64;
    let table: Vec<u16> = counts
        .iter()
        .map(|c| {
            // The middle of the bin's ranks.
            let rank = 2 * below + u64::from(*c).saturating_sub(1);
            below += u64::from(*c);
            let most = 2 * total.saturating_sub(1).max(1);
            ((rank * u64::from(top) + most / 2) / most) as u16
        })
        .collect();
    values.par_iter().with_min_len(4096).map(|v| if v.is_nan() { 0 } else { table[key(*v)] }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn noise(i: usize) -> f64 {
        ((i as f64 * 12.9898).sin() * 43758.5453).fract().abs()
    }

    fn scene(range_power: f64, incidence_power: f64) -> (Vec<f32>, Vec<f32>, Vec<f32>, Vec<f64>) {
        let n = 20_000;
        let ranges: Vec<f32> = (0..n).map(|i| (5.0 + 45.0 * noise(i)) as f32).collect();
        let cosines: Vec<f32> = (0..n).map(|i| (0.15 + 0.85 * noise(i + 31_000)) as f32).collect();
        // Materials between 0.1 and 0.9, and every twentieth point a retroreflecting sign.
        let albedo: Vec<f64> = (0..n).map(|i| 0.1 + 0.8 * noise(i + 77_000)).collect();
        let values = (0..n)
            .map(|i| {
                let sign = if i % 20 == 0 { 30.0 } else { 1.0 };
                let (r, c) = (f64::from(ranges[i]), f64::from(cosines[i]));
                (1e5 * albedo[i] * sign * r.powf(range_power) * c.powf(incidence_power)) as f32
            })
            .collect();
        (values, ranges, cosines, albedo)
    }

    #[test]
    fn the_law_is_found_and_taken_off() {
        for (by_range, by_incidence) in [(-2.0, 1.0), (-1.3, 0.4), (0.0, 0.0)] {
            let (values, ranges, cosines, albedo) = scene(by_range, by_incidence);
            let found = fit_exponents(&values, &ranges, &cosines).unwrap();
            assert!((found.range - by_range).abs() < 0.05, "{found:?}");
            assert!((found.incidence - by_incidence).abs() < 0.05, "{found:?}");
            let flat = corrected(&values, &ranges, &cosines, &found).unwrap();
            let ratios: Vec<f64> =
                (0..flat.len()).filter(|i| i % 20 != 0).map(|i| (f64::from(flat[i]) / albedo[i]).ln()).collect();
            let mean = ratios.iter().sum::<f64>() / ratios.len() as f64;
            let spread = (ratios.iter().map(|r| (r - mean).powi(2)).sum::<f64>() / ratios.len() as f64).sqrt();
            assert!(spread < 0.05, "{spread}");
        }
    }

    #[test]
    fn the_median_range_is_that_of_the_sorted_ones() {
        for n in [0, 1, 2, 1001, 4000] {
            let mut ranges: Vec<f32> = (0..n).map(|i| (5.0 + 45.0 * noise(i)) as f32).collect();
            let mut sorted = ranges.clone();
            sorted.sort_by(f32::total_cmp);
            ranges.extend([f32::NAN, f32::INFINITY, 0.0, -1.0]);
            assert_eq!(median_range(&ranges), sorted.get(n / 2).copied());
        }
    }

    #[test]
    fn without_normals_the_range_alone_is_corrected() {
        let (values, ranges, _, _) = scene(-2.0, 0.0);
        let found = fit_exponents(&values, &ranges, &[]).unwrap();
        assert!((found.range + 2.0).abs() < 0.05 && found.incidence == 0.0, "{found:?}");
    }

    #[test]
    fn ranks_use_every_grey_equally_and_keep_the_order() {
        let values: Vec<f32> = (0..50_000).map(|i| (8.0 * noise(i)).exp() as f32 - 3.0).collect();
        let grey = stretched_by_rank(&values, 255);
        let mut counts = [0; 256];
        grey.iter().for_each(|g| counts[usize::from(*g)] += 1);
        assert!(counts[1..255].iter().all(|c| (100..300).contains(c)), "{counts:?}");
        for i in 0..values.len() - 1 {
            if values[i] < values[i + 1] {
                assert!(grey[i] <= grey[i + 1]);
            }
        }
        assert_eq!(stretched_by_rank(&[f32::NAN, 1.0, 2.0, 3.0], 65535), [0, 0, 32768, 65535]);
        assert!(stretched_by_rank(&[], 255).is_empty());
    }
}
