//! Two-dimensional real Fourier transforms of one size, planned once and shared by all threads.

use std::sync::Arc;

use realfft::num_complex::Complex32;
use realfft::{ComplexToReal, RealFftPlanner, RealToComplex};
use rustfft::{Fft, FftPlanner};

use crate::error::{Error, Result};

/// A spectrum, column by column: that is how the second transform leaves it.
pub(super) type Spectrum = Vec<Complex32>;

pub(super) struct Fourier {
    pub width: usize,
    pub height: usize,
    columns: usize,
    forward_rows: Arc<dyn RealToComplex<f32>>,
    inverse_rows: Arc<dyn ComplexToReal<f32>>,
    forward_columns: Arc<dyn Fft<f32>>,
    inverse_columns: Arc<dyn Fft<f32>>,
}

impl Fourier {
    /// For pictures of at most this size; the transform's own size is the next one that is quick to transform.
    pub fn at_least(width: usize, height: usize) -> Self {
        let (width, height) = (quick_size(width, true), quick_size(height, false));
        let (mut rows, mut columns) = (RealFftPlanner::new(), FftPlanner::new());
        Self {
            width,
            height,
            columns: width / 2 + 1,
            forward_rows: rows.plan_fft_forward(width),
            inverse_rows: rows.plan_fft_inverse(width),
            forward_columns: columns.plan_fft_forward(height),
            inverse_columns: columns.plan_fft_inverse(height),
        }
    }

    /// A spectrum of zeros.
    pub fn zeros(&self) -> Spectrum {
        vec![Complex32::default(); self.columns * self.height]
    }

    /// The spectrum of `rows` rows, filled by `fill` into zeroed rows.
    pub fn forward(&self, rows: usize, mut fill: impl FnMut(usize, &mut [f32])) -> Result<Spectrum> {
        let mut spectrum = self.zeros();
        let mut line = vec![Complex32::default(); self.columns];
        let mut input = vec![0.0; self.width];
        let mut scratch = self.forward_rows.make_scratch_vec();
        for y in 0..rows.min(self.height) {
            input.fill(0.0);
            fill(y, &mut input);
            self.forward_rows
                .process_with_scratch(&mut input, &mut line, &mut scratch)
                .map_err(|e| Error::Internal(e.to_string()))?;
            for (x, v) in line.iter().enumerate() {
                spectrum[x * self.height + y] = *v;
            }
        }
        self.forward_columns.process(&mut spectrum);
        Ok(spectrum)
    }

    /// The first `rows` rows of the inverse transform, scaled so that it inverts [`Fourier::forward`].
    pub fn inverse(&self, mut spectrum: Spectrum, rows: usize) -> Result<Vec<f32>> {
        self.inverse_columns.process(&mut spectrum);
        let mut line = vec![Complex32::default(); self.columns];
        let mut scratch = self.inverse_rows.make_scratch_vec();
        let mut output = vec![0.0; self.width * rows];
        let scale = 1.0 / (self.width * self.height) as f32;
        for (y, out) in output.chunks_exact_mut(self.width).enumerate() {
            for (x, v) in line.iter_mut().enumerate() {
                *v = spectrum[x * self.height + y] * scale;
            }
            // Rounding leaves a trace of imaginary parts where a real signal has none.
            line[0].im = 0.0;
            if self.width.is_multiple_of(2) {
                line[self.columns - 1].im = 0.0;
            }
            self.inverse_rows
                .process_with_scratch(&mut line, out, &mut scratch)
                .map_err(|e| Error::Internal(e.to_string()))?;
        }
        Ok(output)
    }
}

/// `sum += conj(a) · b`: the spectrum of the cross-correlation Σ a(x) b(x + d).
pub(super) fn add_correlation(sum: &mut Spectrum, a: &Spectrum, b: &Spectrum) {
    for ((s, a), b) in sum.iter_mut().zip(a).zip(b) {
        *s += a.conj() * b;
    }
}

/// The spectrum of the cross-correlation Σ a(x) b(x + d).
pub(super) fn correlation(a: &Spectrum, b: &Spectrum) -> Spectrum {
    a.iter().zip(b).map(|(a, b)| a.conj() * b).collect()
}

/// The next size of the form 2^a · 3^b · 5^c.
fn quick_size(least: usize, even: bool) -> usize {
    let smooth = |mut n: usize| {
        for p in [2, 3, 5] {
            while n.is_multiple_of(p) {
                n /= p;
            }
        }
        n == 1
    };
    (least.max(2)..).find(|&n| smooth(n) && (!even || n.is_multiple_of(2))).unwrap_or(least)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn correlation_by_spectra_is_the_sum_of_products() {
        let fourier = Fourier::at_least(22, 17);
        let value = |x: usize, y: usize, k: usize| ((x * 31 + y * 17 + k * 7) % 13) as f32 - 6.0;
        let small = fourier.forward(5, |y, row| (0..6).for_each(|x| row[x] = value(x, y, 0))).unwrap();
        let large = fourier.forward(17, |y, row| (0..22).for_each(|x| row[x] = value(x, y, 1))).unwrap();
        let result = fourier.inverse(correlation(&small, &large), 13).unwrap();
        for dy in 0..13 {
            for dx in 0..17 {
                let mut sum = 0.0;
                for y in 0..5 {
                    for x in 0..6 {
                        sum += value(x, y, 0) * value(x + dx, y + dy, 1);
                    }
                }
                assert!((result[dy * fourier.width + dx] - sum).abs() < 1e-3);
            }
        }
    }
}
