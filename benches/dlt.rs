//! What does a DLT cost, from a dozen points to a hundred thousand?
//!
//! Limits: map coordinates, noise of 0.5 px; iteration and Levenberg–Marquardt refinement, covariance and verdict are part
//! of it. The rival is the textbook's way for twelve parameters, the SVD of the whole 2n × 12 system of normalised
//! equations, which gives the matrix alone.
#![allow(clippy::unwrap_used, missing_docs, reason = "a bench")]

mod control;

use std::hint::black_box;

use colourreg::estimation::{DltMethod, DltOptions, estimate_dlt};
use criterion::{BenchmarkId, Criterion, criterion_group, criterion_main};
use nalgebra::DMatrix;

fn textbook(xyz: &[[f64; 3]], xy: &[[f64; 2]]) -> Vec<f64> {
    let n = xyz.len();
    let mean = |k: usize| xyz.iter().map(|p| p[k]).sum::<f64>() / n as f64;
    let centre = [mean(0), mean(1), mean(2)];
    let a = DMatrix::from_fn(2 * n, 12, |row, column| {
        let (p, m, odd) = (&xyz[row / 2], &xy[row / 2], row % 2 == 1);
        let x = |k: usize| if k < 3 { (p[k] - centre[k]) / 10.0 } else { 1.0 };
        let measured = if odd { m[1] / 2000.0 - 1.0 } else { m[0] / 2000.0 - 1.5 };
        match column / 4 {
            0 if !odd => x(column),
            1 if odd => x(column - 4),
            2 => -measured * x(column - 8),
            _ => 0.0,
        }
    });
    let svd = a.svd(false, true);
    let v = svd.v_t.unwrap();
    v.row(svd.singular_values.imin()).iter().copied().collect()
}

fn dlt(c: &mut Criterion) {
    let mut group = c.benchmark_group("dlt");
    group.sample_size(10);
    for n in [12, 1_000, 100_000] {
        let view = control::view(false);
        let (xyz, xy) = control::points(&view, n, 0.0);
        let options = |method, distortion: &[&str]| DltOptions {
            method,
            distortion: distortion.iter().map(ToString::to_string).collect(),
            precision: None,
            check: Vec::new(),
            size: control::SIZE,
        };
        for (name, options) in [
            ("11 parameters", options(DltMethod::Eleven, &[])),
            ("12 parameters", options(DltMethod::Twelve, &[])),
            ("11 and k1 k2 p1 p2", options(DltMethod::Eleven, &["k1", "k2", "p1", "p2"])),
        ] {
            if n < 50 && !options.distortion.is_empty() {
                continue;
            }
            group.bench_function(BenchmarkId::new(name, n), |b| {
                b.iter(|| estimate_dlt(black_box(&xyz), black_box(&xy), &options).unwrap());
            });
        }
        group.bench_function(BenchmarkId::new("rival: SVD of all equations", n), |b| {
            b.iter(|| textbook(black_box(&xyz), black_box(&xy)));
        });
    }
    group.finish();
}

criterion_group!(benches, dlt);
criterion_main!(benches);
