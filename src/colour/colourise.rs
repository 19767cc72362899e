//! Colours for a chunk of points from all photos that see them.

use rayon::prelude::*;

#[cfg(target_arch = "x86_64")]
use super::bilinear;
use super::blending::{Blend, Sample};
use super::sampling::{Interpolation, Photo, rounded};
use super::visibility::{Sight, VisibilityMap};
use crate::error::{Error, Result};
use crate::geometry::LANES;

/// Points per task of the scheduler.
const TASK: usize = 16 * LANES;

/// Photos with what they see, ready to colour any number of chunks. What a point gets depends on that point alone.
pub struct Colourist<'a> {
    maps: Vec<&'a VisibilityMap>,
    photos: Vec<Photo<'a>>,
    gains: Option<Vec<[f32; 3]>>,
    interpolation: Interpolation,
    blend: Blend,
}

/// Where the results go: one row for each point.
pub struct Colours<'a> {
    /// 16 bit; untouched where no photo sees the point.
    pub rgb: &'a mut [[u16; 3]],
    /// The number of the photo, from 1, that gave the colour or the largest part of it; 0 where none sees the point.
    pub source: &'a mut [u16],
}

impl<'a> Colourist<'a> {
    /// From maps and photos in the same order, and gains for each photo and channel.
    pub fn new(
        maps: Vec<&'a VisibilityMap>,
        photos: Vec<Photo<'a>>,
        gains: Option<&[[f64; 3]]>,
        interpolation: Interpolation,
        blend: Blend,
    ) -> Result<Self> {
        if maps.is_empty() || maps.len() >= usize::from(u16::MAX) {
            return Err(Error::invalid(format!("{} photos cannot colour points: give 1 to 65534", maps.len())));
        }
        if maps.len() != photos.len() || gains.is_some_and(|gains| gains.len() != maps.len()) {
            return Err(Error::invalid(format!(
                "{} maps, {} photos and {} gains do not belong together",
                maps.len(),
                photos.len(),
                gains.map_or(maps.len(), <[_]>::len)
            )));
        }
        for (i, (map, photo)) in maps.iter().zip(&photos).enumerate() {
            let camera = &map.view().camera;
            if (photo.width(), photo.height()) != (camera.width as usize, camera.height as usize) {
                return Err(Error::invalid(format!(
                    "photo {} has {} × {} pixels, its camera {} × {}",
                    i + 1,
                    photo.width(),
                    photo.height(),
                    camera.width,
                    camera.height
                )));
            }
        }
        if let Some(gain) = gains.and_then(|gains| gains.iter().flatten().find(|g| !(g.is_finite() && **g > 0.0))) {
            return Err(Error::invalid(format!("a gain of {gain} is not possible")));
        }
        let gains = gains.map(|gains| gains.iter().map(|gain| gain.map(|g| g as f32)).collect());
        Ok(Self { maps, photos, gains, interpolation, blend })
    }

    /// Colours points; with normals (in the world frame) the best views are chosen by them.
    pub fn colour(&self, xyz: &[[f64; 3]], normals: Option<&[[f64; 3]]>, colours: Colours<'_>) -> Result<()> {
        let Colours { rgb, source } = colours;
        if rgb.len() != xyz.len() || source.len() != xyz.len() || normals.is_some_and(|n| n.len() != xyz.len()) {
            return Err(Error::invalid(format!(
                "{} points do not fit {} colours, {} sources and {} normals",
                xyz.len(),
                rgb.len(),
                source.len(),
                normals.map_or(xyz.len(), <[_]>::len)
            )));
        }
        let tasks = xyz.par_chunks(TASK).zip(rgb.par_chunks_mut(TASK)).zip(source.par_chunks_mut(TASK)).enumerate();
        tasks.for_each(|(task, ((points, rgb), source))| {
            source.fill(0);
            let meeting: Vec<usize> = (0..self.maps.len()).filter(|&v| self.maps[v].meets(points)).collect();
            if meeting.is_empty() {
                return;
            }
            let normals = normals.map(|normals| &normals[task * TASK..][..points.len()]);
            let mut scratch = Scratch { sight: Sight::new(), samples: vec![Vec::new(); LANES] };
            let blocks = points.chunks(LANES).zip(rgb.chunks_mut(LANES)).zip(source.chunks_mut(LANES)).enumerate();
            for (k, ((points, rgb), source)) in blocks {
                if self.maps.len() == 1 {
                    self.colour_by_one(0, points, &mut scratch.sight, rgb, source);
                } else {
                    let normals = normals.map(|normals| &normals[k * LANES..][..points.len()]);
                    self.colour_by_several(&meeting, points, normals, &mut scratch, rgb, source);
                }
            }
        });
        Ok(())
    }

    #[inline(always)]
    fn sample(&self, view: usize, xy: [f64; 2]) -> [f32; 3] {
        let colour = self.photos[view].sample(xy, self.interpolation);
        amplified(colour, self.gains.as_ref().map(|gains| &gains[view]))
    }

    fn colour_by_one(
        &self,
        view: usize,
        points: &[[f64; 3]],
        sight: &mut Sight,
        rgb: &mut [[u16; 3]],
        source: &mut [u16],
    ) {
        self.maps[view].look(points, sight);
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") {
            if let Some((values, size)) = self.photos[view].simple(self.interpolation) {
                // SAFETY: the processor has the feature, and the bytes of a simple photo can be counted in an i32.
                return unsafe { self.take_bilinear(view, values, size, sight, rgb, source) };
            }
            // SAFETY: the processor has the feature.
            return unsafe { self.take_from_one_avx2(view, sight, rgb, source) };
        }
        self.take_from_one(view, sight, rgb, source);
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    unsafe fn take_from_one_avx2(&self, view: usize, sight: &Sight, rgb: &mut [[u16; 3]], source: &mut [u16]) {
        self.take_from_one(view, sight, rgb, source);
    }

    /// The usual case: bilinear from 8 bits.
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    unsafe fn take_bilinear(
        &self,
        view: usize,
        values: &[[u8; 3]],
        size: [usize; 2],
        sight: &Sight,
        rgb: &mut [[u16; 3]],
        source: &mut [u16],
    ) {
        let gains = self.gains.as_ref().map(|gains| gains[view]);
        let count = rgb.len();
        let number = view as u16 + 1;
        let mut last = Vec::new();
        let seen = |i: usize| i < count && sight.cell(i).is_some();
        let put = |i: usize, colour| {
            rgb[i] = match &gains {
                None => bilinear::rounded(colour),
                gains => rounded(amplified(bilinear::numbers(colour), gains.as_ref())),
            };
            source[i] = number;
        };
        // SAFETY: the caller's.
        unsafe { bilinear::each(values, size, sight.positions(), seen, put, |i| last.push(i)) };
        for i in last {
            rgb[i] = rounded(self.sample(view, sight.xy(i)));
            source[i] = number;
        }
    }

    #[inline(always)]
    fn take_from_one(&self, view: usize, sight: &Sight, rgb: &mut [[u16; 3]], source: &mut [u16]) {
        let gains = self.gains.as_ref().map(|gains| gains[view]);
        let count = rgb.len();
        let at = |i: usize| (i < count && sight.cell(i).is_some()).then(|| sight.xy(i));
        self.photos[view].sample_each(self.interpolation, at, |i, colour| {
            rgb[i] = rounded(amplified(colour, gains.as_ref()));
            source[i] = view as u16 + 1;
        });
    }

    fn colour_by_several(
        &self,
        views: &[usize],
        points: &[[f64; 3]],
        normals: Option<&[[f64; 3]]>,
        scratch: &mut Scratch,
        rgb: &mut [[u16; 3]],
        source: &mut [u16],
    ) {
        let Scratch { sight, samples } = scratch;
        samples.iter_mut().for_each(Vec::clear);
        for &view in views {
            let map = self.maps[view];
            map.look(points, sight);
            for (i, (p, samples)) in points.iter().zip(samples.iter_mut()).enumerate() {
                if let Some(cell) = sight.cell(i) {
                    let xy = sight.xy(i);
                    let weight = map.weight(p, xy, cell, normals.map(|n| &n[i]));
                    samples.push(Sample { view, weight, colour: self.sample(view, xy) });
                }
            }
        }
        for ((samples, rgb), source) in samples.iter().zip(rgb).zip(source) {
            if let Some((colour, view)) = self.blend.blend(samples) {
                *rgb = rounded(colour);
                *source = view as u16 + 1;
            }
        }
    }
}

#[inline(always)]
fn amplified(colour: [f32; 3], gains: Option<&[f32; 3]>) -> [f32; 3] {
    match gains {
        Some(gains) => std::array::from_fn(|k| (colour[k] * gains[k]).min(65535.0)),
        None => colour,
    }
}

struct Scratch {
    sight: Sight,
    samples: Vec<Vec<Sample>>,
}
