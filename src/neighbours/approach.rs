//! The few points of a cloud that lie nearest to given places, while the cloud goes by in chunks.
//!
//! A tree over each chunk would cost more than reading it. Successive points of a scan lie together, so boxes around a
//! thousand of them rule out almost all before any distance is computed; the result is exact in any order.

use rayon::prelude::*;

use super::refuse_not_finite;
use crate::error::Result;

/// Points in a box.
const BOX: usize = 1024;

/// How many points are kept for each place: enough to tell the spacing there.
const KEPT: usize = 8;

/// A point of the cloud with its squared distance.
type Near = (f64, [f64; 3]);

/// Places, and the nearest points that have gone by.
#[derive(Debug, Clone)]
pub struct Approach {
    places: Vec<[f64; 3]>,
    near: Vec<Vec<Near>>,
}

fn distance2(a: &[f64; 3], b: &[f64; 3]) -> f64 {
    (a[0] - b[0]).powi(2) + (a[1] - b[1]).powi(2) + (a[2] - b[2]).powi(2)
}

/// The box around some points; coordinates that are no numbers take no part.
fn bounds(points: &[[f64; 3]]) -> ([f64; 3], [f64; 3]) {
    points.iter().fold(([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]), |(low, high), p| {
        (std::array::from_fn(|i| low[i].min(p[i])), std::array::from_fn(|i| high[i].max(p[i])))
    })
}

impl Approach {
    /// No point has gone by yet. Refuses places that are not finite.
    pub fn new(places: &[[f64; 3]]) -> Result<Self> {
        refuse_not_finite(places, "place")?;
        Ok(Self { places: places.to_vec(), near: vec![Vec::with_capacity(KEPT + 1); places.len()] })
    }

    /// Some points go by. Those that are not finite are passed over.
    pub fn add(&mut self, points: &[[f64; 3]]) {
        let boxes: Vec<_> = points.par_chunks(BOX).map(bounds).collect();
        self.near.par_iter_mut().zip(&self.places).for_each(|(near, place)| {
            for ((low, high), points) in boxes.iter().zip(points.chunks(BOX)) {
                let inside = std::array::from_fn(|i| place[i].max(low[i]).min(high[i]));
                if near.len() < KEPT || distance2(&inside, place) < near[KEPT - 1].0 {
                    for point in points {
                        keep(near, distance2(point, place), point);
                    }
                }
            }
        });
    }

    /// From each place to the nearest point; infinite where none has gone by.
    pub fn distances(&self) -> Vec<f64> {
        self.near.iter().map(|near| near.first().map_or(f64::INFINITY, |n| n.0.sqrt())).collect()
    }

    /// How far the points nearest to each place are from each other, the median of what each has to its next one; infinite
    /// where fewer than two have gone by.
    pub fn spacings(&self) -> Vec<f64> {
        self.near.iter().map(|near| spacing(near)).collect()
    }
}

#[inline]
fn keep(near: &mut Vec<Near>, distance2: f64, point: &[f64; 3]) {
    let last = if near.len() < KEPT { f64::INFINITY } else { near[KEPT - 1].0 };
    if distance2 < last {
        let at = near.partition_point(|n| n.0 <= distance2);
        near.insert(at, (distance2, *point));
        near.truncate(KEPT);
    }
}

fn spacing(near: &[Near]) -> f64 {
    let to_next = |i: usize| {
        let others = near.iter().enumerate().filter(|(k, _)| *k != i);
        others.map(|(_, other)| distance2(&other.1, &near[i].1)).fold(f64::INFINITY, f64::min)
    };
    let mut all: Vec<f64> = (0..near.len()).map(to_next).collect();
    let middle = all.len() / 2;
    if all.is_empty() { f64::INFINITY } else { all.select_nth_unstable_by(middle, f64::total_cmp).1.sqrt() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::neighbours::Neighbours;

    #[test]
    fn the_nearest_points_are_those_of_the_tree_in_whatever_chunks_they_come() {
        // Evenly strewn: multiples of irrational numbers, without their whole part.
        let strewn = |n: usize, from: f64| -> Vec<[f64; 3]> {
            let at = |i: usize, step: f64| 10.0 * ((i as f64 + from) * step).fract() + 5.8e6;
            (0..n).map(|i| [at(i, 2f64.sqrt()), at(i, 3f64.sqrt()), at(i, 5f64.sqrt())]).collect()
        };
        let (mut points, places) = (strewn(20_000, 0.0), strewn(50, 0.37));
        let tree = Neighbours::new(&points).unwrap();
        points.sort_by(|a, b| a[0].total_cmp(&b[0]));
        points.insert(77, [f64::NAN, 1.0, 2.0]);
        for size in [333, 5000, 30_000] {
            let mut approach = Approach::new(&places).unwrap();
            points.chunks(size).for_each(|chunk| approach.add(chunk));
            for (place, found) in places.iter().zip(approach.distances()) {
                assert_eq!(found, tree.nearest_one(place, f64::INFINITY).distance2.sqrt());
            }
        }
    }

    #[test]
    fn the_spacing_is_that_of_a_grid_and_infinite_where_nothing_went_by() {
        let mut approach = Approach::new(&[[0.3, 0.4, 1.0], [9.0, 9.0, 0.0]]).unwrap();
        assert_eq!(approach.distances(), [f64::INFINITY; 2]);
        assert_eq!(approach.spacings(), [f64::INFINITY; 2]);
        let grid: Vec<[f64; 3]> = (0..400).map(|i| [f64::from(i % 20), f64::from(i / 20), 0.0]).collect();
        approach.add(&grid);
        assert_eq!(approach.spacings(), [1.0; 2]);
        assert!((approach.distances()[0] - (0.09f64 + 0.16 + 1.0).sqrt()).abs() < 1e-15);
        assert_eq!(approach.distances()[1], 0.0);
        assert!(Approach::new(&[[0.0, f64::NAN, 0.0]]).is_err());
    }
}
