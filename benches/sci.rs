//! What does a synthetic camera image cost, and what does the order of the points?
//!
//! Limits: 4 million points into 12 megapixels, walls at four distances; the peers are in `benches/peers/sci.py`, where
//! the aim is at least 8 times NumPy's speed with footprints of one pixel and 15 times with surfaces that hide, and less
//! than 1.5 times the time when the points are shuffled.
#![allow(clippy::unwrap_used, missing_docs, reason = "a bench")]

use colourreg::geometry::{Camera, Model, Pose, View};
use colourreg::render::sci::front;
use colourreg::render::{Footprint, IndexBuffer};
use criterion::{Criterion, criterion_group, criterion_main};

const COLUMNS: usize = 2310;
const ROWS: usize = 1730;

fn view() -> View {
    let params = [2900.0, 2900.0, 1999.5, 1499.5, -0.05, 0.01, 5e-4, -3e-4, 0.0];
    View::new(Camera::new(Model::OpenCv, 4000, 3000, &params).unwrap(), Pose::identity())
}

fn walls() -> Vec<[f64; 3]> {
    (0..COLUMNS * ROWS)
        .map(|i| {
            let x = -0.72 + 1.44 * (i / ROWS) as f64 / COLUMNS as f64;
            let y = -0.54 + 1.08 * (i % ROWS) as f64 / ROWS as f64;
            let z = 8.0 + 6.0 * ((9.0 * (x + 0.72)) as usize % 4) as f64 + 0.2 * (20.0 * y).floor();
            [x * z, y * z, z]
        })
        .collect()
}

/// Every point once, in an order that no cache follows.
fn shuffled(points: &[[f64; 3]]) -> Vec<[f64; 3]> {
    let (n, step) = (points.len(), 1_234_577);
    (0..n).map(|i| points[(i * step) % n]).collect()
}

fn sci(c: &mut Criterion) {
    let (view, in_order) = (view(), walls());
    let mixed = shuffled(&in_order);
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
    let buffer = IndexBuffer::new(view).unwrap();
    buffer.add(&in_order, 0).unwrap();
    let footprint = Footprint::new(None, None).unwrap();
    group.bench_function("front of the buffer, nothing hides", |b| b.iter(|| front(&buffer, None)));
    group.bench_function("front of the buffer, surfaces hide", |b| b.iter(|| front(&buffer, Some(&footprint))));
    group.finish();
}

criterion_group!(benches, sci);
criterion_main!(benches);
