//! What does accuracy cost?
//!
//! Limits: 10,000 control points adjust in under a second, object coordinates uncertain too; the colour position error of
//! 10 million points costs less than half of colouring them (which takes 0.25 to 0.5 s on two cores). The rival of the
//! latter is the same formula evaluated without interpolation.
#![allow(clippy::unwrap_used, missing_docs, reason = "a bench")]

use colourreg::adjustment::*;
use colourreg::estimation::FreeSet;
use colourreg::geometry::{Camera, Model, Pose, View, rotation_exp};
use criterion::{Criterion, criterion_group, criterion_main};
use nalgebra::Vector3;

struct Uniform(u64);

impl Uniform {
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        ((self.0 >> 11) as f64 + 0.5) / (1u64 << 53) as f64
    }
}

fn view() -> View {
    let params = [3000.0, 3000.0, 1990.0, 1510.0, -0.05, 0.01, 5e-4, -3e-4, 0.0];
    let camera = Camera::new(Model::OpenCv, 6000, 4000, &params).unwrap();
    View::new(
        camera,
        Pose { rotation: rotation_exp(&Vector3::new(0.2, -0.3, 0.1)), centre: Vector3::new(4.5e5, 5.8e6, 120.0) },
    )
}

fn points(view: &View, n: usize, random: &mut Uniform) -> Vec<[f64; 3]> {
    (0..n)
        .map(|_| {
            let ray = view.ray(&[6000.0 * random.next() - 0.5, 4000.0 * random.next() - 0.5]).unwrap();
            (view.pose.centre + ray * (5.0 + 30.0 * random.next())).into()
        })
        .collect()
}

fn diagonal<const D: usize>(sigma: f64) -> [[f64; D]; D] {
    std::array::from_fn(|i| std::array::from_fn(|j| if i == j { sigma * sigma } else { 0.0 }))
}

fn adjusted(view: &View, n: usize, free: &FreeSet, options: &FullOptions) -> ViewAdjustment {
    with_blunders(view, n, 0, free, options)
}

/// So many points, some of which are off by up to 40 px.
fn with_blunders(view: &View, n: usize, blunders: usize, free: &FreeSet, options: &FullOptions) -> ViewAdjustment {
    let mut random = Uniform(7);
    let exact = points(view, n, &mut random);
    // Twelve uniform numbers make nearly a normal one.
    let mut noise = |x: f64, sigma: f64| x + sigma * ((0..12).map(|_| random.next()).sum::<f64>() - 6.0);
    let mut xy: Vec<[f64; 2]> = exact.iter().map(|p| view.project(p).unwrap().0.map(|x| noise(x, 0.5))).collect();
    let xyz: Vec<[f64; 3]> = exact.iter().map(|p| p.map(|x| noise(x, 0.003))).collect();
    for k in 0..blunders {
        xy[k * n / blunders][k % 2] += 80.0 * (random.next() - 0.5);
    }
    let (covariance_xyz, covariance_xy) = (vec![diagonal(0.003); n], vec![diagonal(0.5); n]);
    let points = ControlPoints { xyz: &xyz, xy: &xy, covariance_xyz: &covariance_xyz, covariance_xy: &covariance_xy };
    let mut start = *view;
    start.pose = view.pose.perturbed(&Vector3::new(0.02, -0.01, 0.02), &Vector3::new(0.3, -0.2, 0.1));
    adjust_view(&start, &points, free, None, &[], options).unwrap()
}

fn adjustment(c: &mut Criterion) {
    let mut group = c.benchmark_group("adjustment");
    group.sample_size(10);
    let calibration = FreeSet::parse(Model::OpenCv, &["pose", "f", "pp", "distortion"]).unwrap();
    let pose = FreeSet::pose(Model::OpenCv);
    for n in [20, 1000, 10_000] {
        group.bench_function(format!("pose, {n} points, all statistics"), |b| {
            b.iter(|| adjusted(&view(), n, &pose, &FullOptions::default()));
        });
    }
    group.bench_function("pose, f, pp, distortion, 10000 points, all statistics", |b| {
        b.iter(|| adjusted(&view(), 10_000, &calibration, &FullOptions::default()));
    });
    for (names, free) in [("pose", &pose), ("pose, f, pp, distortion", &calibration)] {
        for blunders in [0, 50, 500] {
            group.bench_function(format!("snooping, {names}, 10000 points, {blunders} blunders"), |b| {
                b.iter(|| with_blunders(&view(), 10_000, blunders, free, &FullOptions::default()));
            });
        }
    }
    let components = FullOptions { components: true, ..FullOptions::default() };
    group.bench_function("the same with variance components", |b| {
        b.iter(|| adjusted(&view(), 10_000, &calibration, &components));
    });
    group.finish();
}

fn colour_sigma(c: &mut Criterion) {
    let mut group = c.benchmark_group("colour sigma");
    group.sample_size(10);
    let view = view();
    let mut random = Uniform(8);
    let n = 10_000_000;
    let xyz = points(&view, n, &mut random);
    let normals: Vec<[f64; 3]> = (0..n).map(|_| std::array::from_fn(|_| random.next() - 0.5)).collect();
    let mut out = vec![0.0f32; n];
    for names in [&["pose"][..], &["pose", "f", "pp", "distortion"]] {
        let free = FreeSet::parse(Model::OpenCv, names).unwrap();
        let covariance = adjusted(&view, 25, &free, &FullOptions::default()).covariance().unwrap();
        let new = || SurfaceSigma::new(&view, &covariance, 0.3, ObjectNoise::Isotropic(0.002)).unwrap();
        group.bench_function(format!("tables, {} parameters", free.len()), |b| b.iter(|| new().exact_share()));
        let sigma = new();
        group.bench_function(format!("10 M points, no normals, {} parameters", free.len()), |b| {
            b.iter(|| sigma.fill(&xyz, Slopes::default(), &mut out).unwrap());
        });
        group.bench_function(format!("10 M points, normals, {} parameters", free.len()), |b| {
            b.iter(|| sigma.fill(&xyz, Slopes::of(Some(&normals)), &mut out).unwrap());
        });
        group.bench_function(format!("rival: 0.1 M points by the formula, {} parameters", free.len()), |b| {
            b.iter(|| xyz[..100_000].iter().zip(&normals).map(|(p, n)| sigma.exact(p, Some(n))).sum::<f64>());
        });
    }
    let scanner = ScannerModel::new([4.5e5, 5.8e6, 121.0], 0.003, 5e-5, 5e-5).unwrap();
    let covariance = adjusted(&view, 25, &FreeSet::pose(Model::OpenCv), &FullOptions::default()).covariance().unwrap();
    let sigma = SurfaceSigma::new(&view, &covariance, 0.3, ObjectNoise::Scanner(scanner)).unwrap();
    group.bench_function("10 M points, normals, scanner model", |b| {
        b.iter(|| sigma.fill(&xyz, Slopes::of(Some(&normals)), &mut out).unwrap());
    });
    group.finish();
}

criterion_group!(benches, adjustment, colour_sigma);
criterion_main!(benches);
