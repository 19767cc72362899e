//! The adjustment against itself: another parametrisation, another origin, another number of points.
#![allow(clippy::unwrap_used, missing_docs, reason = "a test")]

use colourreg::adjustment::*;
use colourreg::estimation::{FreeSet, SimilarityOptions, fit_similarity};
use colourreg::geometry::{Camera, Model, Pose, Similarity, View, rotation_exp};
use colourreg::{Error, Result};
use nalgebra::{DMatrix, DVector, SMatrix, SVector, Vector3};

/// Normal deviates that are the same everywhere (a linear congruence and Box-Muller).
struct Noise(u64);

impl Noise {
    fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        ((self.0 >> 11) as f64 + 0.5) / (1u64 << 53) as f64
    }

    fn normal(&mut self) -> f64 {
        (-2.0 * self.uniform().ln()).sqrt() * (std::f64::consts::TAU * self.uniform()).cos()
    }
}

struct Scene {
    view: View,
    xyz: Vec<[f64; 3]>,
    xy: Vec<[f64; 2]>,
    covariance_xyz: Vec<[[f64; 3]; 3]>,
    covariance_xy: Vec<[[f64; 2]; 2]>,
}

fn diagonal<const D: usize>(sigma: f64) -> [[f64; D]; D] {
    std::array::from_fn(|i| std::array::from_fn(|j| if i == j { sigma * sigma } else { 0.0 }))
}

/// A photo of points 8 to 20 m away, with noise in both.
fn scene(n: usize, origin: [f64; 3], noise: &mut Noise, sigma_xy: f64, sigma_xyz: f64) -> Scene {
    let camera =
        Camera::new(Model::OpenCv, 4000, 3000, &[3000.0, 3000.0, 1990.0, 1510.0, -0.05, 0.01, 5e-4, -3e-4, 0.0]);
    let rotation = rotation_exp(&Vector3::new(0.2, -0.3, 0.1));
    let pose = Pose { rotation, centre: Vector3::from(origin) };
    let view = View::new(camera.unwrap(), pose);
    let (mut xyz, mut xy) = (Vec::new(), Vec::new());
    for _ in 0..n {
        let (u, v, z) = (noise.uniform() - 0.5, 0.75 * (noise.uniform() - 0.5), 8.0 + 12.0 * noise.uniform());
        let p = rotation.transpose() * Vector3::new(1.2 * u * z, 1.2 * v * z, z);
        let exact: [f64; 3] = std::array::from_fn(|i| p[i] + origin[i]);
        let pixel = view.project(&exact).unwrap().0;
        xyz.push(exact.map(|x| x + sigma_xyz * noise.normal()));
        xy.push(pixel.map(|x| x + sigma_xy * noise.normal()));
    }
    Scene { view, xyz, xy, covariance_xyz: vec![diagonal(sigma_xyz); n], covariance_xy: vec![diagonal(sigma_xy); n] }
}

impl Scene {
    fn points(&self) -> ControlPoints<'_> {
        ControlPoints {
            xyz: &self.xyz,
            xy: &self.xy,
            covariance_xyz: &self.covariance_xyz,
            covariance_xy: &self.covariance_xy,
        }
    }

    fn adjust(&self, free: &FreeSet, options: &FullOptions) -> Result<ViewAdjustment> {
        adjust_view(&self.view, &self.points(), free, None, &[], options)
    }

    fn without(&self, i: usize) -> Self {
        let keep = |k: &usize| *k != i;
        let places: Vec<usize> = (0..self.xyz.len()).filter(keep).collect();
        Self {
            view: self.view,
            xyz: places.iter().map(|&k| self.xyz[k]).collect(),
            xy: places.iter().map(|&k| self.xy[k]).collect(),
            covariance_xyz: places.iter().map(|&k| self.covariance_xyz[k]).collect(),
            covariance_xy: places.iter().map(|&k| self.covariance_xy[k]).collect(),
        }
    }
}

fn quiet() -> FullOptions {
    FullOptions { snoop: false, ..FullOptions::default() }
}

/// A DLT by its twelve elements under ‖(h31 h32 h33)‖ = 1: another way to the same answer.
struct TwelveElements;

impl Conditions<2, 5> for TwelveElements {
    type State = [f64; 12];

    fn names(&self) -> Vec<String> {
        DLT_NAMES.iter().map(|n| (*n).into()).collect()
    }

    fn linearise(
        &self,
        h: &[f64; 12],
        l: &SVector<f64, 5>,
        design: Option<&mut Design<2>>,
    ) -> Option<Linearised<2, 5>> {
        let x = [l[2], l[3], l[4], 1.0];
        let row = |i: usize| (0..4).map(|k| h[4 * i + k] * x[k]).sum::<f64>();
        let (a, b, w) = (row(0), row(1), row(2));
        if w <= 0.0 {
            return None;
        }
        let pixel = [a / w, b / w];
        if let Some(rows) = design {
            for k in 0..4 {
                for i in 0..2 {
                    rows[i][4 * i + k] = x[k] / w;
                    rows[i][4 * (1 - i) + k] = 0.0;
                    rows[i][8 + k] = -pixel[i] * x[k] / w;
                }
            }
        }
        let mut by = SMatrix::<f64, 2, 5>::zeros();
        for i in 0..2 {
            by[(i, i)] = -1.0;
            for k in 0..3 {
                by[(i, 2 + k)] = (h[4 * i + k] - pixel[i] * h[8 + k]) / w;
            }
        }
        Some((SVector::from([pixel[0] - l[0], pixel[1] - l[1]]), by))
    }

    fn apply(&self, h: &[f64; 12], delta: &[f64]) -> Result<[f64; 12]> {
        Ok(std::array::from_fn(|i| h[i] + delta[i]))
    }

    fn constraints(&self, h: &[f64; 12]) -> Option<Constraints> {
        let square: f64 = h[8..11].iter().map(|x| x * x).sum();
        let mut jacobian = DMatrix::zeros(1, 12);
        for k in 8..11 {
            jacobian[(0, k)] = 2.0 * h[k];
        }
        Some(Constraints { value: DVector::from_element(1, square - 1.0), jacobian })
    }
}

#[test]
fn a_dlt_by_eleven_parameters_is_the_one_by_twelve_elements_and_a_constraint() {
    let mut noise = Noise(1);
    let mut scene = scene(20, [0.5, -0.25, 1.0], &mut noise, 0.7, 0.004);
    scene.view = View::from_dlt(&scene.view.matrix().unwrap(), 4000, 3000, &[0.0; 5]).unwrap();
    // Measured without distortion.
    for (xy, xyz) in scene.xy.iter_mut().zip(&scene.xyz) {
        *xy = scene.view.project(xyz).unwrap().0.map(|x| x + 0.7 * noise.normal());
    }
    let free = FreeSet::dlt::<&str>(&[]).unwrap();
    let eleven = scene.adjust(&free, &quiet()).unwrap();

    let start: Vec<f64> = scene.view.matrix().unwrap().into_iter().flatten().collect();
    // A start off the constraint is brought onto it.
    let start: [f64; 12] = std::array::from_fn(|i| 1.7 * start[i] + 1e-3 * noise.normal() * start[i]);
    let observed: Vec<Observed<5>> = (0..20)
        .map(|i| Observed {
            value: SVector::from_fn(|k, _| if k < 2 { scene.xy[i][k] } else { scene.xyz[i][k - 2] }),
            covariance: SMatrix::from_fn(|a, b| {
                if a != b {
                    0.0
                } else if a < 2 {
                    0.49
                } else {
                    16e-6
                }
            }),
        })
        .collect();
    let twelve = adjust(&TwelveElements, &start, &observed).unwrap();

    let h: Vec<f64> = eleven.view.matrix().unwrap().into_iter().flatten().collect();
    for k in 0..12 {
        assert!((h[k] - twelve.state[k]).abs() < 1e-7 * (1.0 + h[k].abs()), "{k} {} {}", h[k], twelve.state[k]);
    }
    assert!((eleven.adjusted.solution.omega / twelve.omega - 1.0).abs() < 1e-9);
    assert_eq!(eleven.adjusted.solution.dof, 40 - 11);
    assert_eq!(twelve.dof, 40 - 11);
    let (_, by_eleven) = eleven.covariance().unwrap().dlt_elements(&eleven.view).unwrap();
    let by_twelve = &twelve.cofactor * eleven.adjusted.scale;
    for i in 0..12 {
        for j in 0..12 {
            let size = (by_twelve[(i, i)] * by_twelve[(j, j)]).sqrt();
            assert!((by_eleven[(i, j)] - by_twelve[(i, j)]).abs() < 1e-5 * size, "{i} {j}");
        }
    }
}

#[test]
fn redundancy_numbers_add_up_to_the_redundancy() {
    let scene = scene(15, [0.0; 3], &mut Noise(2), 0.5, 0.003);
    let free = FreeSet::parse(Model::OpenCv, &["pose", "f", "pp"]).unwrap();
    let priors = ParameterPriors {
        names: vec!["cx".into(), "cy".into(), "cz_world".into()],
        values: vec![1990.0, 1510.0, 0.0],
        covariance: DMatrix::from_diagonal(&DVector::from_vec(vec![25.0, 25.0, 1e-4])),
    };
    let result = adjust_view(&scene.view, &scene.points(), &free, Some(&priors), &[], &quiet()).unwrap();
    let r = result.adjusted.redundancy;
    assert_eq!(result.adjusted.solution.dof, 30 + 3 - 9);
    assert!((r.predicted + r.given + r.priors - 24.0).abs() < 1e-6, "{r:?}");
    assert!(r.predicted > 0.0 && r.given > 0.0 && r.priors > 0.0);
}

#[test]
fn a_point_left_out_is_what_the_statistics_say_it_is() {
    let scene = scene(14, [0.0; 3], &mut Noise(3), 0.5, 0.003);
    let free = FreeSet::pose(Model::OpenCv);
    let all = scene.adjust(&free, &quiet()).unwrap();
    let omega = all.adjusted.solution.omega;
    for i in 0..14 {
        let rest = scene.without(i).adjust(&free, &quiet()).unwrap();
        let pixel = rest.view.project(&scene.xyz[i]).unwrap().0;
        let point = &all.adjusted.points[i].reliability;
        for k in 0..2 {
            let truth = pixel[k] - scene.xy[i][k];
            assert!((point.deleted[k] - truth).abs() < 0.01, "{i} {k}: {} {truth}", point.deleted[k]);
        }
        // T = Ω − Ω without the point; F is made of both.
        let f = (omega - rest.adjusted.solution.omega) / 2.0 / (rest.adjusted.solution.omega / 20.0);
        assert!((point.statistic / f - 1.0).abs() < 0.01, "{i}: {} {f}", point.statistic);
    }
}

#[test]
fn nothing_is_lost_at_large_coordinates() {
    let here = scene(12, [0.0; 3], &mut Noise(4), 0.5, 0.003);
    let there = scene(12, [456_789.0, 5_812_345.0, 143.0], &mut Noise(4), 0.5, 0.003);
    let free = FreeSet::parse(Model::OpenCv, &["pose", "f", "pp", "distortion"]).unwrap();
    let (a, b) = (here.adjust(&free, &quiet()).unwrap(), there.adjust(&free, &quiet()).unwrap());
    let moved = b.view.pose.centre - there.view.pose.centre - (a.view.pose.centre - here.view.pose.centre);
    assert!(moved.norm() < 1e-7, "{moved}");
    for k in 0..free.len() {
        let (x, y) = (a.adjusted.covariance[(k, k)], b.adjusted.covariance[(k, k)]);
        assert!((x / y - 1.0).abs() < 1e-5, "{k} {x} {y}");
    }
}

#[test]
fn the_number_of_threads_changes_no_bit() {
    let scene = scene(3000, [0.0; 3], &mut Noise(5), 0.5, 0.003);
    let free = FreeSet::parse(Model::OpenCv, &["pose", "f", "pp", "distortion"]).unwrap();
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| scene.adjust(&free, &quiet()).unwrap())
    };
    let (one, four) = (with(1), with(4));
    assert_eq!(one.view, four.view);
    assert_eq!(one.adjusted.covariance, four.adjusted.covariance);
    assert_eq!(one.adjusted.solution.omega.to_bits(), four.adjusted.solution.omega.to_bits());
}

#[test]
fn blunders_are_named_and_the_rest_is_as_if_they_had_never_been() {
    let mut scene = scene(20, [0.0; 3], &mut Noise(6), 0.5, 0.003);
    scene.xy[3][0] += 12.0;
    scene.xy[11][1] -= 30.0;
    scene.xyz[7][0] += 0.2;
    let free = FreeSet::pose(Model::OpenCv);
    let result = scene.adjust(&free, &FullOptions::default()).unwrap();
    let mut named: Vec<usize> = result.adjusted.rejected.iter().map(|r| r.point).collect();
    assert_eq!(named[0], 7);
    named.sort_unstable();
    assert_eq!(named, [3, 7, 11]);
    assert!(!result.adjusted.points[7].used && result.adjusted.points[7].reliability.p_value < 1e-3);
    let clean = scene.without(11).without(7).without(3).adjust(&free, &quiet()).unwrap();
    assert!((clean.view.pose.centre - result.view.pose.centre).norm() < 1e-9);
}

#[test]
fn snooping_many_points_is_adjusting_after_each_rejection() {
    // Of many points most rejections need no iteration: the answer is that of iterating after each.
    let mut random = Noise(11);
    let mut scene = scene(400, [0.0; 3], &mut random, 0.5, 0.003);
    for i in (0..400).step_by(23) {
        scene.xy[i][i % 2] += 2.0 + 40.0 * random.uniform().powi(3);
    }
    let free = FreeSet::parse(Model::OpenCv, &["pose", "f", "pp", "distortion"]).unwrap();
    for estimated in [true, false] {
        let options = |snoop: bool| {
            let mut options = FullOptions { snoop, ..FullOptions::default() };
            options.levels.estimated = estimated;
            options
        };
        let result = scene.adjust(&free, &options(true)).unwrap();
        assert!(result.adjusted.rejected.len() >= 10);
        let (mut left, mut numbers) = (scene.without(400), (0..400).collect::<Vec<usize>>());
        let mut rejected = result.adjusted.rejected.iter();
        let clean = loop {
            let again = left.adjust(&free, &options(false)).unwrap();
            let statistics = || again.adjusted.points.iter().map(|p| p.reliability.statistic);
            let worst = statistics().enumerate().max_by(|a, b| a.1.total_cmp(&b.1)).unwrap();
            if worst.1 <= again.adjusted.critical {
                break again;
            }
            let named = rejected.next().unwrap();
            assert_eq!(named.point, numbers.remove(worst.0));
            assert!((named.statistic / worst.1 - 1.0).abs() < 1e-3, "{} {}", named.statistic, worst.1);
            assert!((named.critical / again.adjusted.critical - 1.0).abs() < 1e-9);
            left = left.without(worst.0);
        };
        assert!(rejected.next().is_none());
        assert!((clean.view.pose.centre - result.view.pose.centre).norm() < 1e-9);
    }
}

#[test]
fn what_is_not_determined_is_refused_by_name() {
    let scene = scene(30, [0.0; 3], &mut Noise(7), 0.5, 0.003);
    let named = |error: Error, word: &str| {
        let text = error.to_string();
        assert!(matches!(error, Error::Degenerate { .. }) && text.contains(word), "{text}");
    };
    let few = Scene { xyz: scene.xyz[..2].to_vec(), ..scene };
    let few = Scene {
        xy: few.xy[..2].to_vec(),
        covariance_xy: few.covariance_xy[..2].to_vec(),
        covariance_xyz: few.covariance_xyz[..2].to_vec(),
        ..few
    };
    named(few.adjust(&FreeSet::pose(Model::OpenCv), &quiet()).err().unwrap(), "2 points do not determine 6 parameters");
    // One plane at right angles to the axis: focal length and distance are one.
    let mut flat = self::scene(30, [0.0; 3], &mut Noise(8), 0.5, 0.003);
    let pinhole = Camera::new(Model::Pinhole, 4000, 3000, &[3000.0, 3000.0, 1990.0, 1510.0]).unwrap();
    flat.view = View::new(pinhole, Pose::identity());
    for (i, (xyz, xy)) in flat.xyz.iter_mut().zip(&mut flat.xy).enumerate() {
        *xyz = [(i % 6) as f64 - 2.5, (i / 6) as f64 - 2.0, 10.0];
        *xy = flat.view.project(xyz).unwrap().0;
    }
    let free = FreeSet::parse(Model::Pinhole, &["pose", "f"]).unwrap();
    named(flat.adjust(&free, &quiet()).err().unwrap(), "cz_world, f");
    flat.view = View::from_dlt(&flat.view.matrix().unwrap(), 4000, 3000, &[0.0; 5]).unwrap();
    named(flat.adjust(&FreeSet::dlt::<&str>(&[]).unwrap(), &quiet()).err().unwrap(), "determine");
    // A point without any sigma.
    let mut certain = self::scene(5, [0.0; 3], &mut Noise(9), 0.5, 0.003);
    certain.covariance_xy[2] = diagonal(0.0);
    certain.covariance_xyz[2] = diagonal(0.0);
    let error = certain.adjust(&FreeSet::pose(Model::OpenCv), &quiet()).err().unwrap().to_string();
    assert!(error.contains("point 3"), "{error}");
}

#[test]
fn constraints_hold_exactly_and_priors_softly() {
    let scene = scene(10, [100.0, 200.0, 50.0], &mut Noise(10), 0.5, 0.003);
    let free = FreeSet::parse(Model::OpenCv, &["pose", "fx", "fy"]).unwrap();
    let tripod = [100.0, 200.0, 48.8];
    let constraints = [
        ViewConstraint::Linear { terms: vec![("fx".into(), 1.0), ("fy".into(), -1.0)], value: 0.0 },
        ViewConstraint::CentreDistance { point: tripod, distance: 1.2 },
    ];
    let result = adjust_view(&scene.view, &scene.points(), &free, None, &constraints, &quiet()).unwrap();
    let params = result.view.camera.params();
    assert!((params[0] - params[1]).abs() < 1e-8);
    assert!(((result.view.pose.centre - Vector3::from(tripod)).norm() - 1.2).abs() < 1e-9);
    assert_eq!(result.adjusted.solution.dof, 20 + 2 - 8);
    // Along the constrained directions nothing is uncertain.
    let c = &result.adjusted.covariance;
    assert!((c[(6, 6)] + c[(7, 7)] - 2.0 * c[(6, 7)]).abs() < 1e-9 * c[(6, 6)]);
    let twice = [constraints[0].clone(), constraints[0].clone()];
    let error = adjust_view(&scene.view, &scene.points(), &free, None, &twice, &quiet()).err().unwrap().to_string();
    assert!(error.contains("repeat"), "{error}");

    // A strong prior is nearly a constraint, a weak one nearly nothing.
    let free_pose = FreeSet::pose(Model::OpenCv);
    let with_sigma = |sigma: f64| {
        let priors = ParameterPriors {
            names: vec!["cx_world".into()],
            values: vec![100.05],
            covariance: DMatrix::from_element(1, 1, sigma * sigma),
        };
        adjust_view(&scene.view, &scene.points(), &free_pose, Some(&priors), &[], &quiet()).unwrap().view.pose.centre.x
    };
    let without = scene.adjust(&free_pose, &quiet()).unwrap().view.pose.centre.x;
    assert!((with_sigma(1e-7) - 100.05).abs() < 1e-6);
    assert!((with_sigma(1e3) - without).abs() < 1e-8);
}

#[test]
fn a_bad_start_is_reached_by_damping() {
    let mut scene = scene(15, [0.0; 3], &mut Noise(11), 0.5, 0.003);
    let free = FreeSet::parse(Model::OpenCv, &["pose", "f"]).unwrap();
    let good = scene.adjust(&free, &quiet()).unwrap();
    scene.view.pose = scene.view.pose.perturbed(&Vector3::new(0.3, -0.2, 0.4), &Vector3::new(-1.5, 1.0, -2.0));
    let again = scene.adjust(&free, &quiet()).unwrap();
    assert!((good.view.pose.centre - again.view.pose.centre).norm() < 1e-9);
}

#[test]
fn variance_components_find_wrong_sigmas() {
    // Near points show the object's noise, far ones the photo's.
    let mut noise = Noise(12);
    let n = 1500;
    let mut scene = scene(n, [0.0; 3], &mut noise, 0.5, 0.0);
    let range = |p: &[f64; 3]| (p[0] * p[0] + p[1] * p[1] + p[2] * p[2]).sqrt();
    for (i, p) in scene.xyz.iter_mut().enumerate() {
        // Half of the points stand much nearer.
        let factor = if i % 2 == 0 { 0.1 } else { 1.0 };
        *p = p.map(|x| x * factor + 0.001 * noise.normal());
    }
    assert!(scene.xyz.iter().any(|p| range(p) < 1.5));
    // Given: photo twice too good, object twice too bad.
    scene.covariance_xy = vec![diagonal(0.25); n];
    scene.covariance_xyz = vec![diagonal(0.002); n];
    let options = FullOptions { components: true, ..quiet() };
    let result = scene.adjust(&FreeSet::pose(Model::OpenCv), &options).unwrap();
    let found = result.adjusted.components.unwrap();
    for (g, truth) in [4.0, 0.25].into_iter().enumerate() {
        assert!((found.factors[g] - truth).abs() < 4.0 * found.sigmas[g], "{found:?}");
        assert!(found.sigmas[g] < 0.1 * truth, "{found:?}");
    }
    assert!((result.adjusted.solution.variance_factor().unwrap() - 1.0).abs() < 1e-3);
    // All points alike: one variance cannot be told from the other.
    let alike = Scene { covariance_xyz: vec![diagonal(0.0); n], ..scene };
    assert!(matches!(alike.adjust(&FreeSet::pose(Model::OpenCv), &options), Err(Error::Degenerate { .. })));
}

#[test]
fn similarities_in_both_dimensions() {
    let mut noise = Noise(13);
    let truth = Similarity {
        scale: 1.25,
        rotation: rotation_exp(&Vector3::new(0.5, -1.0, 2.0)),
        translation: Vector3::new(456_000.0, 5_800_000.0, 120.0),
    };
    let source: Vec<[f64; 3]> = (0..40).map(|_| std::array::from_fn(|_| 30.0 * noise.uniform())).collect();
    let target: Vec<[f64; 3]> = source.iter().map(|p| truth.apply(p).map(|x| x + 0.004 * noise.normal())).collect();
    let noisy: Vec<[f64; 3]> = source.iter().map(|p| p.map(|x| x + 0.003 * noise.normal())).collect();
    let (cs, ct) = (vec![diagonal::<3>(0.003); 40], vec![diagonal::<3>(0.004); 40]);
    let found = adjust_similarity::<3, 6>(&noisy, &target, &cs, &ct, &FullOptions::default()).unwrap();
    assert_eq!(found.adjusted.solution.dof, 120 - 7);
    let factor = found.adjusted.solution.variance_factor().unwrap();
    assert!((0.6..1.5).contains(&factor), "{factor}");
    let sigma = found.covariance[(0, 0)].sqrt();
    assert!((found.similarity.scale - 1.25).abs() < 4.0 * sigma && sigma < 1e-3);
    for (i, axis) in (4..7).enumerate() {
        let error = found.similarity.translation[i] - truth.translation[i];
        assert!(error.abs() < 4.0 * found.covariance[(axis, axis)].sqrt(), "{error}");
    }
    // In the plane all errors are alike, and the closed form is already the optimum.
    let flat = |points: &[[f64; 3]]| points.iter().map(|p| [p[0], p[1]]).collect::<Vec<[f64; 2]>>();
    let plane: Vec<[f64; 2]> = flat(&noisy)
        .iter()
        .map(|p| [-2.0 * p[1] + 5.0 + 0.01 * noise.normal(), 2.0 * p[0] + 0.01 * noise.normal()])
        .collect();
    let (cs, ct) = (vec![diagonal::<2>(0.0); 40], vec![diagonal::<2>(0.01); 40]);
    let found = adjust_similarity::<2, 4>(&flat(&noisy), &plane, &cs, &ct, &quiet()).unwrap();
    let closed = fit_similarity(&flat(&noisy), &plane, &SimilarityOptions::default()).unwrap().similarity();
    assert!((found.similarity.scale - closed.scale).abs() < 1e-12);
    assert!((found.similarity.translation - closed.translation).norm() < 1e-9);
    assert_eq!(found.adjusted.names, ["scale", "angle", "tx", "ty"]);
}
