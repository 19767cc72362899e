//! What a cell of a depth buffer keeps of its nearest point, in 32 bits: 22 of inverse depth, five each for where in the
//! pixel the point lies.
//!
//! The inverse depth stands above, so that the larger number is the nearer point, and 0 is an empty cell. It is kept to
//! 4·10⁻⁶ of itself (0.1 mm at 30 m), for depths between 2⁻¹² and 2²⁰ of the cloud's unit; what lies beyond counts as
//! lying there.

use crate::memory::Zeroed;

/// The largest inverse depth.
const NEAREST: f32 = 4095.9;
/// The smallest inverse depth, one step above 2⁻²⁰ so that nothing is coded as 0.
const FARTHEST: f32 = 9.536_816e-7;
/// The bits of 2⁻²⁰.
const BASE: u32 = 107 << 23;
/// Bits of a position in the pixel, on each axis.
const PLACE: u32 = 5;
/// Steps in a pixel.
const STEPS: f32 = (1 << PLACE) as f32;
/// Bits of a float's mantissa that are dropped.
const DROPPED: u32 = 32 - 2 * PLACE - 16;

/// A cell's content.
#[repr(transparent)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default)]
pub struct Sample(pub u32);

// SAFETY: all bits zero is an empty cell.
unsafe impl Zeroed for Sample {}

impl Sample {
    /// From an inverse depth and a place in the pixel, right and down, in [0, 1]. The nearer of two is the larger; of
    /// equal depths the one that lies farther right, then farther down.
    #[inline(always)]
    pub fn new(inverse_depth: f32, [right, down]: [f32; 2]) -> Self {
        let depth = (clamped(inverse_depth).to_bits() - BASE) >> DROPPED;
        let place = |part: f32| ((part * STEPS) as u32).min((1 << PLACE) - 1);
        Self(depth << (2 * PLACE) | place(right) << PLACE | place(down))
    }

    /// Whether there is a point.
    #[inline(always)]
    pub fn found(self) -> bool {
        self.0 != 0
    }

    /// In the middle of its step; something tiny for an empty cell.
    #[inline(always)]
    pub fn inverse_depth(self) -> f32 {
        f32::from_bits(((self.0 >> (2 * PLACE)) << DROPPED | 1 << (DROPPED - 1)) + BASE)
    }

    /// The bits of the inverse depths of eight samples.
    #[cfg(target_arch = "x86_64")]
    #[inline]
    #[target_feature(enable = "avx2")]
    pub(super) fn inverse_depth_bits(samples: std::arch::x86_64::__m256i) -> std::arch::x86_64::__m256i {
        use std::arch::x86_64::*;
        let steps = _mm256_slli_epi32::<{ DROPPED as i32 }>(_mm256_srli_epi32::<{ 2 * PLACE as i32 }>(samples));
        let middle = _mm256_or_si256(steps, _mm256_set1_epi32(1 << (DROPPED - 1)));
        _mm256_add_epi32(middle, _mm256_set1_epi32(BASE as i32))
    }

    /// The places of eight samples, right and down.
    #[cfg(target_arch = "x86_64")]
    #[inline]
    #[target_feature(enable = "avx2")]
    pub(super) fn places(samples: std::arch::x86_64::__m256i) -> [std::arch::x86_64::__m256; 2] {
        use std::arch::x86_64::*;
        let (mask, step) = (_mm256_set1_epi32((1 << PLACE) - 1), _mm256_set1_ps(1.0 / STEPS));
        let first = _mm256_set1_ps(0.5 / STEPS - 0.5);
        let right = _mm256_cvtepi32_ps(_mm256_and_si256(_mm256_srli_epi32::<{ PLACE as i32 }>(samples), mask));
        let down = _mm256_cvtepi32_ps(_mm256_and_si256(samples, mask));
        [_mm256_add_ps(_mm256_mul_ps(right, step), first), _mm256_add_ps(_mm256_mul_ps(down, step), first)]
    }

    /// Which of eight samples are empty, the first in the lowest bit.
    #[inline(always)]
    pub(super) fn empty(samples: &[Self; 8]) -> u8 {
        // Of every processor of this kind; the compiler makes a long story of the loop below.
        #[cfg(target_arch = "x86_64")]
        {
            use std::arch::x86_64::*;
            let (first, second) = samples.split_at(4);
            // SAFETY: four samples each, of 32 bits.
            let four = |samples: &[Self]| unsafe {
                _mm_cmpeq_epi32(_mm_loadu_si128(samples.as_ptr().cast()), _mm_setzero_si128())
            };
            // SAFETY: every processor of this kind has it.
            let bits = unsafe {
                _mm_movemask_epi8(_mm_packs_epi16(_mm_packs_epi32(four(first), four(second)), _mm_setzero_si128()))
            };
            bits as u8
        }
        #[cfg(not(target_arch = "x86_64"))]
        samples.iter().enumerate().fold(0, |bits, (k, sample)| bits | u8::from(!sample.found()) << k)
    }

    /// The same sample in a pixel that stands on its head.
    pub(super) fn upside_down(self) -> Self {
        Self(if self.found() { self.0 ^ ((1 << PLACE) - 1) } else { 0 })
    }

    /// The same sample in the pixel of which its cell is one of `side` by `side` parts, so many from the left and the top.
    #[inline(always)]
    pub(super) fn of_pixel(self, [left, top]: [usize; 2], side: usize) -> Self {
        let part = |bits: u32, before: usize| ((bits & ((1 << PLACE) - 1)) + ((before as u32) << PLACE)) / side as u32;
        let place = part(self.0 >> PLACE, left) << PLACE | part(self.0, top);
        Self(if self.found() { self.0 >> (2 * PLACE) << (2 * PLACE) | place } else { 0 })
    }

    /// Where the point lies against the pixel's centre, right and down, in [−½, ½).
    #[inline(always)]
    pub fn place(self) -> [f32; 2] {
        let part = |bits: u32| ((bits & ((1 << PLACE) - 1)) as f32 + 0.5) / STEPS - 0.5;
        [part(self.0 >> PLACE), part(self.0)]
    }
}

/// An inverse depth within what a sample can keep: what is compared with samples has to pass here as they did.
#[inline(always)]
pub fn clamped(inverse_depth: f32) -> f32 {
    inverse_depth.clamp(FARTHEST, NEAREST)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keeps_depth_and_place_to_their_steps() {
        for i in 0..20_000 {
            let inverse = 2.0_f32.powf(-20.0 + 32.0 * (i as f32 + 0.5) / 20_000.0);
            let (right, down) = ((i % 97) as f32 / 97.0, (i % 89) as f32 / 89.0);
            let sample = Sample::new(inverse, [right, down]);
            assert!((sample.inverse_depth() / inverse - 1.0).abs() < 4.1e-6, "{inverse}");
            let [a, b] = sample.place();
            assert!((a + 0.5 - right).abs() <= 0.5 / STEPS + 1e-6 && (b + 0.5 - down).abs() <= 0.5 / STEPS + 1e-6);
            assert!(sample.found());
        }
    }

    #[test]
    fn eight_samples_say_which_are_empty() {
        for bits in 0..=255_u8 {
            let samples = std::array::from_fn(|k| Sample(if bits >> k & 1 == 1 { 0 } else { 1 << (k * 4 % 32) }));
            assert_eq!(Sample::empty(&samples), bits);
        }
    }

    #[test]
    fn the_nearer_is_the_larger_and_extremes_are_kept_within_range() {
        assert!(Sample::new(0.2, [0.0, 0.0]) > Sample::new(0.1999, [0.9, 0.9]));
        for inverse in [0.0, 1e-30, f32::MIN_POSITIVE, 1e30, f32::INFINITY] {
            let sample = Sample::new(inverse, [0.99, 0.99]);
            assert!(sample.found() && (FARTHEST * 0.999..4096.0).contains(&sample.inverse_depth()), "{inverse}");
        }
        assert!(!Sample::default().found());
    }
}
