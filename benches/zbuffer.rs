//! What does it cost to find out what hides what, and what does the order of the points?
//!
//! Limits: 4 million points into 12 megapixels. `add` grows with the points, `finish`, which makes surfaces of the samples,
//! with the pixels. Shuffled points should cost less than 1.5 times as much as those in order.
#![allow(clippy::unwrap_used, missing_docs, reason = "a bench")]

use colourreg::colour::{Limits, VisibilityMap};
use colourreg::render::{DepthBuffer, Footprint};
use criterion::{BatchSize, Criterion, criterion_group, criterion_main};

mod walls;

fn zbuffer(c: &mut Criterion) {
    let (view, in_order) = (walls::view(), walls::points());
    let mixed = walls::shuffled(&in_order);
    let mut group = c.benchmark_group("zbuffer");
    group.sample_size(10);
    let filled = |points: &[[f64; 3]]| {
        let buffer = DepthBuffer::new(view).unwrap();
        buffer.add(points);
        buffer
    };
    for (name, points) in [("in order", &in_order), ("shuffled", &mixed)] {
        group.bench_function(format!("add, {name}"), |b| {
            b.iter_batched(
                || DepthBuffer::new(view).unwrap(),
                |buffer| {
                    buffer.add(points);
                    buffer
                },
                BatchSize::PerIteration,
            );
        });
    }
    let footprint = Footprint::new(None, None).unwrap();
    group.bench_function("finish", |b| {
        b.iter_batched(
            || filled(&in_order),
            |buffer| VisibilityMap::new(buffer, &footprint, Limits::default()).unwrap(),
            BatchSize::PerIteration,
        );
    });
    let map = VisibilityMap::new(filled(&in_order), &footprint, Limits::default()).unwrap();
    for (name, points) in [("in order", &in_order), ("shuffled", &mixed)] {
        group.bench_function(format!("visible, {name}"), |b| b.iter(|| map.visible(points)));
    }
    group.finish();
}

criterion_group!(benches, zbuffer);
criterion_main!(benches);
