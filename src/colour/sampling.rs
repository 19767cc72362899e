//! The colour of a photo at a position between its pixels, in 16 bit: 8-bit values times 256, the fraction kept.
//!
//! Positions are pixel coordinates with (0, 0) at the centre of the top-left pixel, so that at whole numbers the
//! result is the pixel itself. Within half a pixel of the border the border's own pixels count; a panorama goes on at
//! its other side.

use crate::error::{Error, Result};
use crate::geometry::LANES;
use crate::render::fetch;

/// How far ahead of their use the pixels of a photo are fetched.
const AHEAD: usize = 16;

/// How to go between pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Interpolation {
    /// From the nearest four.
    Bilinear,
    /// From the nearest sixteen, by cubic convolution with a = −1/2 (Keys, Cubic convolution interpolation for digital
    /// image processing, 1981): sharper, exact for parabolas, may overshoot at edges and is then cut off.
    Bicubic,
}

impl Interpolation {
    /// By its name.
    pub fn from_name(name: &str) -> Result<Self> {
        match name {
            "bilinear" => Ok(Self::Bilinear),
            "bicubic" => Ok(Self::Bicubic),
            _ => Err(Error::invalid(format!("there is no sampling {name:?}; there are bilinear and bicubic"))),
        }
    }
}

/// The values of a photo, row by row, red green blue.
#[derive(Debug, Clone, Copy)]
pub enum Pixels<'a> {
    /// 8 bit.
    U8(&'a [[u8; 3]]),
    /// 16 bit.
    U16(&'a [[u16; 3]]),
}

/// A photo in memory.
#[derive(Debug, Clone, Copy)]
pub struct Photo<'a> {
    pixels: Pixels<'a>,
    width: usize,
    height: usize,
    wraps: bool,
}

trait Value: Copy {
    /// On the 16-bit scale.
    fn wide(self) -> f32;

    /// A pixel on the 16-bit scale. A fourth number fills the register; it has no meaning.
    #[inline(always)]
    fn pixel(values: &[[Self; 3]], i: usize) -> [f32; 4] {
        let numbers = values.as_flattened();
        match numbers[3 * i..].first_chunk::<4>() {
            Some(four) => std::array::from_fn(|k| four[k].wide()),
            None => std::array::from_fn(|k| if k < 3 { numbers[3 * i + k].wide() } else { 0.0 }),
        }
    }
}

impl Value for u8 {
    #[inline(always)]
    fn wide(self) -> f32 {
        f32::from(self) * 256.0
    }
}

impl Value for u16 {
    #[inline(always)]
    fn wide(self) -> f32 {
        f32::from(self)
    }
}

impl<'a> Photo<'a> {
    /// A photo of `width` pixels in a row; `wraps` for a panorama.
    pub fn new(pixels: Pixels<'a>, width: usize, height: usize, wraps: bool) -> Result<Self> {
        let n = match pixels {
            Pixels::U8(values) => values.len(),
            Pixels::U16(values) => values.len(),
        };
        if width == 0 || height == 0 || n != width * height {
            return Err(Error::invalid(format!("{n} pixels are no photo of {width} × {height}")));
        }
        Ok(Self { pixels, width, height, wraps })
    }

    /// Pixels in a row.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Rows.
    pub fn height(&self) -> usize {
        self.height
    }

    /// The pixels, width and height where the photo has 8 bits and two sides, and is to be read bilinearly.
    #[cfg(target_arch = "x86_64")]
    pub(super) fn simple(&self, interpolation: Interpolation) -> Option<(&'a [[u8; 3]], [usize; 2])> {
        match (self.pixels, interpolation) {
            (Pixels::U8(values), Interpolation::Bilinear) if !self.wraps && values.len() <= i32::MAX as usize / 3 => {
                Some((values, [self.width, self.height]))
            }
            _ => None,
        }
    }

    /// Calls `put(i, colour)` for the positions of a block that `at` knows, colours as [`Photo::sample`] gives them: one
    /// loop for each kind of photo, which has to ask for nothing on the way.
    #[inline(always)]
    pub fn sample_each(
        &self,
        interpolation: Interpolation,
        at: impl Fn(usize) -> Option<[f64; 2]>,
        put: impl FnMut(usize, [f32; 3]),
    ) {
        match (self.pixels, interpolation) {
            (Pixels::U8(values), Interpolation::Bilinear) => self.each::<u8, false>(values, at, put),
            (Pixels::U16(values), Interpolation::Bilinear) => self.each::<u16, false>(values, at, put),
            (Pixels::U8(values), Interpolation::Bicubic) => self.each::<u8, true>(values, at, put),
            (Pixels::U16(values), Interpolation::Bicubic) => self.each::<u16, true>(values, at, put),
        }
    }

    #[inline(always)]
    fn each<T: Value, const CUBIC: bool>(
        &self,
        values: &[[T; 3]],
        at: impl Fn(usize) -> Option<[f64; 2]>,
        mut put: impl FnMut(usize, [f32; 3]),
    ) {
        for i in 0..LANES {
            if let Some([x, y]) = at((i + AHEAD) % LANES) {
                let pixel = (y.max(0.0) as u32).wrapping_mul(self.width as u32).wrapping_add(x.max(0.0) as u32);
                fetch(values, pixel);
                fetch(values, pixel.wrapping_add(self.width as u32));
            }
            if let Some(xy) = at(i) {
                put(i, if CUBIC { self.bicubic(values, xy) } else { self.bilinear(values, xy) });
            }
        }
    }

    /// The colour at a position inside the photo, on the 16-bit scale.
    #[inline(always)]
    pub fn sample(&self, xy: [f64; 2], interpolation: Interpolation) -> [f32; 3] {
        match (self.pixels, interpolation) {
            (Pixels::U8(values), Interpolation::Bilinear) => self.bilinear(values, xy),
            (Pixels::U16(values), Interpolation::Bilinear) => self.bilinear(values, xy),
            (Pixels::U8(values), Interpolation::Bicubic) => self.bicubic(values, xy),
            (Pixels::U16(values), Interpolation::Bicubic) => self.bicubic(values, xy),
        }
    }

    /// The pixel at or left of a position, the one right of it, and how far the position lies between them.
    #[inline(always)]
    fn between(&self, x: f64) -> (usize, usize, f32) {
        let last = (self.width - 1) as f64;
        if self.wraps && (x < 0.0 || x > last) {
            let t = if x < 0.0 { x + 1.0 } else { x - last };
            return (self.width - 1, 0, t as f32);
        }
        let x = x.clamp(0.0, last);
        let left = x as usize;
        (left, (left + 1).min(self.width - 1), (x - left as f64) as f32)
    }

    #[inline(always)]
    fn bilinear<T: Value>(&self, values: &[[T; 3]], [x, y]: [f64; 2]) -> [f32; 3] {
        let (left, right, tx) = self.between(x);
        let y = y.clamp(0.0, (self.height - 1) as f64);
        let top = y as usize;
        let ty = (y - top as f64) as f32;
        let (above, below) = (top * self.width, (top + 1).min(self.height - 1) * self.width);
        let (a, b) = (T::pixel(values, above + left), T::pixel(values, above + right));
        let (c, d) = (T::pixel(values, below + left), T::pixel(values, below + right));
        let mut colour = [0.0_f32; 4];
        for k in 0..4 {
            let upper = a[k] + tx * (b[k] - a[k]);
            let lower = c[k] + tx * (d[k] - c[k]);
            colour[k] = upper + ty * (lower - upper);
        }
        let [red, green, blue, _] = colour;
        [red, green, blue]
    }

    fn bicubic<T: Value>(&self, values: &[[T; 3]], [x, y]: [f64; 2]) -> [f32; 3] {
        let column = |i: isize| {
            let w = self.width as isize;
            if self.wraps { i.rem_euclid(w) as usize } else { i.clamp(0, w - 1) as usize }
        };
        let x = if self.wraps { x } else { x.clamp(0.0, (self.width - 1) as f64) };
        let y = y.clamp(0.0, (self.height - 1) as f64);
        let (left, top) = (x.floor(), y.floor());
        let (wx, wy) = (cubic_weights((x - left) as f32), cubic_weights((y - top) as f32));
        let mut sum = [0.0_f32; 3];
        for (j, wy) in wy.iter().enumerate() {
            let row = (top as isize + j as isize - 1).clamp(0, self.height as isize - 1) as usize * self.width;
            for (i, wx) in wx.iter().enumerate() {
                let value = values[row + column(left as isize + i as isize - 1)];
                for (sum, value) in sum.iter_mut().zip(value) {
                    *sum += wx * wy * value.wide();
                }
            }
        }
        sum.map(|v| v.clamp(0.0, 65535.0))
    }
}

/// The weights of the pixels at −1, 0, 1, 2 for a position `t` in [0, 1).
#[inline(always)]
fn cubic_weights(t: f32) -> [f32; 4] {
    let (t2, t3) = (t * t, t * t * t);
    [-0.5 * t + t2 - 0.5 * t3, 1.0 - 2.5 * t2 + 1.5 * t3, 0.5 * t + 2.0 * t2 - 1.5 * t3, -0.5 * t2 + 0.5 * t3]
}

/// To the nearest 16-bit value.
#[inline(always)]
pub(super) fn rounded(colour: [f32; 3]) -> [u16; 3] {
    colour.map(|v| (v + 0.5) as u16)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ramp(width: usize, height: usize) -> Vec<[u8; 3]> {
        (0..width * height).map(|i| [(i % width * 3) as u8, (i / width * 5) as u8, 255]).collect()
    }

    #[test]
    fn is_exact_at_pixel_centres_and_clamps_within_half_a_pixel_of_the_border() {
        let values = ramp(40, 30);
        let photo = Photo::new(Pixels::U8(&values), 40, 30, false).unwrap();
        for interpolation in [Interpolation::Bilinear, Interpolation::Bicubic] {
            for (x, y) in [(0, 0), (39, 29), (17, 4), (39, 0), (3, 28)] {
                let expected = values[y * 40 + x].map(|v| u16::from(v) * 256);
                assert_eq!(rounded(photo.sample([x as f64, y as f64], interpolation)), expected);
            }
            assert_eq!(photo.sample([-0.5, -0.4], interpolation), photo.sample([0.0, 0.0], interpolation));
            assert_eq!(photo.sample([39.49, 29.3], interpolation), photo.sample([39.0, 29.0], interpolation));
        }
    }

    #[test]
    fn keeps_fractions_without_bias() {
        let values = ramp(40, 30);
        let photo = Photo::new(Pixels::U8(&values), 40, 30, false).unwrap();
        for interpolation in [Interpolation::Bilinear, Interpolation::Bicubic] {
            for i in 0..100 {
                let (x, y) = (2.0 + 0.35 * f64::from(i), 1.5 + 0.26 * f64::from(i));
                let [r, g, b] = photo.sample([x, y], interpolation);
                assert!((f64::from(r) - 768.0 * x).abs() < 0.05, "{r} {x}");
                assert!((f64::from(g) - 1280.0 * y).abs() < 0.05, "{g} {y}");
                assert!((b - 65280.0).abs() < 0.05);
            }
        }
    }

    #[test]
    fn a_panorama_goes_on_at_its_other_side() {
        let values: Vec<[u16; 3]> = (0..8 * 4).map(|i| [if i % 8 == 7 { 1000 } else { 0 }; 3]).collect();
        let photo = Photo::new(Pixels::U16(&values), 8, 4, true).unwrap();
        assert_eq!(photo.sample([-0.25, 1.0], Interpolation::Bilinear)[0], 250.0);
        assert_eq!(photo.sample([7.25, 1.0], Interpolation::Bilinear)[0], 750.0);
        let [left, right] = [-0.25, 7.75].map(|x| photo.sample([x, 2.0], Interpolation::Bicubic)[0]);
        assert!((left - right).abs() < 1e-3 && left > 200.0);
        let flat = Photo::new(Pixels::U16(&values), 8, 4, false).unwrap();
        assert_eq!(flat.sample([-0.25, 1.0], Interpolation::Bilinear)[0], 0.0);
    }

    #[test]
    fn bicubic_follows_a_parabola() {
        let values: Vec<[u16; 3]> = (0..20 * 6).map(|i| [(i % 20 * (i % 20) * 100) as u16; 3]).collect();
        let photo = Photo::new(Pixels::U16(&values), 20, 6, false).unwrap();
        for i in 0..50 {
            let x = 2.0 + 0.3 * f64::from(i);
            let v = f64::from(photo.sample([x, 2.6], Interpolation::Bicubic)[0]);
            assert!((v - 100.0 * x * x).abs() < 0.02, "{x} {v}");
        }
    }
}
