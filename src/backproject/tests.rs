use nalgebra::{Matrix3, Vector4};

use super::*;
use crate::geometry::{Model, Pose, rotation_exp};

const WIDTH: usize = 150;
const HEIGHT: usize = 110;

fn pose() -> Pose {
    Pose { rotation: rotation_exp(&Vector3::new(0.2, -0.3, 0.1)), centre: Vector3::new(4.5e5, 5.8e6, 120.0) }
}

fn view(model: Model) -> View {
    let params: &[f64] = match model {
        Model::Pinhole => &[160.0, 162.0, 74.0, 56.0],
        Model::OpenCv => &[160.0, 162.0, 74.0, 56.0, -0.1, 0.02, 1e-3, -1e-3, 0.0],
        Model::FullOpenCv => &[160.0, 162.0, 74.0, 56.0, -0.1, 0.02, 1e-3, -1e-3, 0.0, 0.01, 0.0, 0.0],
        Model::OpenCvFisheye => &[70.0, 70.0, 74.5, 54.5, 0.01, -0.002, 0.0, 0.0],
        Model::Equirectangular => &[],
    };
    View::new(Camera::new(model, WIDTH as u32, HEIGHT as u32, params).unwrap(), pose())
}

const MODELS: [Model; 5] =
    [Model::Pinhole, Model::OpenCv, Model::FullOpenCv, Model::OpenCvFisheye, Model::Equirectangular];

/// Planes n·X = e in the camera frame; the nearest hit counts.
struct Scene(Vec<(Vector3<f64>, f64)>);

impl Scene {
    fn depth(&self, camera: &Camera, xy: &[f64; 2]) -> f64 {
        let Some(ray) = direction(camera, xy) else { return f64::NAN };
        let hits = self.0.iter().map(|(n, e)| e / n.dot(&ray)).filter(|d| *d > 0.0);
        hits.fold(f64::INFINITY, f64::min)
    }
}

/// A wall that is slanted, seen everywhere in front.
fn wall() -> Scene {
    Scene(vec![(Vector3::new(0.3, -0.2, 1.0), 12.0)])
}

/// Depths at pixel centres, measured where `keep` says so.
fn render(depth: impl Fn(&[f64; 2]) -> f64, keep: impl Fn(usize, usize) -> bool) -> (Vec<f64>, Vec<bool>) {
    let mut all = Vec::new();
    let mut measured = Vec::new();
    for y in 0..HEIGHT {
        for x in 0..WIDTH {
            let d = depth(&[x as f64, y as f64]);
            measured.push(d.is_finite() && keep(x, y));
            all.push(if measured[measured.len() - 1] { d } else { f64::NAN });
        }
    }
    (all, measured)
}

fn exact() -> BackprojectOptions {
    BackprojectOptions { depth_sigma: 0.0, pixel_sigma: 0.0, placement_sigma: 0.0, ..BackprojectOptions::default() }
}

fn image<'a>(depth: &'a [f64], measured: &'a [bool]) -> DepthImage<'a> {
    DepthImage { depth: Depths::Double(depth), measured, subpixel: None }
}

/// The largest distance between points and the truth, relative to the distance from the camera.
fn worst(view: &View, found: &[Backprojected], pixels: &[[f64; 2]], scene: &Scene) -> f64 {
    let one = |(f, xy): (&Backprojected, &[f64; 2])| {
        let ray = direction(&view.camera, xy).unwrap();
        let truth = Vector3::from(point(view, &ray, scene.depth(&view.camera, xy)));
        (Vector3::from(f.xyz) - truth).norm() / (truth - view.pose.centre).norm()
    };
    found.iter().zip(pixels).map(one).fold(0.0, f64::max)
}

#[test]
fn projected_points_come_back() {
    for model in MODELS {
        let view = view(model);
        let points: Vec<[f64; 3]> = (0..200)
            .map(|i| {
                let xy = [f64::from(i % 20) * 7.0 + 4.0, f64::from(i / 20) * 10.0 + 4.0];
                view.ray(&xy).map_or([f64::NAN; 3], |ray| (view.pose.centre + ray * (3.0 + f64::from(i))).into())
            })
            .filter(|p: &[f64; 3]| p[0].is_finite())
            .collect();
        let (xy, depth): (Vec<[f64; 2]>, Vec<f64>) = points.iter().map(|p| view.project(p).unwrap()).unzip();
        for (p, q) in points.iter().zip(backproject(&view, &xy, &depth).unwrap()) {
            let distance = (Vector3::from(*p) - view.pose.centre).norm();
            // Coordinates of seven digits are themselves rounded to a nanometre.
            assert!((Vector3::from(*p) - Vector3::from(q)).norm() < 1e-9 * distance + 2e-9, "{model:?}");
        }
    }
    let view = view(Model::Pinhole);
    let none = backproject(&view, &[[1.0, 1.0], [2.0, 2.0]], &[f64::NAN, -1.0]).unwrap();
    assert!(none.iter().flatten().all(|v| v.is_nan()));
    assert!(backproject(&view, &[[1.0, 1.0]], &[]).is_err());
}

#[test]
fn the_metric_third_row_makes_a_dlt_invertible() {
    let mut view = view(Model::Pinhole);
    view.pose.centre = Vector3::new(3.0, -2.0, 1.5);
    let skewed = view.camera.with_skew(1.3);
    let matrix = View::new(skewed, view.pose).matrix().unwrap();
    let some_scale = matrix.map(|row| row.map(|v| v * -0.037));
    let xy: Vec<[f64; 2]> = (0..60).map(|i| [f64::from(i) * 2.3, f64::from(i % 7) * 13.0]).collect();
    let depth: Vec<f64> = (0..60).map(|i| 2.0 + 0.7 * f64::from(i)).collect();
    let by_inverse = invert_dlt(&some_scale, &xy, &depth).unwrap();
    let by_pseudo_inverse = invert_dlt_by_pseudo_inverse(&some_scale, &xy, &depth).unwrap();
    let as_view = backproject(&View::from_dlt(&some_scale, 150, 110, &[0.0; 5]).unwrap(), &xy, &depth).unwrap();
    for i in 0..60 {
        let x = Vector3::from(by_inverse[i]);
        let range = (x - view.pose.centre).norm();
        assert!((x - Vector3::from(by_pseudo_inverse[i])).norm() < 1e-9 * range);
        assert!((x - Vector3::from(as_view[i])).norm() < 1e-9 * range);
        // And it projects to where it came from, its third coordinate being its depth.
        let p = Matrix3::from_fn(|r, c| matrix[r][c]) * x + Vector3::from_fn(|r, _| matrix[r][3]);
        assert!((p.z - depth[i]).abs() < 1e-9 * depth[i]);
        assert!((p.x / p.z - xy[i][0]).abs() < 1e-9 && (p.y / p.z - xy[i][1]).abs() < 1e-9);
        let homogeneous = Vector4::new(x.x, x.y, x.z, 1.0);
        assert!(homogeneous.iter().all(|v| v.is_finite()));
    }
}

#[test]
fn measured_and_interpolated_pixels_of_a_plane_are_exact_under_every_lens() {
    for model in MODELS {
        let view = view(model);
        let scene = wall();
        // A third of the pixels are measured, scattered over the image.
        let (depth, measured) = render(|xy| scene.depth(&view.camera, xy), |x, y| (x * 7 + y * 13 + x * y) % 3 == 0);
        let (index, found) = backproject_image(&view, &image(&depth, &measured), &exact()).unwrap();
        let pixels: Vec<[f64; 2]> = index.iter().map(|i| [f64::from(i % 150), f64::from(i / 150)]).collect();
        assert!(worst(&view, &found, &pixels, &scene) < 1e-9, "{model:?} {}", worst(&view, &found, &pixels, &scene));
        let count = |origin| found.iter().filter(|f| f.origin == origin).count();
        let (m, i) = (count(Origin::Measured), count(Origin::Interpolated));
        assert_eq!(m, measured.iter().filter(|m| **m).count());
        assert!(i > m && m > 500, "{model:?} {m} {i}");
        assert_eq!(count(Origin::Extended), 0);
        assert!(found.iter().all(|f| f.sigma_along < 1e-6 && f.sigma_across == 0.0));
    }
}

#[test]
fn the_true_places_of_points_in_their_pixels_are_used() {
    let view = view(Model::OpenCv);
    let scene = wall();
    let mut state = 1u64;
    let mut uniform = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 11) as f64 / (1u64 << 53) as f64 - 0.5
    };
    let subpixel: Vec<[f32; 2]> = (0..WIDTH * HEIGHT).map(|_| [uniform() as f32, uniform() as f32]).collect();
    let at = |xy: &[f64; 2]| {
        let s = subpixel[xy[1] as usize * WIDTH + xy[0] as usize];
        scene.depth(&view.camera, &[xy[0] + f64::from(s[0]), xy[1] + f64::from(s[1])])
    };
    let (depth, measured) = render(at, |x, y| (x + y) % 2 == 0);
    let with = DepthImage { subpixel: Some(&subpixel), ..image(&depth, &measured) };
    // Anywhere in the image, not at pixel centres alone.
    let pixels: Vec<[f64; 2]> = (0..500).map(|_| [75.0 + 140.0 * uniform(), 55.0 + 100.0 * uniform()]).collect();
    let found = backproject_pixels(&view, &with, &pixels, &exact()).unwrap();
    assert!(found.iter().all(|f| f.origin != Origin::None));
    assert!(worst(&view, &found, &pixels, &scene) < 1e-9, "{}", worst(&view, &found, &pixels, &scene));
    // Taken for the centres', the same depths are off by up to half a pixel on the slanted wall.
    let without = backproject_pixels(&view, &image(&depth, &measured), &pixels, &exact()).unwrap();
    assert!(worst(&view, &without, &pixels, &scene) > 1e-4);
}

/// A near wall in the left half, a far one behind it, with a hole of some columns at the edge.
fn step(camera: &Camera, edge: f64, near: f64, far: f64) -> impl Fn(&[f64; 2]) -> f64 {
    let plane = |e: f64| Scene(vec![(Vector3::new(0.1, 0.05, 1.0), e)]);
    let (near, far, camera) = (plane(near), plane(far), *camera);
    move |xy: &[f64; 2]| if xy[0] < edge { near.depth(&camera, xy) } else { far.depth(&camera, xy) }
}

#[test]
fn no_depth_is_made_across_an_edge() {
    let view = view(Model::Pinhole);
    for (near, far) in [(5.0, 10.0), (5.0, 5.5), (9.0, 9.4)] {
        let depth_at = step(&view.camera, 75.0, near, far);
        for hole in [0usize, 1, 2, 3, 4, 6] {
            let keep =
                |x: usize, y: usize| (x + 1 < 75 || x >= 75 + hole) && (x * 5 + y * 11 + x * y).is_multiple_of(2);
            let (depth, measured) = render(&depth_at, keep);
            let options = BackprojectOptions { depth_sigma: 0.005, extension: 3.0, ..BackprojectOptions::default() };
            let (index, found) = backproject_image(&view, &image(&depth, &measured), &options).unwrap();
            for (i, f) in index.iter().zip(&found) {
                let xy = [f64::from(i % 150), f64::from(i / 150)];
                let truth = depth_at(&xy);
                // In the hole either surface may be meant: what must not be is a depth between the two.
                let other = if xy[0] < 75.0 { truth * far / near } else { truth * near / far };
                let miss = (f.depth - truth).abs().min((f.depth - other).abs());
                assert!(miss < 0.02, "{near} {far} {hole} {xy:?} {} {truth} {other} {:?}", f.depth, f.origin);
                let in_the_hole = xy[0] >= 74.0 && xy[0] < 75.0 + hole as f64;
                // Within reach of both there is nothing to be extended.
                if in_the_hole && hole <= 4 {
                    assert_ne!(f.origin, Origin::Extended, "{near} {far} {hole} {xy:?}");
                }
            }
        }
    }
}

#[test]
fn a_surface_is_extended_beside_the_cloud_as_far_as_asked_for_and_says_how_sure_it_is() {
    let view = view(Model::OpenCv);
    let scene = wall();
    let (depth, measured) = render(|xy| scene.depth(&view.camera, xy), |x, y| x < 60 && (x + 2 * y) % 3 == 0);
    let options = BackprojectOptions { extension: 10.0, ..exact() };
    let (index, found) = backproject_image(&view, &image(&depth, &measured), &options).unwrap();
    let mut extended = 0;
    for (i, f) in index.iter().zip(&found) {
        let xy = [f64::from(i % 150), f64::from(i / 150)];
        assert!(worst(&view, &[*f], &[xy], &scene) < 1e-8);
        assert!(xy[0] < 70.0);
        if f.origin == Origin::Extended {
            extended += 1;
        }
    }
    assert!(extended > 700, "{extended}");
    // With noise the sigma grows with the distance from the cloud.
    let noisy = BackprojectOptions { depth_sigma: 0.01, ..options };
    let row = [[57.0, 50.0], [62.0, 50.0], [66.0, 50.0]];
    let found = backproject_pixels(&view, &image(&depth, &measured), &row, &noisy).unwrap();
    let sigmas: Vec<f64> = found.iter().map(|f| f.sigma_along).collect();
    assert_eq!(found[0].origin, Origin::Interpolated);
    assert!(sigmas[1] > 1.5 * sigmas[0] && sigmas[2] > 1.5 * sigmas[1], "{sigmas:?}");
    let none = backproject_pixels(&view, &image(&depth, &measured), &[[75.0, 50.0], [-3.0, 5.0]], &options).unwrap();
    assert!(none.iter().all(|f| f.origin == Origin::None && f.xyz[0].is_nan()));
}

#[test]
fn what_does_not_fit_the_view_is_refused() {
    let view = view(Model::Pinhole);
    let (depth, measured) = (vec![1.0; 10], vec![true; 10]);
    let message = backproject_image(&view, &image(&depth, &measured), &exact()).unwrap_err().to_string();
    assert!(message.contains("depths has 10 pixels") && message.contains("150 × 110"), "{message}");
    let (depth, measured) = render(|_| 1.0, |_, _| true);
    let wish = |options| backproject_image(&view, &image(&depth, &measured), &options).unwrap_err().to_string();
    assert!(wish(BackprojectOptions { radius: 0.0, ..exact() }).contains("radius"));
    assert!(wish(BackprojectOptions { depth_sigma: f64::NAN, ..exact() }).contains("depth sigma"));
    assert!(wish(BackprojectOptions { max_incidence: 2.0, ..exact() }).contains("incidence"));
    assert!(wish(BackprojectOptions { extension: -1.0, ..exact() }).contains("extension"));
}
