//! What does an iteration of 2D ICP cost, 100,000 points to 100,000?
//!
//! Limits: 30 iterations at a fixed threshold; points of even density, and samples of the same lines, in which no point
//! has an exact partner. The rival does the same 30 times with nothing but the closest points and a rigid fit, without
//! weights, findings or covariance. Against other programs: `python -m benches.peers icp`.
#![allow(clippy::unwrap_used, missing_docs, reason = "a bench")]

use colourreg::icp::{Metric, Motion, Options, Sets, run};
use colourreg::neighbours::Neighbours;
use criterion::{Criterion, criterion_group, criterion_main};

const POINTS: usize = 100_000;
const ITERATIONS: usize = 30;
const THRESHOLD: f64 = 30.0;

struct Uniform(u64);

impl Uniform {
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        ((self.0 >> 11) as f64 + 0.5) / (1u64 << 53) as f64
    }

    fn even(&mut self, n: usize) -> Vec<[f64; 2]> {
        (0..n).map(|_| [4000.0 * self.next(), 4000.0 * self.next()]).collect()
    }

    fn on(&mut self, lines: &[([f64; 2], f64)], n: usize) -> Vec<[f64; 2]> {
        (0..n)
            .map(|_| {
                let (start, angle) = lines[(lines.len() as f64 * self.next()) as usize];
                let along = 300.0 * self.next();
                [start[0] + along * angle.cos(), start[1] + along * angle.sin()]
            })
            .collect()
    }
}

/// Turned by two milliradians, moved by 8 and −4, and with half a pixel of noise.
fn moved(points: &[[f64; 2]], random: &mut Uniform) -> Vec<[f64; 2]> {
    let (s, c) = 2e-3f64.sin_cos();
    let mut one = |p: &[f64; 2]| {
        [c * p[0] - s * p[1] + 8.0 + random.next() - 0.5, s * p[0] + c * p[1] - 4.0 + random.next() - 0.5]
    };
    points.iter().map(&mut one).collect()
}

fn rival(source: &[[f64; 2]], target: &[[f64; 2]]) -> [f64; 4] {
    let index = Neighbours::new(target).unwrap();
    let mut now = source.to_vec();
    let (mut cosine, mut sine, mut shift) = (1.0, 0.0, [0.0; 2]);
    for _ in 0..ITERATIONS {
        let found = index.nearest(&now, THRESHOLD).unwrap();
        let pairs: Vec<([f64; 2], [f64; 2])> =
            now.iter().zip(&found).filter_map(|(p, f)| f.found().map(|i| (*p, target[i]))).collect();
        let n = pairs.len() as f64;
        let mean = |of: fn(&([f64; 2], [f64; 2])) -> f64| pairs.iter().map(of).sum::<f64>() / n;
        let (a, b) = ([mean(|p| p.0[0]), mean(|p| p.0[1])], [mean(|p| p.1[0]), mean(|p| p.1[1])]);
        let (mut dot, mut cross) = (0.0, 0.0);
        for (p, q) in &pairs {
            let (x, y, u, v) = (p[0] - a[0], p[1] - a[1], q[0] - b[0], q[1] - b[1]);
            dot += x * u + y * v;
            cross += x * v - y * u;
        }
        (sine, cosine) = cross.atan2(dot).sin_cos();
        shift = [b[0] - cosine * a[0] + sine * a[1], b[1] - sine * a[0] - cosine * a[1]];
        for p in &mut now {
            *p = [cosine * p[0] - sine * p[1] + shift[0], sine * p[0] + cosine * p[1] + shift[1]];
        }
    }
    [cosine, sine, shift[0], shift[1]]
}

fn icp(c: &mut Criterion) {
    let mut random = Uniform(1);
    let even = random.even(POINTS);
    let even_target = moved(&even, &mut random);
    let lines: Vec<([f64; 2], f64)> =
        (0..400).map(|_| (random.even(1)[0], std::f64::consts::TAU * random.next())).collect();
    let edges = random.on(&lines, POINTS);
    let other = random.on(&lines, POINTS);
    let edges_target = moved(&other, &mut random);
    let options = Options {
        motion: Motion::Rigid,
        threshold: Some(THRESHOLD),
        reduction: 1.0,
        max_iterations: ITERATIONS,
        change_tolerance: 0.0,
        residual_limit: 100.0,
        ..Options::default()
    };
    for (name, source, target) in [("even", &even, &even_target), ("edges", &edges, &edges_target)] {
        let mut group = c.benchmark_group(format!("2D ICP, {POINTS} to {POINTS}, {ITERATIONS} iterations, {name}"));
        group.sample_size(10);
        let sets = Sets { source, target, source_covariance: None, target_covariance: None };
        for (metric, label) in [(Metric::PointToPoint, "point to point"), (Metric::PointToLine, "point to line")] {
            group.bench_function(label, |b| b.iter(|| run(&sets, &Options { metric, ..options }).unwrap()));
        }
        group.bench_function("rival: closest points and a fit, nothing else", |b| b.iter(|| rival(source, target)));
        group.finish();
    }
}

criterion_group!(benches, icp);
criterion_main!(benches);
