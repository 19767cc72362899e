use nalgebra::Vector3;

use super::fit::apply;
use super::*;

/// Deterministic numbers, uniform and normal.
struct Numbers(u64);

impl Numbers {
    fn uniform(&mut self) -> f64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 >> 11) as f64 / (1u64 << 53) as f64
    }

    fn normal(&mut self) -> f64 {
        (-2.0 * (1.0 - self.uniform()).ln()).sqrt() * (std::f64::consts::TAU * self.uniform()).cos()
    }

    fn points(&mut self, n: usize) -> Vec<[f64; 2]> {
        (0..n).map(|_| [1200.0 * self.uniform(), 900.0 * self.uniform()]).collect()
    }

    fn noisy(&mut self, points: &[[f64; 2]], sigma: f64) -> Vec<[f64; 2]> {
        points.iter().map(|p| [p[0] + sigma * self.normal(), p[1] + sigma * self.normal()]).collect()
    }
}

const MOTIONS: [Motion; 5] =
    [Motion::Translation, Motion::Rigid, Motion::Similarity, Motion::Affine, Motion::Projective];

/// Some transformation of a family that moves points by a few pixels.
fn truth(motion: Motion) -> Matrix3<f64> {
    let (s, c) = 0.004f64.sin_cos();
    let shift = Matrix3::new(1.0, 0.0, 3.0, 0.0, 1.0, -2.0, 0.0, 0.0, 1.0);
    let turn = Matrix3::new(c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0);
    let scale = Matrix3::from_diagonal(&Vector3::new(1.003, 1.003, 1.0));
    let shear = Matrix3::new(1.002, 0.003, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0);
    let perspective = Matrix3::new(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 3e-6, -2e-6, 1.0);
    let h = match motion {
        Motion::Translation => shift,
        Motion::Rigid => shift * turn,
        Motion::Similarity => shift * turn * scale,
        Motion::Affine => shift * turn * scale * shear,
        Motion::Projective => shift * turn * scale * shear * perspective,
    };
    h / h[(2, 2)]
}

fn moved(h: &Matrix3<f64>, points: &[[f64; 2]]) -> Vec<[f64; 2]> {
    points.iter().map(|p| apply(h, p)).collect()
}

fn plain<'a>(source: &'a [[f64; 2]], target: &'a [[f64; 2]]) -> Sets<'a> {
    Sets { source, target, source_covariance: None, target_covariance: None }
}

/// The largest distance between where two transformations take points.
fn error(a: &Matrix3<f64>, b: &Matrix3<f64>, points: &[[f64; 2]]) -> f64 {
    let one = |p: &[f64; 2]| {
        let (p, q) = (apply(a, p), apply(b, p));
        (p[0] - q[0]).hypot(p[1] - q[1])
    };
    points.iter().map(one).fold(0.0, f64::max)
}

fn kinds(report: &Report) -> Vec<FindingKind> {
    report.findings.iter().map(|f| f.kind).collect()
}

#[test]
fn without_noise_every_family_and_variant_returns_the_truth() {
    let source = Numbers(1).points(1000);
    for motion in MOTIONS {
        let mut target = moved(&truth(motion), &source);
        target.reverse();
        for metric in [Metric::PointToPoint, Metric::PointToLine] {
            for (mutual, keep) in [(false, 1.0), (true, 1.0), (false, 0.8)] {
                let options = Options { motion, metric, mutual, keep, ..Options::default() };
                let report = run(&plain(&source, &target), &options).unwrap();
                let off = error(&report.transform, &truth(motion), &source);
                assert!(off < 1e-9, "{off} {motion:?} {metric:?} {mutual} {keep} {:?}", report.history);
                assert!(report.accepted(), "{motion:?} {metric:?} {:?} {:?}", report.reason, report.findings);
                assert!(report.pairs.iter().all(|[i, j]| i + j == 999));
                assert!(report.rms < 1e-9 && report.history.len() < 60);
            }
        }
    }
}

#[test]
fn it_starts_from_the_initial_transformation() {
    let source = Numbers(2).points(500);
    let far = Matrix3::new(0.0, -1.1, 3000.0, 1.1, 0.0, -500.0, 0.0, 0.0, 1.0);
    let target = moved(&(truth(Motion::Similarity) * far), &source);
    let options = Options { initial: far * -2.5, ..Options::default() };
    let report = run(&plain(&source, &target), &options).unwrap();
    assert!(report.accepted());
    assert!(error(&report.transform, &(truth(Motion::Similarity) * far), &source) < 1e-9);
    let lost = run(&plain(&source, &target), &Options::default());
    assert!(lost.is_err() || !lost.unwrap().accepted());
}

#[test]
fn outliers_are_gated_trimmed_or_not_mutual() {
    let mut numbers = Numbers(3);
    let inliers = numbers.points(800);
    let noisy = numbers.noisy(&inliers, 0.3);
    let (mut source, mut target) = (noisy, moved(&truth(Motion::Similarity), &inliers));
    target = numbers.noisy(&target, 0.3);
    // Points that have no partner, half as many as those that have.
    source.extend(numbers.points(400));
    target.extend(numbers.points(400));
    let gated = Options { threshold: Some(12.0), final_threshold: Some(1.5), ..Options::default() };
    let trimmed = Options { keep: 0.6, ..gated };
    let mutual = Options { mutual: true, ..gated };
    for options in [gated, trimmed, mutual] {
        let report = run(&plain(&source, &target), &options).unwrap();
        let inlier_pairs = report.pairs.iter().filter(|[i, j]| *i < 800 && i == j).count();
        assert!(error(&report.transform, &truth(Motion::Similarity), &inliers) < 0.1, "{options:?}");
        assert!(inlier_pairs as f64 > 0.95 * report.pairs.len() as f64);
        assert!(report.accepted(), "{:?}", report.findings);
        let thresholds: Vec<f64> = report.history.iter().map(|s| s.threshold).collect();
        assert_eq!(thresholds[0], 12.0);
        assert_eq!(*thresholds.last().unwrap(), 1.5);
        assert!(thresholds.windows(2).all(|w| w[1] <= w[0]));
    }
}

#[test]
fn covariances_gate_by_mahalanobis_distance_and_weigh() {
    let mut numbers = Numbers(4);
    let (n, h) = (600, truth(Motion::Affine));
    let base = numbers.points(n);
    // Every other source point is uncertain in x, the others in y; the target is good throughout.
    let sigma = |i: usize| if i.is_multiple_of(2) { [4.0, 0.1] } else { [0.1, 4.0] };
    let draw = |(i, p): (usize, &[f64; 2])| {
        let [sx, sy] = sigma(i);
        [p[0] + sx * numbers.normal(), p[1] + sy * numbers.normal()]
    };
    let source: Vec<[f64; 2]> = base.iter().enumerate().map(draw).collect();
    let target = moved(&h, &base);
    let covariance: Vec<[[f64; 2]; 2]> = (0..n).map(sigma).map(|[sx, sy]| [[sx * sx, 0.0], [0.0, sy * sy]]).collect();
    let options = Options { motion: Motion::Affine, residual_limit: 4.0, min_pairs: 20, ..Options::default() };
    let weighted = Sets { source_covariance: Some(&covariance), ..plain(&source, &target) };
    let weighted = run(&weighted, &options).unwrap();
    let unweighted = run(&plain(&source, &target), &options).unwrap();
    let (good, bad) = (error(&weighted.transform, &h, &base), error(&unweighted.transform, &h, &base));
    assert!(good < 0.15 && good < 0.3 * bad, "{good} {bad}");
    let right = weighted.pairs.iter().filter(|[i, j]| i == j).count() as f64;
    assert!(right > 0.97 * weighted.pairs.len() as f64 && right > 0.9 * n as f64, "{right}");
    assert!((weighted.sigma0 - 1.0).abs() < 0.15, "{}", weighted.sigma0);
    // A covariance of the target alone is as good where the motion is a small one.
    let other = Sets { target_covariance: Some(&covariance), ..plain(&source, &target) };
    let other = run(&other, &options).unwrap();
    assert!(error(&other.transform, &weighted.transform, &base) < 0.1);
}

/// Points along segments, at random places.
fn along(numbers: &mut Numbers, segments: &[[[f64; 2]; 2]], n: usize) -> Vec<[f64; 2]> {
    let mut points = Vec::new();
    for [a, b] in segments {
        for _ in 0..n {
            let t = numbers.uniform();
            points.push([a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1])]);
        }
    }
    points
}

#[test]
fn a_slide_along_a_line_is_named() {
    let mut numbers = Numbers(5);
    let lines = [[[0.0, 0.0], [600.0, 450.0]], [[100.0, 0.0], [700.0, 450.0]], [[0.0, 200.0], [600.0, 650.0]]];
    let source = along(&mut numbers, &lines, 400);
    let target = along(&mut numbers, &lines, 400);
    let (source, target) = (numbers.noisy(&source, 0.2), numbers.noisy(&target, 0.2));
    for metric in [Metric::PointToPoint, Metric::PointToLine] {
        for motion in [Motion::Translation, Motion::Rigid] {
            let options = Options { motion, metric, threshold: Some(20.0), ..Options::default() };
            let report = run(&plain(&source, &target), &options).unwrap();
            assert!(!report.accepted());
            assert!(kinds(&report).contains(&FindingKind::Ambiguous), "{motion:?} {metric:?} {:?}", report.findings);
            let text = report.findings.iter().find(|f| f.kind == FindingKind::Ambiguous).unwrap().to_string();
            assert!(
                ["(0.79", "(0.80"].iter().any(|d| text.contains(&format!("a slide along the direction {d}"))),
                "{text}"
            );
            // The covariance says the same.
            let [[xx, xy], [_, yy]] = report.covariance_at(&[[300.0, 300.0]])[0];
            let (a, b) = ([0.8, 0.6], [-0.6, 0.8]);
            let form = |v: [f64; 2]| v[0] * v[0] * xx + 2.0 * v[0] * v[1] * xy + v[1] * v[1] * yy;
            assert!(form(a) > 300.0 * form(b), "{} {}", form(a), form(b));
        }
    }
}

#[test]
fn a_turn_about_the_centre_of_a_circle_is_named() {
    let mut numbers = Numbers(6);
    let circle = |numbers: &mut Numbers| -> Vec<[f64; 2]> {
        (0..2000)
            .map(|_| (std::f64::consts::TAU * numbers.uniform()).sin_cos())
            .map(|(s, c)| [500.0 + 200.0 * c, 400.0 + 200.0 * s])
            .collect()
    };
    let (source, target) = (circle(&mut numbers), circle(&mut numbers));
    let options =
        Options { motion: Motion::Rigid, metric: Metric::PointToLine, threshold: Some(9.0), ..Options::default() };
    let report = run(&plain(&source, &target), &options).unwrap();
    let finding = report.findings.iter().find(|f| f.kind == FindingKind::Ambiguous).unwrap();
    assert!(finding.text.contains("a turn about (5") && finding.value < finding.limit, "{}", finding.text);
}

#[test]
fn a_wrong_shift_makes_the_scale_collapse_and_that_is_seen() {
    // The corner of two walls and a floor; the source begins far beside it.
    let mut numbers = Numbers(7);
    let mut wrong = 0;
    for trial in 0..20 {
        let source = numbers.points(400);
        let target: Vec<[f64; 2]> = numbers.noisy(&source, 0.3);
        let angle = f64::from(trial) * 0.31;
        let shift = [900.0 * angle.cos(), 900.0 * angle.sin()];
        let initial = Matrix3::new(1.0, 0.0, shift[0], 0.0, 1.0, shift[1], 0.0, 0.0, 1.0);
        for motion in [Motion::Similarity, Motion::Affine, Motion::Projective] {
            let options = Options { motion, initial, residual_limit: 20.0, ..Options::default() };
            let Ok(report) = run(&plain(&source, &target), &options) else { continue };
            if error(&report.transform, &Matrix3::identity(), &source) > 1.0 {
                wrong += 1;
                assert!(!report.accepted(), "{motion:?} {trial} {}", report.transform);
            }
        }
    }
    assert!(wrong > 30, "{wrong}");
}

#[test]
fn a_mirrored_result_is_seen() {
    let source = Numbers(8).points(300);
    let mirror = Matrix3::new(-1.0, 0.0, 1200.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0);
    let nearly = Matrix3::new(-1.0, 0.002, 1201.0, 0.001, 1.0, 1.0, 0.0, 0.0, 1.0);
    let target = moved(&mirror, &source);
    // Beginning mirrored is the caller's wish.
    let options = Options { motion: Motion::Affine, initial: nearly, ..Options::default() };
    let report = run(&plain(&source, &target), &options).unwrap();
    assert!(report.accepted() && error(&report.transform, &mirror, &source) < 1e-9);
}

#[test]
fn what_it_could_not_reach_is_the_reason_for_stopping() {
    let mut numbers = Numbers(9);
    let source = numbers.points(500);
    let target = numbers.noisy(&source, 2.0);
    let report = run(&plain(&source, &target), &Options { residual_limit: 0.5, ..Options::default() }).unwrap();
    assert_eq!(report.reason, Reason::ResidualsLarge);
    assert!(kinds(&report).contains(&FindingKind::NotConverged) && !report.accepted());
    let far = moved(&truth(Motion::Projective), &target);
    let report = run(&plain(&source, &far), &Options { max_iterations: 2, ..Options::default() }).unwrap();
    assert_eq!((report.reason, report.history.len()), (Reason::IterationLimit, 2));
    assert!(!report.accepted());
    // A tolerance of zero runs to the end.
    let exact = Options { change_tolerance: 0.0, max_iterations: 30, ..Options::default() };
    assert_eq!(run(&plain(&source, &target), &exact).unwrap().history.len(), 30);
}

#[test]
fn few_partners_and_few_pairs_are_different_things() {
    let mut numbers = Numbers(10);
    let inliers = numbers.points(60);
    let mut source = inliers.clone();
    source.extend(numbers.points(900).iter().map(|p| [p[0] + 5000.0, p[1]]));
    let options = Options { threshold: Some(5.0), ..Options::default() };
    let report = run(&plain(&source, &inliers), &options).unwrap();
    assert!(kinds(&report).contains(&FindingKind::FewPaired), "{:?}", report.findings);
    let away: Vec<[f64; 2]> = inliers.iter().map(|p| [p[0] + 4000.0, p[1]]).collect();
    let message = run(&plain(&away, &inliers), &options).unwrap_err().to_string();
    assert!(message.contains("iteration 1") && message.contains("pairs"), "{message}");
    assert!(run(&plain(&inliers[..5], &inliers), &options).is_err());
}

#[test]
fn the_covariance_of_the_parameters_is_that_of_the_moved_points() {
    let mut numbers = Numbers(11);
    let source = numbers.points(400);
    for motion in MOTIONS {
        let target = moved(&truth(motion), &source);
        let target = numbers.noisy(&target, 0.5);
        let report = run(&plain(&source, &target), &Options { motion, ..Options::default() }).unwrap();
        let point = [700.0, 200.0];
        // From parameters to the moved point, by differences.
        let build = |v: &[f64]| match motion {
            Motion::Translation => Matrix3::new(1.0, 0.0, v[0], 0.0, 1.0, v[1], 0.0, 0.0, 1.0),
            Motion::Rigid => {
                let (s, c) = v[0].sin_cos();
                Matrix3::new(c, -s, v[1], s, c, v[2], 0.0, 0.0, 1.0)
            }
            Motion::Similarity => {
                let (s, c) = v[1].sin_cos();
                Matrix3::new(v[0] * c, -v[0] * s, v[2], v[0] * s, v[0] * c, v[3], 0.0, 0.0, 1.0)
            }
            Motion::Affine => Matrix3::new(v[0], v[1], v[2], v[3], v[4], v[5], 0.0, 0.0, 1.0),
            Motion::Projective => Matrix3::new(v[0], v[1], v[2], v[3], v[4], v[5], v[6], v[7], 1.0),
        };
        assert!((build(&report.parameters) - report.transform).amax() < 1e-12, "{motion:?}");
        let n = motion.parameters();
        let mut jacobian = nalgebra::DMatrix::zeros(2, n);
        for k in 0..n {
            let step = 1e-6 * report.covariance[(k, k)].sqrt().max(1e-12) * 1e3;
            let at = |s: f64| {
                let mut v = report.parameters.clone();
                v[k] += s * step;
                apply(&build(&v), &point)
            };
            let (plus, minus) = (at(1.0), at(-1.0));
            for d in 0..2 {
                jacobian[(d, k)] = (plus[d] - minus[d]) / (2.0 * step);
            }
        }
        let through = &jacobian * &report.covariance * jacobian.transpose();
        let direct = report.covariance_at(&[point])[0];
        for i in 0..2 {
            for k in 0..2 {
                let size = direct[0][0].max(direct[1][1]);
                assert!((through[(i, k)] - direct[i][k]).abs() < 1e-4 * size, "{motion:?} {through} {direct:?}");
            }
        }
    }
}

#[test]
fn the_number_of_threads_changes_no_bit() {
    let mut numbers = Numbers(12);
    let source = numbers.points(20_000);
    let target = moved(&truth(Motion::Projective), &source);
    let target = numbers.noisy(&target, 0.4);
    let run_on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let options = Options { motion: Motion::Projective, metric: Metric::PointToLine, ..Options::default() };
        pool.install(|| run(&plain(&source, &target), &options).unwrap())
    };
    let (one, four) = (run_on(1), run_on(4));
    assert_eq!(one.transform, four.transform);
    assert_eq!(one.covariance, four.covariance);
    assert_eq!(one.history, four.history);
    assert_eq!(one.pairs, four.pairs);
}

#[test]
fn wishes_that_make_no_sense_are_refused() {
    let points = Numbers(13).points(50);
    let refuse = |options: Options, part: &str| {
        let message = run(&plain(&points, &points), &options).unwrap_err().to_string();
        assert!(message.contains(part), "{message}");
    };
    let usual = Options::default();
    refuse(Options { threshold: Some(-1.0), ..usual }, "threshold of -1");
    refuse(Options { threshold: Some(1.0), final_threshold: Some(2.0), ..usual }, "final threshold is 2");
    refuse(Options { reduction: 1.5, ..usual }, "reduction of the threshold of 1.5");
    refuse(Options { keep: 0.0, ..usual }, "part of pairs of 0");
    refuse(Options { gate_probability: 1.0, ..usual }, "gate probability");
    refuse(Options { initial: Matrix3::zeros(), ..usual }, "singular");
    refuse(Options { max_iterations: 0, ..usual }, "1 iteration");
    let bad = [[1.0, f64::NAN]];
    assert!(run(&plain(&bad, &points), &usual).unwrap_err().to_string().contains("source point 0"));
    assert!(run(&plain(&points, &[]), &usual).is_err() && run(&plain(&[], &points), &usual).is_err());
    let one = [[[1.0, 0.0], [0.0, 1.0]]];
    let sets = Sets { source_covariance: Some(&one), ..plain(&points, &points) };
    assert!(run(&sets, &usual).unwrap_err().to_string().contains("50 source points have 1 covariances"));
    let negative = vec![[[1.0, 2.0], [2.0, 1.0]]; 50];
    let sets = Sets { target_covariance: Some(&negative), ..plain(&points, &points) };
    assert!(run(&sets, &usual).unwrap_err().to_string().contains("target point 0"));
}

#[test]
fn goals_in_one_place_turn_nothing() {
    let mut numbers = Numbers(11);
    let source = numbers.points(500);
    let corner = [[1500.0, -300.0]];
    let options = Options {
        motion: Motion::Rigid,
        threshold: Some(1e4),
        reduction: 1.0,
        max_iterations: 1,
        ..Options::default()
    };
    let report = run(&plain(&source, &corner), &options).unwrap();
    assert_eq!(report.parameters[0], 0.0);
    let centre: [f64; 2] =
        std::array::from_fn(|d| moved(&report.transform, &source).iter().map(|p| p[d]).sum::<f64>() / 500.0);
    assert!((centre[0] - 1500.0).abs() < 1e-9 && (centre[1] + 300.0).abs() < 1e-9, "{centre:?}");
}

#[test]
fn pairs_keep_their_numbers_where_many_points_have_no_partner() {
    let mut numbers = Numbers(12);
    let source = numbers.points(20_001);
    let target: Vec<[f64; 2]> = source.iter().copied().step_by(2).collect();
    let options = Options {
        motion: Motion::Rigid,
        threshold: Some(1e-3),
        reduction: 1.0,
        max_iterations: 1,
        ..Options::default()
    };
    let mut pairs = run(&plain(&source, &target), &options).unwrap().pairs;
    pairs.sort_unstable();
    assert!(pairs.len() == target.len());
    assert!(pairs.iter().enumerate().all(|(k, pair)| *pair == [2 * k as u32, k as u32]));
}
