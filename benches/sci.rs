//! What does a synthetic camera image cost, and what does the order of the points?
//!
//! Limits: 4 million points into 12 megapixels, walls at four distances; the peers are in `benches/peers/sci.py`, where
//! the aim is at least 8 times NumPy's speed with footprints of one pixel and 15 times with surfaces that hide, and less
//! than 1.5 times the time when the points are shuffled.
#![allow(clippy::unwrap_used, missing_docs, reason = "a bench")]

use colourreg::render::sci::{Hiding, draw, front};
use colourreg::render::{Footprint, IndexBuffer, Splat, picture};
use criterion::{Criterion, criterion_group, criterion_main};

mod walls;

fn sci(c: &mut Criterion) {
    let (view, in_order) = (walls::view(), walls::points());
    let mixed = walls::shuffled(&in_order);
    let mut group = c.benchmark_group("sci");
    group.sample_size(10);
    for (name, points) in [("in order", &in_order), ("shuffled", &mixed)] {
        group.bench_function(format!("index buffer, {name}"), |b| {
            b.iter(|| {
                let buffer = IndexBuffer::new(view).unwrap();
                buffer.add(points, 0).unwrap();
                buffer
            });
        });
    }
    let values = vec![1.0; in_order.len()];
    for (name, points) in [("in order", &in_order), ("shuffled", &mixed)] {
        group.bench_function(format!("picture, {name}"), |b| b.iter(|| picture(&view, points, &values)));
    }
    let buffer = IndexBuffer::new(view).unwrap();
    buffer.add(&in_order, 0).unwrap();
    let footprint = Footprint::new(None, None).unwrap();
    group.bench_function("front of the buffer, nothing hides", |b| b.iter(|| front(&buffer, Hiding::Nothing)));
    group.bench_function("front of the buffer, surfaces hide", |b| {
        b.iter(|| front(&buffer, Hiding::Surfaces(&footprint)))
    });
    let splat = Splat::new(3).unwrap();
    group.bench_function("depth and values, points", |b| b.iter(|| draw(&buffer, Splat::POINT, &values)));
    group.bench_function("depth and values, splats of 3 x 3", |b| b.iter(|| draw(&buffer, splat, &values)));
    group.finish();
}

criterion_group!(benches, sci);
criterion_main!(benches);
