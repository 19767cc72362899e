//! Bilinear colours of a block of positions in a photo of 8 bits: what [`super::sampling::Photo::sample`] gives, bit for
//! bit, with the places worked out for the whole block and each point's four pixels in one register.
#![cfg(target_arch = "x86_64")]

use std::arch::x86_64::*;

use crate::geometry::LANES;

/// How far ahead of their use the pixels of a photo are fetched.
const AHEAD: usize = 16;

/// Where the positions of a block lie among the pixels.
pub(super) struct Places {
    /// The pixel at or left of and above a position.
    pixel: [u32; LANES],
    /// How far the position lies right of it, and below.
    part: [[f32; LANES]; 2],
}

impl Places {
    #[inline(always)]
    fn new(x: &[f64; LANES], y: &[f64; LANES], width: usize, height: usize) -> Self {
        let mut this = Self { pixel: [0; LANES], part: [[0.0; LANES]; 2] };
        let (last_x, last_y) = ((width - 1) as f64, (height - 1) as f64);
        // Comparisons that turn NaN into 0.
        let within = |v: f64, last: f64| {
            let v = if v > 0.0 { v } else { 0.0 };
            if v < last { v } else { last }
        };
        for i in 0..LANES {
            let (x, y) = (within(x[i], last_x), within(y[i], last_y));
            // SAFETY: both are between 0 and the sides of a photo, whose pixels can be counted in an i32.
            let (left, top) = unsafe { (x.to_int_unchecked::<i32>(), y.to_int_unchecked::<i32>()) };
            this.pixel[i] = top as u32 * width as u32 + left as u32;
            this.part[0][i] = (x - f64::from(left)) as f32;
            this.part[1][i] = (y - f64::from(top)) as f32;
        }
        this
    }
}

/// Calls `put(i, colour)` for the points that `seen` knows, and `edge(i)` for those whose pixels lie too near to the end of
/// the photo to be read in one go; the colours on the 16-bit scale, with a fourth number without meaning.
///
/// # Safety
/// The processor has AVX2. `width` × `height` is the number of the pixels, of which there is at least one and
/// whose bytes can be counted in an i32.
#[target_feature(enable = "avx2")]
pub(super) unsafe fn each(
    values: &[[u8; 3]],
    [width, height]: [usize; 2],
    [x, y]: [&[f64; LANES]; 2],
    seen: impl Fn(usize) -> bool,
    mut put: impl FnMut(usize, __m128),
    mut edge: impl FnMut(usize),
) {
    let places = Places::new(x, y, width, height);
    let bytes = values.as_ptr().cast::<u8>();
    // Eight bytes are read from the pixel below on: it, the one beside it, and two bytes more.
    let end = values.len().saturating_sub(width + 3) as u32;
    // Above and below become the two halves of a register, left and right two registers.
    let order = _mm_setr_epi8(0, 1, 2, -1, 8, 9, 10, -1, 3, 4, 5, -1, 11, 12, 13, -1);
    for i in 0..LANES {
        let next = (i + AHEAD) % LANES;
        let at = 3 * places.pixel[next] as usize;
        _mm_prefetch::<_MM_HINT_T0>(bytes.wrapping_add(at).cast());
        _mm_prefetch::<_MM_HINT_T0>(bytes.wrapping_add(at + 3 * width).cast());
        if !seen(i) {
            continue;
        }
        if places.pixel[i] >= end {
            edge(i);
            continue;
        }
        let at = 3 * places.pixel[i] as usize;
        // SAFETY: below `end` eight bytes of this row and of the next lie in the photo. Beside the last pixel of a row
        // stands the first of the next row, which then counts nothing.
        let (above, below) =
            unsafe { (_mm_loadl_epi64(bytes.add(at).cast()), _mm_loadl_epi64(bytes.add(at + 3 * width).cast())) };
        let both = _mm_shuffle_epi8(_mm_unpacklo_epi64(above, below), order);
        let left = _mm256_cvtepi32_ps(_mm256_cvtepu8_epi32(both));
        let right = _mm256_cvtepi32_ps(_mm256_cvtepu8_epi32(_mm_unpackhi_epi64(both, both)));
        let (tx, ty) = (_mm256_set1_ps(places.part[0][i]), _mm_set1_ps(places.part[1][i]));
        let rows = _mm256_add_ps(left, _mm256_mul_ps(tx, _mm256_sub_ps(right, left)));
        let (upper, lower) = (_mm256_castps256_ps128(rows), _mm256_extractf128_ps::<1>(rows));
        let colour = _mm_add_ps(upper, _mm_mul_ps(ty, _mm_sub_ps(lower, upper)));
        // A power of two: as if every pixel had been multiplied by it.
        put(i, _mm_mul_ps(colour, _mm_set1_ps(256.0)));
    }
}

/// To the nearest 16-bit values.
#[inline]
#[target_feature(enable = "avx2")]
pub(super) fn rounded(colour: __m128) -> [u16; 3] {
    let whole = _mm_cvttps_epi32(_mm_add_ps(colour, _mm_set1_ps(0.5)));
    let bits = _mm_cvtsi128_si64(_mm_packus_epi32(whole, whole)) as u64;
    [bits as u16, (bits >> 16) as u16, (bits >> 32) as u16]
}

/// The first three numbers.
#[inline]
#[target_feature(enable = "avx2")]
pub(super) fn numbers(colour: __m128) -> [f32; 3] {
    let mut four = [0.0_f32; 4];
    // SAFETY: there is room for four numbers.
    unsafe { _mm_storeu_ps(four.as_mut_ptr(), colour) };
    [four[0], four[1], four[2]]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::colour::{Interpolation, Photo, Pixels};

    #[test]
    fn gives_the_bits_of_one_position_at_a_time_up_to_the_photos_corners() {
        if !std::arch::is_x86_feature_detected!("avx2") {
            return;
        }
        let mut state = 7_u32;
        let mut random = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            state >> 8
        };
        for [width, height] in [[40, 30], [7, 2], [1, 9], [3, 1], [1, 1]] {
            let values: Vec<[u8; 3]> =
                (0..width * height).map(|_| std::array::from_fn(|_| (random() >> 7) as u8)).collect();
            let photo = Photo::new(Pixels::U8(&values), width, height, false).unwrap();
            let mut place = |size: usize| f64::from(random()) / f64::from(1 << 24) * size as f64 - 0.5;
            let (mut x, mut y) = ([f64::NAN; LANES], [f64::NAN; LANES]);
            for i in 0..LANES - 2 {
                (x[i], y[i]) = (place(width), place(height));
                // Also the pixels' centres, those of the corners among them.
                if i % 3 == 0 {
                    (x[i], y[i]) = (x[i].round(), y[i].round());
                }
            }
            let one = |i: usize| photo.sample([x[i], y[i]], Interpolation::Bilinear);
            let (mut found, mut edges) = (Vec::new(), Vec::new());
            // SAFETY: the processor has the feature, and the pixels are so many.
            unsafe {
                let put = |i, colour| found.push((i, numbers(colour), super::rounded(colour)));
                each(&values, [width, height], [&x, &y], |i| i < LANES - 2, put, |i| edges.push(i));
            }
            assert_eq!(found.len() + edges.len(), LANES - 2);
            assert!(width * height < 100 || found.len() > 150, "{width} {height}");
            for (i, colour, whole) in found {
                assert_eq!(colour.map(f32::to_bits), one(i).map(f32::to_bits), "{} {}", x[i], y[i]);
                assert_eq!(whole, crate::colour::sampling::rounded(one(i)));
            }
        }
    }
}
