//! What does a resection cost, among clean points and among blunders, and with a free camera?
//!
//! Limits: map coordinates, noise of 0.5 px, a calibrated camera with distortion; covariance, tests and verdict are part of
//! it. 100,000 points in under 50 ms; the search among 60 % blunders in milliseconds. The rival is the same optimum
//! reached from a near start, which needs no search; other programs are in `benches/peers/resection.py`.
#![allow(clippy::unwrap_used, missing_docs, reason = "a bench")]

mod control;

use std::hint::black_box;

use colourreg::estimation::{Criterion as Blunder, RansacOptions, ResectionOptions, Start, resect, resect_robust};
use criterion::{BenchmarkId, Criterion, criterion_group, criterion_main};
use nalgebra::Vector3;

fn resection(c: &mut Criterion) {
    let mut group = c.benchmark_group("resection");
    group.sample_size(10);
    let view = control::view(true);
    let mut near = view;
    near.pose = view.pose.perturbed(&Vector3::new(0.02, -0.01, 0.02), &Vector3::new(0.3, -0.2, 0.1));
    for n in [20, 1_000, 100_000] {
        let (xyz, xy) = control::points(&view, n, 0.0);
        for (name, start, free) in [
            ("from nothing", Start::Search, &["pose"][..]),
            ("rival: from a near start", Start::Given, &["pose"]),
            ("from a near start, camera free", Start::Given, &["pose", "f", "pp", "distortion"]),
        ] {
            let free = free.iter().map(ToString::to_string).collect();
            let options = ResectionOptions { start, free, ..ResectionOptions::default() };
            group.bench_function(BenchmarkId::new(name, n), |b| {
                b.iter(|| resect(black_box(&near), black_box(&xyz), black_box(&xy), &options).unwrap());
            });
        }
    }
    for (n, share) in [(20, 0.5), (1_000, 0.3), (1_000, 0.6), (100_000, 0.6)] {
        let (xyz, xy) = control::points(&view, n, share);
        let options = ResectionOptions::default();
        let search = RansacOptions::default();
        let name = format!("among {:.0} % blunders", 100.0 * share);
        group.bench_function(BenchmarkId::new(name, n), |b| {
            b.iter(|| {
                let judged = (Blunder::EstimatedSigma, 0.001);
                resect_robust(black_box(&near), black_box(&xyz), black_box(&xy), &options, &search, judged).unwrap()
            });
        });
    }
    group.finish();
}

criterion_group!(benches, resection);
criterion_main!(benches);
