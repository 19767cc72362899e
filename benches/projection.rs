//! What does it cost to project points through a lens, into new arrays and into given ones?
//!
//! Limits: 4 million points, one distorted camera; memory is the limit (24 bytes in, 24 out for each point). The peers are
//! in `benches/peers/projection.py`, where the aim is 20 times NumPy's and 90 times OpenCV's speed.
#![allow(clippy::unwrap_used, missing_docs, reason = "a bench")]

use std::hint::black_box;

use colourreg::geometry::{project, project_into, unproject};
use criterion::{Criterion, Throughput, criterion_group, criterion_main};

mod walls;

fn projection(c: &mut Criterion) {
    let (view, points) = (walls::view(), walls::points());
    let mut group = c.benchmark_group("projection");
    group.sample_size(20).throughput(Throughput::Elements(points.len() as u64));
    group.bench_function("into new arrays", |b| b.iter(|| project(&view, black_box(&points))));
    let (mut xy, mut depth) = (vec![[0.0; 2]; points.len()], vec![0.0; points.len()]);
    group.bench_function("into given arrays", |b| {
        b.iter(|| project_into(&view, black_box(&points), &mut xy, &mut depth).unwrap());
    });
    let pixels = &xy[..400_000];
    group.throughput(Throughput::Elements(pixels.len() as u64));
    group.bench_function("back to rays", |b| b.iter(|| unproject(&view, black_box(pixels))));
    group.finish();
}

criterion_group!(benches, projection);
criterion_main!(benches);
