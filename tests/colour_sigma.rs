//! The fast figure of a point's colour position error against the formula, and the formula against brute force.
#![allow(clippy::unwrap_used, missing_docs, reason = "a test")]

use colourreg::adjustment::*;
use colourreg::colour::{Limits, VisibilityMap};
use colourreg::estimation::FreeSet;
use colourreg::geometry::{Camera, Model, Pose, View, rotation_exp};
use colourreg::render::{DepthBuffer, Footprint};
use nalgebra::Vector3;

struct Uniform(u64);

impl Uniform {
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        ((self.0 >> 11) as f64 + 0.5) / (1u64 << 53) as f64
    }

    fn direction(&mut self) -> Vector3<f64> {
        loop {
            let v = Vector3::new(2.0 * self.next() - 1.0, 2.0 * self.next() - 1.0, 2.0 * self.next() - 1.0);
            if v.norm() > 0.1 && v.norm() < 1.0 {
                return v.normalize();
            }
        }
    }
}

const CENTRE: [f64; 3] = [456_000.0, 5_810_000.0, 120.0];

fn view(model: Model) -> View {
    let (width, height) = (4000, 3000);
    let camera = match model {
        Model::Pinhole => Camera::new(model, width, height, &[3000.0, 2990.0, 1990.0, 1510.0]),
        Model::OpenCv => {
            Camera::new(model, width, height, &[2400.0, 2400.0, 1990.0, 1510.0, -0.1, 0.03, 1e-3, -5e-4, 0.0])
        }
        Model::FullOpenCv => {
            let params = [2400.0, 2400.0, 1990.0, 1510.0, -0.1, 0.03, 1e-3, -5e-4, 0.0, 0.01, 0.0, 0.0];
            Camera::new(model, width, height, &params)
        }
        Model::OpenCvFisheye => {
            Camera::new(model, width, height, &[900.0, 900.0, 1990.0, 1510.0, 0.01, -0.002, 0.0, 0.0])
        }
        Model::Equirectangular => Camera::new(model, 4000, 2000, &[]),
    };
    let rotation = rotation_exp(&Vector3::new(0.4, -1.3, 0.6));
    View::new(camera.unwrap(), Pose { rotation, centre: Vector3::from(CENTRE) })
}

/// Points that the view sees, at 3 to 60 m.
fn points(view: &View, n: usize, random: &mut Uniform) -> Vec<[f64; 3]> {
    let mut found = Vec::new();
    while found.len() < n {
        let xy =
            [f64::from(view.camera.width) * random.next() - 0.5, f64::from(view.camera.height) * random.next() - 0.5];
        let Some(ray) = view.ray(&xy) else { continue };
        let p = view.pose.centre + ray * (3.0 * 20f64.powf(random.next()));
        if view.project(&p.into()).is_some() {
            found.push(p.into());
        }
    }
    found
}

/// The covariance that control points at 15 to 25 m give: rotation and position compensate each other there.
fn estimated(view: &View, free: &FreeSet, random: &mut Uniform) -> ViewCovariance {
    let mut xyz = Vec::new();
    while xyz.len() < 25 {
        let xy =
            [f64::from(view.camera.width) * random.next() - 0.5, f64::from(view.camera.height) * random.next() - 0.5];
        let Some(ray) = view.ray(&xy) else { continue };
        xyz.push((view.pose.centre + ray * (15.0 + 10.0 * random.next())).into());
    }
    let xy: Vec<[f64; 2]> = xyz.iter().map(|p| view.project(p).unwrap().0).collect();
    let points = ControlPoints {
        xyz: &xyz,
        xy: &xy,
        covariance_xyz: &vec![[[9e-6, 0.0, 0.0], [0.0, 9e-6, 0.0], [0.0, 0.0, 9e-6]]; 25],
        covariance_xy: &vec![[[0.25, 0.0], [0.0, 0.25]]; 25],
    };
    let mut options = FullOptions { snoop: false, ..FullOptions::default() };
    options.levels.estimated = false;
    adjust_view(view, &points, free, None, &[], &options).unwrap().covariance().unwrap()
}

/// The fast figure of one point.
fn at(sigma: &SurfaceSigma, p: &[f64; 3], normal: Option<&[f64; 3]>) -> f64 {
    let mut out = [0.0f32];
    sigma.fill(std::slice::from_ref(p), Slopes::of(normal.map(std::slice::from_ref)), &mut out).unwrap();
    f64::from(out[0])
}

fn cases() -> Vec<(View, FreeSet)> {
    let mut cases = Vec::new();
    for model in [Model::Pinhole, Model::OpenCv, Model::FullOpenCv, Model::OpenCvFisheye, Model::Equirectangular] {
        cases.push((view(model), FreeSet::pose(model)));
    }
    cases.push((view(Model::OpenCv), FreeSet::parse(Model::OpenCv, &["pose", "f", "pp", "distortion"]).unwrap()));
    cases.push((
        view(Model::OpenCvFisheye),
        FreeSet::parse(Model::OpenCvFisheye, &["pose", "f", "pp", "distortion"]).unwrap(),
    ));
    let dlt = View::from_dlt(&view(Model::Pinhole).matrix().unwrap(), 4000, 3000, &[0.0; 5]).unwrap();
    cases.push((dlt, FreeSet::dlt(&["k1"]).unwrap()));
    cases
}

#[test]
fn the_fast_figure_is_the_formula_to_its_tolerance() {
    let mut random = Uniform(1);
    for (view, free) in cases() {
        let covariance = estimated(&view, &free, &mut random);
        let scanner = ScannerModel::new([CENTRE[0] + 2.0, CENTRE[1] - 3.0, CENTRE[2]], 0.004, 5e-5, 8e-5).unwrap();
        for (sigma_image, object) in [
            (0.3, ObjectNoise::Isotropic(0.002)),
            (0.0, ObjectNoise::Isotropic(0.0)),
            (0.3, ObjectNoise::Scanner(scanner)),
        ] {
            let sigma = SurfaceSigma::new(&view, &covariance, sigma_image, object).unwrap();
            assert!(sigma.exact_share() < 0.03, "{:?} {}", view.camera.model(), sigma.exact_share());
            for p in points(&view, 4000, &mut random) {
                let normal: [f64; 3] = (random.direction() * 3.0).into();
                let ray = (Vector3::from(p) - view.pose.centre).normalize();
                let cosine = ray.dot(&Vector3::from(normal).normalize()).abs();
                for n in [None, Some(&normal).filter(|_| cosine > 0.01)] {
                    let (fast, exact) = (at(&sigma, &p, n), sigma.exact(&p, n));
                    assert!(exact.is_finite() && exact >= 0.0);
                    assert!(
                        (fast - exact).abs() <= 2.0e-3 * exact,
                        "{:?} {:?} {fast} {exact}",
                        view.camera.model(),
                        free.names()
                    );
                }
            }
        }
    }
}

#[test]
fn the_formula_is_what_moved_views_do_to_the_point_on_the_surface() {
    // Brute force: move each parameter by its principal deviation, sample the colour where the point then falls, and
    // intersect the true ray of that pixel with the surface.
    let mut random = Uniform(2);
    for (view, free) in cases() {
        let covariance = estimated(&view, &free, &mut random);
        let sigma = SurfaceSigma::new(&view, &covariance, 0.0, ObjectNoise::Isotropic(0.0)).unwrap();
        let eigen = covariance.matrix().clone().symmetric_eigen();
        for p in points(&view, 40, &mut random) {
            let normal = random.direction();
            let ray = (Vector3::from(p) - view.pose.centre).normalize();
            if ray.dot(&normal).abs() < 0.2 {
                continue;
            }
            let mut square = 0.0;
            for k in 0..free.len() {
                let step = eigen.eigenvectors.column(k) * eigen.eigenvalues[k].max(0.0).sqrt() * 0.01;
                let mut at = [Vector3::zeros(); 2];
                for (place, sign) in at.iter_mut().zip([1.0, -1.0]) {
                    let delta: Vec<f64> = step.iter().map(|s| s * sign).collect();
                    let moved = free.apply(&view, &delta).unwrap();
                    let seen = view.ray(&moved.project(&p).unwrap().0).unwrap();
                    let arm = Vector3::from(p) - view.pose.centre;
                    *place = seen * (arm.dot(&normal) / seen.dot(&normal)) - arm;
                }
                square += ((at[0] - at[1]) / 0.02).norm_squared();
            }
            let brute = (0.5 * square).sqrt();
            let formula = sigma.exact(&p, Some(&normal.into()));
            assert!((formula / brute - 1.0).abs() < 1e-3, "{:?} {formula} {brute}", view.camera.model());
        }
    }
}

#[test]
fn what_is_not_seen_has_no_figure_and_a_slanted_surface_a_larger_one() {
    let view = view(Model::OpenCv);
    let covariance = estimated(&view, &FreeSet::pose(Model::OpenCv), &mut Uniform(3));
    let sigma = SurfaceSigma::new(&view, &covariance, 0.5, ObjectNoise::Isotropic(0.002)).unwrap();
    let ahead = view.ray(&[2000.0, 1500.0]).unwrap();
    let front: [f64; 3] = (view.pose.centre + ahead * 10.0).into();
    let behind: [f64; 3] = (view.pose.centre - ahead * 10.0).into();
    assert!(at(&sigma, &behind, None).is_nan() && sigma.exact(&behind, None).is_nan());
    assert!(at(&sigma, &CENTRE, None).is_nan());
    assert!(at(&sigma, &[f64::NAN; 3], None).is_nan());
    let facing: [f64; 3] = ahead.into();
    let slanted: [f64; 3] = (ahead + ahead.cross(&Vector3::z()).normalize() * 3.0).into();
    let none = at(&sigma, &front, None);
    assert!((at(&sigma, &front, Some(&facing)) / none - 1.0).abs() < 1e-6);
    assert!((at(&sigma, &front, Some(&[0.0; 3])) / none - 1.0).abs() < 1e-6);
    assert!(at(&sigma, &front, Some(&slanted)) > 1.5 * none);
    let mut out = vec![0.0f32; 3];
    sigma.fill(&[front, behind, front], Slopes::of(Some(&[facing, facing, slanted])), &mut out).unwrap();
    assert!(out[1].is_nan() && out[0] < out[2]);
    assert!(sigma.fill(&[front], Slopes::default(), &mut out).is_err());
    assert!(SurfaceSigma::new(&view, &covariance, -1.0, ObjectNoise::Isotropic(0.0)).is_err());
}

#[test]
fn planes_of_a_camera_that_looks_elsewhere_are_refused() {
    let views = [Model::Pinhole, Model::Equirectangular].map(view);
    let planes = views.each_ref().map(|view| {
        let buffer = DepthBuffer::new(*view).unwrap();
        buffer.add(&points(view, 1000, &mut Uniform(5)));
        VisibilityMap::new(buffer, &Footprint::default(), Limits::default()).unwrap().planes()
    });
    let looks = ["forward", "around"];
    for (this, view) in views.iter().enumerate() {
        let covariance = estimated(view, &FreeSet::pose(view.camera.model()), &mut Uniform(3));
        let sigma = SurfaceSigma::new(view, &covariance, 0.5, ObjectNoise::Isotropic(0.002)).unwrap();
        let xyz = points(view, 300, &mut Uniform(6));
        let mut out = vec![0.0f32; 300];
        for other in 0..2 {
            let slopes = Slopes { normals: None, planes: Some(&planes[other]) };
            let found = [sigma.fill(&xyz, slopes, &mut out), sigma.fill_where(&xyz, slopes, &[1; 300], 1, &mut out)];
            for found in found {
                if other == this {
                    found.unwrap();
                } else {
                    let wanted = format!("the planes are of another view, whose camera looks {}", looks[other]);
                    assert_eq!(found.unwrap_err().to_string(), wanted);
                }
            }
        }
        assert!(out.iter().all(|s| *s > 0.0));
    }
}
