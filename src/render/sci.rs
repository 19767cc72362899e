//! The synthetic camera image (Forkuo and King 2004): what each pixel of a view sees of the cloud.
//!
//! An [`IndexBuffer`] gives the nearest point in each pixel. Between the points of a near wall the far façade shines
//! through; [`front`] takes out what the wall's [`Surfaces`] hide. [`gather`] looks the points up: a point lies up to
//! half a pixel from its pixel's centre, and its true place goes with its pixel. Holes are closed by
//! [`super::filling`], grey values made by [`super::intensity`] and brought to the pixels' centres by
//! [`super::resampling`]. Every value is a function of the finished buffer and of the points alone, so that neither
//! chunks nor threads can be seen in it.

use std::sync::atomic::{AtomicBool, Ordering};

use rayon::prelude::*;

use super::drawing::{Splat, each_row};
use super::footprint::{Footprint, Surfaces};
use super::zbuffer::{IndexBuffer, fetch, nearest_of};
use crate::error::{Error, Result};
use crate::geometry::{Model, View};
use crate::memory::fresh;

/// Where no point is.
pub const EMPTY: i64 = -1;
/// How far ahead of its use a point is fetched, pixels.
const AHEAD: usize = 24;

/// The points in front, pixel by pixel.
#[derive(Debug, Clone, PartialEq)]
pub struct Front {
    /// Pixels in a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// The point's index in its cloud, [`EMPTY`] where there is none.
    pub index: Vec<i64>,
    /// Its inverse depth, 0 where there is none.
    pub inverse_depth: Vec<f32>,
    /// Whatever has a smaller inverse depth here is hidden; 0 where nothing hides.
    pub limit: Vec<f32>,
}

/// What keeps far points from shining through between the points of near surfaces.
#[derive(Debug, Clone, Copy)]
pub enum Hiding<'a> {
    /// Nothing: every pixel keeps its nearest point.
    Nothing,
    /// Each point is drawn as a square of fixed size, as simple renderers do: a pixel shows the nearest point whose square
    /// covers it, which may lie in a pixel beside it.
    Splats(Splat),
    /// Surfaces that are found between the points, whatever their spacing; a pixel shows its own point or none.
    Surfaces(&'a Footprint),
}

/// The points in front.
pub fn front(buffer: &IndexBuffer, hiding: Hiding) -> Result<Front> {
    let grid = buffer.grid();
    let (width, height) = (grid.width, grid.height);
    let mut index: Vec<i64> = fresh(width * height);
    let mut inverse_depth: Vec<f32> = fresh(width * height);
    let mut limit: Vec<f32> = fresh(width * height);
    let splat = if let Hiding::Splats(splat) = hiding { splat } else { Splat::POINT };
    let surfaces = match hiding {
        Hiding::Surfaces(footprint) => Some(Surfaces::from_centred(buffer.view(), grid, buffer.samples(), footprint)?),
        _ => None,
    };
    let rows = index.par_chunks_mut(width).zip(inverse_depth.par_chunks_mut(width)).zip(limit.par_chunks_mut(width));
    each_row(buffer, splat, rows, |y, cells, ((index, inverse), limit)| {
        let pixels = index.iter_mut().zip(inverse).zip(cells);
        let Some(surfaces) = &surfaces else {
            for ((index, inverse), &cell) in pixels {
                let (found, point) = nearest_of(cell);
                *inverse = found;
                *index = if cell == 0 { EMPTY } else { i64::from(point) };
            }
            return;
        };
        limit.copy_from_slice(grid.photo_row(&surfaces.limit, y));
        for (((index, inverse), &cell), &limit) in pixels.zip(&*limit) {
            let (found, point) = nearest_of(cell);
            let seen = found > 0.0 && found >= limit;
            *inverse = if seen { found } else { 0.0 };
            *index = if seen { i64::from(point) } else { EMPTY };
        }
    });
    Ok(Front { width, height, index, inverse_depth, limit })
}

/// The plain picture: of the nearest point in each pixel the depth and one value, NaN where there is none. `values` are
/// those of the whole cloud, by the points' indices.
pub fn draw(buffer: &IndexBuffer, splat: Splat, values: &[f32]) -> Result<(Vec<f32>, Vec<f32>)> {
    let grid = buffer.grid();
    let mut depth: Vec<f32> = fresh(grid.width * grid.height);
    let mut picture: Vec<f32> = fresh(grid.width * grid.height);
    let missing = AtomicBool::new(false);
    let rows = depth.par_chunks_mut(grid.width).zip(picture.par_chunks_mut(grid.width));
    each_row(buffer, splat, rows, |_, cells, (depth, picture)| {
        for (x, ((depth, value), &cell)) in depth.iter_mut().zip(picture).zip(cells).enumerate() {
            if let Some(&ahead) = cells.get(x + AHEAD) {
                fetch(values, nearest_of(ahead).1);
            }
            let (inverse, point) = nearest_of(cell);
            *depth = if cell == 0 { f32::NAN } else { 1.0 / inverse };
            *value = match values.get(point as usize) {
                Some(value) if cell != 0 => *value,
                None if cell != 0 => {
                    missing.store(true, Ordering::Relaxed);
                    f32::NAN
                }
                _ => f32::NAN,
            };
        }
    });
    if missing.into_inner() {
        return Err(Error::invalid(format!("{} values are fewer than the points of the buffer", values.len())));
    }
    Ok((depth, picture))
}

/// The nearest point's depth (NaN where empty) and index ([`EMPTY`] where empty), pixel by pixel.
pub fn images(buffer: &IndexBuffer) -> (Vec<f32>, Vec<i64>) {
    let grid = buffer.grid();
    let mut depth: Vec<f32> = fresh(grid.width * grid.height);
    let mut index: Vec<i64> = fresh(grid.width * grid.height);
    let rows = depth.par_chunks_mut(grid.width).zip(index.par_chunks_mut(grid.width));
    each_row(buffer, Splat::POINT, rows, |_, cells, (depth, index)| {
        for ((depth, index), &cell) in depth.iter_mut().zip(index).zip(cells) {
            let (inverse, point) = nearest_of(cell);
            *depth = if cell == 0 { f32::NAN } else { 1.0 / inverse };
            *index = if cell == 0 { EMPTY } else { i64::from(point) };
        }
    });
    (depth, index)
}

/// A cloud, or a chunk of it.
pub struct Points<'a> {
    /// The index of the first in the cloud.
    pub first: i64,
    /// World.
    pub xyz: &'a [[f64; 3]],
    /// May be empty.
    pub intensity: &'a [f32],
    /// Unit or not, of either sense; may be empty.
    pub normals: &'a [[f64; 3]],
}

/// What is known of the point behind each pixel; NaN where there is none.
pub struct Gathered<'a> {
    /// The point's place from the pixel's centre, x and y.
    pub offset: &'a mut [[f32; 2]],
    /// Its intensity.
    pub intensity: &'a mut [f32],
    /// Its distance from the scanner.
    pub range: &'a mut [f32],
    /// The cosine of the incidence there.
    pub cosine: &'a mut [f32],
}

/// Looks up the points of `index` that are among `points`, and leaves the other pixels as they are.
pub fn gather(view: &View, index: &[i64], station: &[f64; 3], points: &Points, out: Gathered) -> Result<()> {
    let n = points.xyz.len();
    let width = view.camera.width as usize;
    let wraps = view.camera.model() == Model::Equirectangular;
    let pixels = width * view.camera.height as usize;
    for (name, length) in [
        ("index", index.len()),
        ("offset", out.offset.len()),
        ("intensity", out.intensity.len()),
        ("range", out.range.len()),
        ("cosine", out.cosine.len()),
    ] {
        if length != pixels {
            return Err(Error::invalid(format!("{name} has {length} pixels, the view {pixels}")));
        }
    }
    let fits = |length: usize| length == 0 || length == n;
    if !fits(points.intensity.len()) || !fits(points.normals.len()) {
        return Err(Error::invalid(format!(
            "{n} points have {} intensities and {} normals",
            points.intensity.len(),
            points.normals.len()
        )));
    }
    index
        .par_chunks(width)
        .zip(out.offset.par_chunks_mut(width))
        .zip(out.intensity.par_chunks_mut(width))
        .zip(out.range.par_chunks_mut(width))
        .zip(out.cosine.par_chunks_mut(width))
        .enumerate()
        .for_each(|(y, ((((index, offset), intensity), range), cosine))| {
            for (x, &point) in index.iter().enumerate() {
                if let Some(ahead) = index.get(x + AHEAD) {
                    let ahead = (ahead - points.first) as u32;
                    fetch(points.xyz, ahead);
                    fetch(points.intensity, ahead);
                }
                let Ok(i) = usize::try_from(point - points.first) else { continue };
                if point < 0 || i >= n {
                    continue;
                }
                let p = &points.xyz[i];
                if let Some((xy, _)) = view.project(p) {
                    let mut right = xy[0] - x as f64;
                    if wraps && right.abs() > 0.5 * width as f64 {
                        // A splat, or a point just left of the border that was rounded into the last column.
                        right -= (width as f64).copysign(right);
                    }
                    offset[x] = [right as f32, (xy[1] - y as f64) as f32];
                }
                let ray: [f64; 3] = std::array::from_fn(|k| p[k] - station[k]);
                let norm = |v: &[f64; 3]| (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt();
                range[x] = norm(&ray) as f32;
                if let Some(value) = points.intensity.get(i) {
                    intensity[x] = *value;
                }
                if let Some(normal) = points.normals.get(i) {
                    let dot = ray[0] * normal[0] + ray[1] * normal[1] + ray[2] * normal[2];
                    cosine[x] = (dot.abs() / (norm(&ray) * norm(normal))) as f32;
                }
            }
        });
    Ok(())
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix3, Vector3};

    use super::*;
    use crate::geometry::{Camera, Pose};

    fn view() -> View {
        let camera = Camera::new(Model::OpenCv, 120, 90, &[110.0, 110.0, 59.5, 44.5, -0.1, 0.02, 1e-3, 0.0, 0.0]);
        View::new(camera.unwrap(), Pose { rotation: Matrix3::identity(), centre: Vector3::new(1.0, 2.0, 3.0) })
    }

    fn noise(i: usize) -> f64 {
        ((i as f64 * 12.9898).sin() * 43758.5453).fract().abs()
    }

    /// A wall at 10 m with a board of 2 m × 2 m at 5 m before it.
    fn cloud() -> Vec<[f64; 3]> {
        (0..60_000)
            .map(|i| {
                let (u, v) = (noise(i) * 2.0 - 1.0, noise(i + 100_000) * 2.0 - 1.0);
                if i % 6 == 0 { [1.0 + u, 2.0 + v, 8.0] } else { [1.0 + 6.0 * u, 2.0 + 5.0 * v, 13.0] }
            })
            .collect()
    }

    fn rendered(xyz: &[[f64; 3]], chunks: usize, hiding: Hiding) -> (Front, Vec<[f32; 2]>, Vec<f32>) {
        let view = view();
        let buffer = IndexBuffer::new(view).unwrap();
        let size = xyz.len().div_ceil(chunks);
        for (k, chunk) in xyz.chunks(size).enumerate() {
            buffer.add(chunk, (k * size) as u64).unwrap();
        }
        let front = front(&buffer, hiding).unwrap();
        let n = front.index.len();
        let (mut offset, mut range) = (vec![[f32::NAN; 2]; n], vec![f32::NAN; n]);
        let (mut intensity, mut cosine) = (vec![f32::NAN; n], vec![f32::NAN; n]);
        for (k, chunk) in xyz.chunks(size).enumerate() {
            let points = Points { first: (k * size) as i64, xyz: chunk, intensity: &[], normals: &[] };
            let out =
                Gathered { offset: &mut offset, intensity: &mut intensity, range: &mut range, cosine: &mut cosine };
            gather(&view, &front.index, &[1.0, 2.0, 3.0], &points, out).unwrap();
        }
        (front, offset, range)
    }

    #[test]
    fn index_offset_and_depth_are_those_of_the_point() {
        let (xyz, view) = (cloud(), view());
        let (front, offset, range) = rendered(&xyz, 1, Hiding::Surfaces(&Footprint::default()));
        let mut seen = 0;
        for (i, &point) in front.index.iter().enumerate().filter(|(_, p)| **p >= 0) {
            let (xy, depth) = view.project(&xyz[point as usize]).unwrap();
            let (x, y) = ((i % 120) as f64, (i / 120) as f64);
            assert!((xy[0] - x - f64::from(offset[i][0])).abs() < 1e-5 && (xy[0] - x).abs() <= 0.5);
            assert!((xy[1] - y - f64::from(offset[i][1])).abs() < 1e-5 && (xy[1] - y).abs() <= 0.5);
            assert!((f64::from(front.inverse_depth[i]) * depth - 1.0).abs() < 1e-6);
            assert!(f64::from(range[i]) >= depth * 0.999);
            seen += 1;
        }
        assert!(seen > 8000, "{seen}");
    }

    #[test]
    fn the_wall_does_not_shine_through_the_board() {
        // 10,000 points on about 44 × 44 pixels, thinned until one pixel in five is empty.
        let xyz: Vec<[f64; 3]> = cloud().into_iter().enumerate().filter(|(i, _)| i % 4 != 0).map(|(_, p)| p).collect();
        let through = |hiding| {
            let (front, _, _) = rendered(&xyz, 1, hiding);
            let inside = (32..58).flat_map(|y| (47..73).map(move |x| y * 120 + x));
            inside.filter(|i| front.index[*i] >= 0 && front.inverse_depth[*i] < 0.15).count()
        };
        assert!(through(Hiding::Nothing) > 20, "{}", through(Hiding::Nothing));
        assert_eq!(through(Hiding::Surfaces(&Footprint::default())), 0);
    }

    #[test]
    fn splats_show_the_nearest_of_the_points_whose_squares_cover_a_pixel() {
        let xyz = cloud();
        let buffer = IndexBuffer::new(view()).unwrap();
        buffer.add(&xyz[..2000], 0).unwrap();
        let single = front(&buffer, Hiding::Nothing).unwrap();
        let values: Vec<f32> = (0..2000).map(|i| i as f32).collect();
        for size in [1, 3, 7] {
            let splat = Splat::new(size).unwrap();
            let splats = front(&buffer, Hiding::Splats(splat)).unwrap();
            let (depth, picture) = draw(&buffer, splat, &values).unwrap();
            let reach = size / 2;
            // Beside the border lie points of the margin.
            for (y, x) in (reach..90 - reach).flat_map(|y| (reach..120 - reach).map(move |x| (y, x))) {
                let around = (y - reach..=y + reach).flat_map(|v| (x - reach..=x + reach).map(move |u| v * 120 + u));
                let best = around.map(|i| (single.inverse_depth[i], -single.index[i])).filter(|b| b.0 > 0.0);
                let best = best.max_by(|a, b| a.partial_cmp(b).unwrap()).unwrap_or((0.0, -EMPTY));
                let i = y * 120 + x;
                assert_eq!((splats.inverse_depth[i], -splats.index[i]), best, "{size}: {x} {y}");
                if best.0 > 0.0 {
                    assert_eq!((depth[i], picture[i]), (1.0 / best.0, -best.1 as f32));
                } else {
                    assert!(depth[i].is_nan() && picture[i].is_nan());
                }
            }
        }
        assert!(draw(&buffer, Splat::POINT, &values[..100]).is_err());
        assert!(Splat::new(2).is_err() && Splat::new(9).is_err());
    }

    #[test]
    fn neither_chunks_nor_threads_are_seen_in_the_result() {
        let xyz = cloud();
        let run = |threads: usize, chunks: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| rendered(&xyz, chunks, Hiding::Surfaces(&Footprint::default())))
        };
        let bits = |(front, offset, range): (Front, Vec<[f32; 2]>, Vec<f32>)| {
            let offset: Vec<_> = offset.iter().map(|o| o.map(f32::to_bits)).collect();
            (front, offset, range.iter().map(|r| r.to_bits()).collect::<Vec<_>>())
        };
        let one = bits(run(1, 1));
        assert!(one == bits(run(3, 1)) && one == bits(run(2, 7)));
    }
}
