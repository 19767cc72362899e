//! Painted textures: five channels (red, green, blue, near infrared, opacity) with their pyramid.

/// A painted texture; red, green and blue are sRGB-coded, near infrared and opacity linear.
#[derive(Clone, Debug)]
pub struct Painting {
    levels: Vec<Level>,
}

#[derive(Clone, Debug)]
struct Level {
    width: usize,
    height: usize,
    /// Linear values, row by row from the top.
    texels: Vec<[f32; 5]>,
}

/// sRGB code value in [0, 1] to linear light.
pub fn srgb_to_linear(code: f32) -> f32 {
    if code <= 0.040_45 { code / 12.92 } else { ((code + 0.055) / 1.055).powf(2.4) }
}

impl Painting {
    /// The painting of `height` rows of `width` texels; `None` unless `bytes` holds exactly 5 of each.
    pub fn new(bytes: &[u8], width: usize, height: usize) -> Option<Self> {
        if width == 0 || height == 0 || bytes.len() != width * height * 5 {
            return None;
        }
        let code: Vec<f32> = (0..=255u8).map(|c| srgb_to_linear(f32::from(c) / 255.0)).collect();
        let texels = bytes
            .chunks_exact(5)
            .map(|t| {
                let light = |i: usize| code[usize::from(t[i])];
                [light(0), light(1), light(2), f32::from(t[3]) / 255.0, f32::from(t[4]) / 255.0]
            })
            .collect();
        let mut levels = vec![Level { width, height, texels }];
        while let Some(next) = levels.last().and_then(Level::halved) {
            levels.push(next);
        }
        Some(Self { levels })
    }

    /// The value at (s, t) in [0, 1]², t downwards from the top, under a footprint of so many texels.
    pub fn sample(&self, s: f32, t: f32, footprint: f32) -> [f32; 5] {
        let level = footprint.max(1.0).log2().min((self.levels.len() - 1) as f32);
        let (below, part) = (level.floor(), level - level.floor());
        let fine = self.levels[below as usize].bilinear(s, t);
        match self.levels.get(below as usize + 1) {
            Some(coarse) if part > 0.0 => {
                let coarse = coarse.bilinear(s, t);
                std::array::from_fn(|i| fine[i] + part * (coarse[i] - fine[i]))
            }
            _ => fine,
        }
    }

    /// Width and height in texels.
    pub fn size(&self) -> (usize, usize) {
        (self.levels[0].width, self.levels[0].height)
    }
}

impl Level {
    fn at(&self, x: isize, y: isize) -> &[f32; 5] {
        let x = x.clamp(0, self.width as isize - 1) as usize;
        let y = y.clamp(0, self.height as isize - 1) as usize;
        &self.texels[y * self.width + x]
    }

    fn bilinear(&self, s: f32, t: f32) -> [f32; 5] {
        let (x, y) = (s * self.width as f32 - 0.5, t * self.height as f32 - 0.5);
        let (i, j) = (x.floor(), y.floor());
        let (a, b) = (x - i, y - j);
        let (i, j) = (i as isize, j as isize);
        let (p, q, r, w) = (self.at(i, j), self.at(i + 1, j), self.at(i, j + 1), self.at(i + 1, j + 1));
        std::array::from_fn(|c| (p[c] * (1.0 - a) + q[c] * a) * (1.0 - b) + (r[c] * (1.0 - a) + w[c] * a) * b)
    }

    fn halved(&self) -> Option<Self> {
        if self.width == 1 && self.height == 1 {
            return None;
        }
        let (width, height) = (self.width.div_ceil(2), self.height.div_ceil(2));
        let mut texels = Vec::with_capacity(width * height);
        for y in 0..height as isize {
            for x in 0..width as isize {
                let four = [
                    self.at(2 * x, 2 * y),
                    self.at(2 * x + 1, 2 * y),
                    self.at(2 * x, 2 * y + 1),
                    self.at(2 * x + 1, 2 * y + 1),
                ];
                texels.push(std::array::from_fn(|c| 0.25 * four.iter().map(|t| t[c]).sum::<f32>()));
            }
        }
        Some(Self { width, height, texels })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texel_centres_give_their_value_and_the_top_of_the_pyramid_the_mean() {
        let bytes: Vec<u8> = (0..4 * 2).flat_map(|i| [0, 0, 0, (i * 20) as u8, 255]).collect();
        let painting = Painting::new(&bytes, 4, 2).unwrap();
        assert!((painting.sample(0.375, 0.75, 0.1)[3] - 100.0 / 255.0).abs() < 1e-6);
        assert!((painting.sample(0.2, 0.9, 100.0)[3] - 70.0 / 255.0).abs() < 1e-6);
        assert!(Painting::new(&bytes, 4, 3).is_none());
    }
}
