//! What do the colours cost once it is known what hides what: one photo, two photos, other ways of reading and blending?
//!
//! Limits: 4 million points, photos of 12 megapixels and 8 bits, outputs given. Surfaces (`zbuffer.rs`) are made before and
//! not counted. The peers, with everything counted, are in `benches/peers/colouring.py`.
#![allow(clippy::unwrap_used, missing_docs, reason = "a bench")]

use colourreg::colour::{Blend, Colourist, Colours, Interpolation, Limits, Photo, Pixels, VisibilityMap};
use colourreg::render::{DepthBuffer, Footprint};
use criterion::{Criterion, Throughput, criterion_group, criterion_main};

mod walls;

fn colouring(c: &mut Criterion) {
    let (view, in_order) = (walls::view(), walls::points());
    let mixed = walls::shuffled(&in_order);
    let (width, height) = (view.camera.width as usize, view.camera.height as usize);
    let pixels: Vec<[u8; 3]> =
        (0..width * height).map(|i| [(i % 251) as u8, (i / width % 241) as u8, (i % 7 * 30) as u8]).collect();
    let photo = || Photo::new(Pixels::U8(&pixels), width, height, false).unwrap();
    let buffer = DepthBuffer::new(view).unwrap();
    buffer.add(&in_order);
    let map = VisibilityMap::new(buffer, &Footprint::new(None, None).unwrap(), Limits::default()).unwrap();

    let mut group = c.benchmark_group("colouring");
    group.sample_size(10).throughput(Throughput::Elements(in_order.len() as u64));
    let (mut rgb, mut source) = (vec![[0; 3]; in_order.len()], vec![0; in_order.len()]);
    for (name, photos, points, interpolation, blend) in [
        ("one photo, in order", 1, &in_order, Interpolation::Bilinear, Blend::Best),
        ("one photo, shuffled", 1, &mixed, Interpolation::Bilinear, Blend::Best),
        ("one photo, bicubic", 1, &in_order, Interpolation::Bicubic, Blend::Best),
        ("two photos, best", 2, &in_order, Interpolation::Bilinear, Blend::Best),
        ("two photos, mean", 2, &in_order, Interpolation::Bilinear, Blend::Mean),
    ] {
        let photos: Vec<Photo<'_>> = (0..photos).map(|_| photo()).collect();
        let colourist = Colourist::new(vec![&map; photos.len()], photos, None, interpolation, blend).unwrap();
        group.bench_function(name, |b| {
            b.iter(|| colourist.colour(points, None, Colours { rgb: &mut rgb, source: &mut source }).unwrap());
        });
    }
    group.finish();
}

criterion_group!(benches, colouring);
criterion_main!(benches);
