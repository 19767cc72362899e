//! The plain picture of a cloud: of the nearest point in each pixel the depth and one value, a pixel to the point.
//!
//! As an [`super::IndexBuffer`] that is drawn with [`super::Splat::POINT`], bit for bit, but told the values at once, and
//! so faster: nothing is looked up at random. Points in random order would each fetch a line of the picture from memory
//! and bring it back. Here a task first sorts its own points by tiles of the picture, in the innermost caches, and leaves
//! them in one piece; then a tile is drawn by one thread, in the innermost caches too, from the pieces of all tasks in
//! turn. The tasks are taken in the order of the points, and the first of equally near ones stays: threads cannot be
//! seen in the result.

use rayon::prelude::*;

use super::zbuffer::{Grid, Located, fetch};
use crate::error::{Error, Result};
use crate::geometry::{Block, BlockProjector, Frustum, LANES, View};
use crate::memory::zeros;

/// Points per task: those that fall into one tile are some lines of memory, and all stay in a processor's own cache.
const TASK: usize = 64 * LANES;
/// Cells of a tile: with depth and value half a megabyte, which stays in a processor's own cache.
const TILE: usize = 1 << 16;
/// Points that are sorted before tiles are drawn, at least; beyond that as many as the picture has pixels, up to a most: the
/// tasks' ends of tiles would grow with the square of the pixels.
const ROUND: usize = 64 * TASK;
const MOST: usize = 1 << 26;
/// Tasks whose points of a tile are asked for before their turn.
const AHEAD: usize = 4;

/// A point: cell, bits of the inverse depth, bits of the value.
type Record = [u32; 3];

/// What a pixel shows: inverse depth, 0 where empty, and value.
type Shown = (f32, f32);

/// Depth and value of the nearest point in each pixel of a view, NaN where there is none; of equally near points the
/// first. `values` are those of the points, one each.
pub fn picture(view: &View, xyz: &[[f64; 3]], values: &[f32]) -> Result<(Vec<f32>, Vec<f32>)> {
    if values.len() != xyz.len() {
        return Err(Error::invalid(format!("{} points have {} values", xyz.len(), values.len())));
    }
    let grid = Grid::new(view)?;
    let pixels = grid.width * grid.height;
    // The depths are inverse ones until the end.
    let (mut depth, mut value) = (zeros::<f32>(pixels, "a picture")?, zeros::<f32>(pixels, "a picture")?);
    let at_once = pixels.clamp(ROUND, MOST).next_multiple_of(TASK);
    let mut sorted = Sorted::new(&grid, xyz.len().min(at_once))?;
    let rounds = xyz.len().div_ceil(at_once).max(1);
    for round in 0..rounds {
        let part = round * at_once..((round + 1) * at_once).min(xyz.len());
        sorted.sort(view, &xyz[part.clone()], &values[part]);
        sorted.draw(&mut depth, &mut value, round == 0, round + 1 == rounds);
    }
    Ok((depth, value))
}

/// Points sorted by tile within each task.
struct Sorted {
    grid: Grid,
    tiles: usize,
    tasks: usize,
    records: Vec<Record>,
    /// For each task the ends of the tiles' records among its own; the last are of points beside the picture.
    ends: Vec<u32>,
}

impl Sorted {
    fn new(grid: &Grid, points: usize) -> Result<Self> {
        let tiles = grid.len().div_ceil(TILE);
        let ends = zeros(points.div_ceil(TASK) * (tiles + 1), "a list of tiles")?;
        Ok(Self { grid: *grid, tiles, tasks: 0, records: zeros(points, "a list of points")?, ends })
    }

    fn sort(&mut self, view: &View, xyz: &[[f64; 3]], values: &[f32]) {
        let (projector, frustum) = (BlockProjector::new(view), Frustum::new(view, 0.0));
        self.tasks = xyz.len().div_ceil(TASK);
        let (grid, tiles) = (self.grid, self.tiles);
        let tasks = self.records.par_chunks_mut(TASK).zip(self.ends.par_chunks_mut(tiles + 1));
        tasks.zip(xyz.par_chunks(TASK)).zip(values.par_chunks(TASK)).for_each_init(
            || Places::new(tiles),
            |places, (((records, ends), xyz), values)| {
                ends.fill(0);
                if frustum.meets(xyz) {
                    places.find(&projector, &grid, xyz, ends);
                    places.distribute(values, records, ends);
                }
            },
        );
    }

    /// Draws all tiles over what is there, or over nothing the first time; the last time depths are made of what were
    /// inverse depths until then.
    fn draw(&self, depth: &mut [f32], value: &mut [f32], first: bool, last: bool) {
        let (mut parts, mut depths, mut values) = (Vec::with_capacity(self.tiles), depth, value);
        for tile in 0..self.tiles {
            let size = self.photo_cells(tile).map(|(_, cells)| cells.len()).sum();
            let (depth, value);
            (depth, depths) = depths.split_at_mut(size);
            (value, values) = values.split_at_mut(size);
            parts.push((depth, value));
        }
        parts.into_par_iter().enumerate().for_each_init(
            || vec![(0.0, f32::NAN); TILE],
            |cells, (tile, (depth, value))| {
                cells.fill((0.0, f32::NAN));
                if !first {
                    for (at, part) in self.photo_cells(tile) {
                        let shown = depth[at..].iter().zip(&value[at..]);
                        cells[part].iter_mut().zip(shown).for_each(|(cell, (d, v))| *cell = (*d, *v));
                    }
                }
                self.draw_tile(tile, cells);
                for (at, part) in self.photo_cells(tile) {
                    let out = depth[at..].iter_mut().zip(&mut value[at..]);
                    for ((depth, value), &(inverse, shown)) in out.zip(&cells[part]) {
                        *depth = match inverse {
                            _ if !last => inverse,
                            0.0 => f32::NAN,
                            _ => 1.0 / inverse,
                        };
                        *value = shown;
                    }
                }
            },
        );
    }

    fn draw_tile(&self, tile: usize, cells: &mut [Shown]) {
        for task in 0..self.tasks {
            if task + AHEAD < self.tasks {
                // The first lines; the processor sees by itself how it goes on.
                let start = self.records_of(task + AHEAD, tile).start as u32;
                (0..4).for_each(|line| fetch(&self.records, start + 5 * line));
            }
            for &[cell, inverse, value] in &self.records[self.records_of(task, tile)] {
                let inverse = f32::from_bits(inverse);
                let cell = &mut cells[cell as usize % TILE];
                if inverse > cell.0 {
                    *cell = (inverse, f32::from_bits(value));
                }
            }
        }
    }

    fn records_of(&self, task: usize, tile: usize) -> std::ops::Range<usize> {
        let ends = &self.ends[task * (self.tiles + 1)..][..=tile];
        let start = if tile == 0 { 0 } else { ends[tile - 1] };
        task * TASK + start as usize..task * TASK + ends[tile] as usize
    }

    /// The cells of a tile that are pixels of the photo: pieces of rows, as ranges in the tile, each with the place of the
    /// first among all of them.
    fn photo_cells(&self, tile: usize) -> impl Iterator<Item = (usize, std::ops::Range<usize>)> {
        let (grid, first) = (self.grid, tile * TILE);
        let row = |cell: usize| cell / grid.stride();
        let border = row(grid.cell(0, 0));
        let rows = row(first).max(border)..=row(first + TILE - 1).min(border + grid.height - 1);
        let pieces = rows.map(move |row| {
            let start = grid.cell(0, row - border);
            let end = start + grid.width;
            start.clamp(first, first + TILE) - first..end.clamp(first, first + TILE) - first
        });
        pieces.scan(0, |at, piece| {
            *at += piece.len();
            Some((*at - piece.len(), piece))
        })
    }
}

/// Where the points of a task fall.
struct Places {
    tiles: usize,
    block: Block,
    located: Located,
    cells: Vec<u32>,
    inverses: Vec<f32>,
}

impl Places {
    fn new(tiles: usize) -> Self {
        let located = Located::new();
        Self { tiles, block: Block::new(), located, cells: vec![0; TASK], inverses: vec![0.0; TASK] }
    }

    /// The tile of a cell, and one beyond the last for what is beside the picture.
    #[inline(always)]
    fn tile(&self, cell: u32) -> usize {
        (cell as usize / TILE).min(self.tiles)
    }

    /// Finds the points' cells, and how many lie in each tile.
    fn find(&mut self, projector: &BlockProjector, grid: &Grid, xyz: &[[f64; 3]], counts: &mut [u32]) {
        for (k, points) in xyz.chunks(LANES).enumerate() {
            projector.project(points, &mut self.block);
            grid.locate(&self.block, 0, &mut self.located);
            for i in 0..points.len() {
                let (cell, inverse) = match self.located.get(i) {
                    Some((cell, inverse)) if inverse > 0.0 => (cell as u32, inverse),
                    _ => (u32::MAX, 0.0),
                };
                (self.cells[k * LANES + i], self.inverses[k * LANES + i]) = (cell, inverse);
                counts[self.tile(cell)] += 1;
            }
        }
    }

    /// Puts the points' records behind each other, tile by tile; of the counts become the tiles' ends.
    fn distribute(&self, values: &[f32], records: &mut [Record], counts: &mut [u32]) {
        let mut sum = 0;
        for count in counts.iter_mut() {
            (*count, sum) = (sum, sum + *count);
        }
        for ((&cell, inverse), value) in self.cells.iter().zip(&self.inverses).zip(values) {
            let at = &mut counts[self.tile(cell)];
            records[*at as usize] = [cell, inverse.to_bits(), value.to_bits()];
            *at += 1;
        }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix3, Vector3};

    use super::super::{IndexBuffer, Splat, sci};
    use super::*;
    use crate::geometry::{Camera, Model, Pose};

    fn noise(i: usize) -> f64 {
        ((i as f64 * 12.9898).sin() * 43758.5453).fract().abs()
    }

    /// Points all about; every eleventh lies where the one before lies, and every hundredth nowhere.
    fn cloud(n: usize) -> (Vec<[f64; 3]>, Vec<f32>) {
        let point = |i: usize| {
            let i = if i % 11 == 10 { i - 1 } else { i };
            if i % 100 == 7 { [f64::NAN; 3] } else { [0, 1, 2].map(|k| 20.0 * noise(3 * i + k) - 10.0) }
        };
        ((0..n).map(point).collect(), (0..n).map(|i| i as f32).collect())
    }

    fn view(model: Model, width: u32, height: u32, params: &[f64]) -> View {
        let camera = Camera::new(model, width, height, params).unwrap();
        View::new(camera, Pose { rotation: Matrix3::identity(), centre: Vector3::new(0.5, 0.2, -1.0) })
    }

    fn bits((depth, value): (Vec<f32>, Vec<f32>)) -> Vec<u32> {
        depth.iter().chain(&value).map(|v| v.to_bits()).collect()
    }

    #[test]
    fn the_picture_is_that_of_an_index_buffer_whatever_the_camera_the_rounds_and_the_threads() {
        let distorted = [330.0, 330.0, 299.5, 199.5, -0.1, 0.02, 1e-3, 0.0, 0.0];
        for view in [
            view(Model::OpenCv, 600, 400, &distorted),
            view(Model::Equirectangular, 700, 350, &[]),
            view(Model::Pinhole, 16, 9, &[8.0, 8.0, 7.5, 4.0]),
        ] {
            // One round with an odd end, and more than one.
            for n in [0, 1, 5 * TASK + 300, ROUND + TASK / 2 + 1] {
                let (xyz, values) = cloud(n);
                let buffer = IndexBuffer::new(view).unwrap();
                buffer.add(&xyz, 0).unwrap();
                let want = bits(sci::draw(&buffer, Splat::POINT, &values).unwrap());
                for threads in [1, 3] {
                    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
                    let found = pool.install(|| picture(&view, &xyz, &values)).unwrap();
                    assert!(bits(found) == want, "{n} points, {threads} threads");
                }
            }
        }
        let (xyz, values) = cloud(10);
        let error = picture(&view(Model::Pinhole, 16, 9, &[8.0, 8.0, 7.5, 4.0]), &xyz, &values[1..]).unwrap_err();
        assert_eq!(error.to_string(), "10 points have 9 values");
    }
}
