//! The larger and the smaller of two numbers, each a single instruction in loops over many samples: `f32::max` and
//! `f32::min` take further ones for what they promise of NaN. Where one of the two is NaN, the second is the answer.

#[inline(always)]
pub(super) fn larger(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

#[inline(always)]
pub(super) fn smaller(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}
