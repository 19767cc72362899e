//! How fast is the nearest of a million points found, build and query together?
//!
//! Limits: points of even density, and half of them on lines as edges in a picture lie; queries in random order. The rival
//! is the kd-tree beneath, asked in the queries' own order on all cores: what the grid and the order along a curve add
//! to it. Against other programs: `python -m benches.peers neighbours`.
#![allow(clippy::unwrap_used, missing_docs, reason = "a bench")]

use colourreg::neighbours::Neighbours;
use criterion::{Criterion, criterion_group, criterion_main};
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use rayon::prelude::*;

const POINTS: usize = 1_000_000;

struct Uniform(u64);

impl Uniform {
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        ((self.0 >> 11) as f64 + 0.5) / (1u64 << 53) as f64
    }

    fn even<const D: usize>(&mut self, n: usize) -> Vec<[f64; D]> {
        (0..n).map(|_| std::array::from_fn(|_| 4000.0 * self.next())).collect()
    }

    /// Half of the points on 400 lines of 200 px, the others anywhere.
    fn edges(&mut self, n: usize) -> Vec<[f64; 2]> {
        let lines: Vec<([f64; 2], f64)> =
            (0..400).map(|_| (self.even::<2>(1)[0], std::f64::consts::TAU * self.next())).collect();
        let mut points = self.even(n / 2);
        points.extend((n / 2..n).map(|_| {
            let (start, angle) = lines[(400.0 * self.next()) as usize];
            let along = 200.0 * self.next();
            [start[0] + along * angle.cos() + self.next(), start[1] + along * angle.sin() + self.next()]
        }));
        points
    }
}

fn rival<const D: usize>(points: &[[f64; D]], queries: &[[f64; D]]) -> Vec<f64> {
    let tree: ImmutableKdTree<f64, D> = ImmutableKdTree::new_from_slice_parallel(points).unwrap();
    let one = |q: &[f64; D]| tree.query(q).nearest_one::<SquaredEuclidean<f64>>().execute().distance;
    queries.par_iter().map(one).collect()
}

fn compare<const D: usize>(c: &mut Criterion, name: &str, points: &[[f64; D]], queries: &[[f64; D]]) {
    let mut group = c.benchmark_group(format!("nearest of {POINTS} in {POINTS}, {name}"));
    group.sample_size(10);
    group.bench_function("colourreg, k = 1", |b| {
        b.iter(|| Neighbours::new(points).unwrap().nearest(queries, f64::INFINITY).unwrap());
    });
    group.bench_function("rival: the tree alone, k = 1", |b| b.iter(|| rival(points, queries)));
    group.bench_function("colourreg, k = 8", |b| {
        b.iter(|| Neighbours::new(points).unwrap().k_nearest(queries, 8, f64::INFINITY).unwrap());
    });
    group.finish();
}

fn neighbours(c: &mut Criterion) {
    let mut random = Uniform(1);
    let (points, queries) = (random.even::<2>(POINTS), random.even::<2>(POINTS));
    compare(c, "plane, even", &points, &queries);
    let (points, queries) = (random.edges(POINTS), random.edges(POINTS));
    compare(c, "plane, edges", &points, &queries);
    let (points, queries) = (random.even::<3>(POINTS), random.even::<3>(POINTS));
    compare(c, "space, even", &points, &queries);
}

criterion_group!(benches, neighbours);
criterion_main!(benches);
