use nalgebra::{Matrix2, Vector2, Vector3};

use super::*;

fn truth3() -> Similarity<3> {
    Similarity {
        scale: 1.7,
        rotation: rotation_exp(&Vector3::new(0.4, -1.9, 0.7)),
        translation: Vector3::new(-4.0, 0.5, 9.0),
    }
}

fn truth2() -> Similarity<2> {
    let (s, c) = 2.3f64.sin_cos();
    Similarity { scale: 0.6, rotation: Matrix2::new(c, -s, s, c), translation: Vector2::new(-4.0, 0.5) }
}

fn box_corners() -> Vec<[f64; 3]> {
    (0..8).map(|i| [f64::from(i & 1) * 4.0, f64::from(i >> 1 & 1) * 2.0, f64::from(i >> 2) * 3.0]).collect()
}

fn square() -> Vec<[f64; 2]> {
    vec![[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [0.0, 3.0], [1.0, 1.0]]
}

fn assert_same<const D: usize>(a: &Similarity<D>, b: &Similarity<D>, points: &[[f64; D]], tolerance: f64) {
    for p in points {
        let (pa, pb) = (SVector::from(a.apply(p)), SVector::from(b.apply(p)));
        assert!((pa - pb).amax() < tolerance, "{pa} {pb}");
    }
}

#[test]
fn exact_pairs_give_the_truth_in_both_ways() {
    let from = box_corners();
    let to: Vec<_> = from.iter().map(|p| truth3().apply(p)).collect();
    let options = SimilarityOptions::default();
    let closed = fit_similarity(&from, &to, &options).unwrap();
    assert_same(&closed.similarity(), &truth3(), &from, 1e-13);
    assert_eq!((closed.dof, closed.mirrored), (17, false));
    let start = Similarity { rotation: rotation_exp(&Vector3::new(0.3, -1.5, 0.4)), scale: 1.0, ..truth3() };
    let iterated = iterate_similarity(&from, &to, &start, &options).unwrap();
    assert_same(&iterated.similarity(), &truth3(), &from, 1e-12);
    assert!(iterated.iterations > 1);

    let from = square();
    let to: Vec<_> = from.iter().map(|p| truth2().apply(p)).collect();
    assert_same(&fit_similarity(&from, &to, &options).unwrap().similarity(), &truth2(), &from, 1e-13);
    let iterated =
        iterate_similarity(&from, &to, &Similarity::new(1.0, Matrix2::identity(), Vector2::zeros()).unwrap(), &options)
            .unwrap();
    assert_same(&iterated.similarity(), &truth2(), &from, 1e-12);
}

#[test]
fn large_coordinates_lose_nothing() {
    let shift = Vector3::new(456_789.0, 5_812_345.0, 143.0);
    let from: Vec<[f64; 3]> = box_corners();
    let noise = |i: usize| 0.001 * ((i * 7919) as f64 * 0.37).sin();
    let to: Vec<[f64; 3]> = from
        .iter()
        .enumerate()
        .map(|(i, p)| (SVector::from(truth3().apply(p)) + Vector3::repeat(noise(i))).into())
        .collect();
    let moved: Vec<[f64; 3]> = from.iter().map(|p| (SVector::from(*p) + shift).into()).collect();
    let options = SimilarityOptions::default();
    let here = fit_similarity(&from, &to, &options).unwrap();
    let there = fit_similarity(&moved, &to, &options).unwrap();
    assert!((here.rotation - there.rotation).amax() < 1e-9);
    assert!((here.sigma0 / there.sigma0 - 1.0).abs() < 1e-5);
    assert!((&here.covariance - &there.covariance).amax() < 1e-5 * here.covariance.amax());
}

#[test]
fn a_weight_of_zero_leaves_a_pair_out_and_two_copies_are_a_weight_of_two() {
    let from = box_corners();
    let noise = |i: usize, k: usize| 0.01 * ((i * 31 + k * 17) as f64).sin();
    let mut to: Vec<[f64; 3]> = from
        .iter()
        .enumerate()
        .map(|(i, p)| {
            let y = truth3().apply(p);
            std::array::from_fn(|k| y[k] + noise(i, k))
        })
        .collect();
    let mut weights = vec![1.0; 8];
    weights[2] = 2.0;
    let weighted =
        fit_similarity(&from, &to, &SimilarityOptions { weights: Some(&weights), fixed_scale: false }).unwrap();
    let (mut from2, mut to2) = (from.clone(), to.clone());
    from2.push(from[2]);
    to2.push(to[2]);
    let copied = fit_similarity(&from2, &to2, &SimilarityOptions::default()).unwrap();
    assert_same(&weighted.similarity(), &copied.similarity(), &from, 1e-13);

    to[5] = [99.0, 99.0, 99.0];
    weights = vec![1.0; 8];
    weights[5] = 0.0;
    let without =
        fit_similarity(&from, &to, &SimilarityOptions { weights: Some(&weights), fixed_scale: true }).unwrap();
    let (mut from3, mut to3) = (from.clone(), to.clone());
    from3.remove(5);
    to3.remove(5);
    let removed = fit_similarity(&from3, &to3, &SimilarityOptions { weights: None, fixed_scale: true }).unwrap();
    assert_same(&without.similarity(), &removed.similarity(), &from, 1e-13);
    assert_eq!(without.dof, removed.dof);
    assert!((without.sigma0 / removed.sigma0 - 1.0).abs() < 1e-12);
    assert_eq!(without.scale, 1.0);
}

#[test]
fn a_mirrored_frame_is_named_and_answered_with_a_rotation() {
    let from = box_corners();
    let to: Vec<_> = from.iter().map(|p| truth3().apply(&[p[0], p[1], -p[2]])).collect();
    let fit = fit_similarity(&from, &to, &SimilarityOptions::default()).unwrap();
    assert!(fit.mirrored);
    assert!((fit.rotation.determinant() - 1.0).abs() < 1e-12);
    // Points of one plane look the same from behind: there is nothing mirrored in them.
    let flat: Vec<_> = from.iter().map(|p| [p[0], p[1], 0.0]).collect();
    let to: Vec<_> = flat.iter().map(|p| truth3().apply(p)).collect();
    let fit = fit_similarity(&flat, &to, &SimilarityOptions::default()).unwrap();
    assert!(!fit.mirrored);
    assert_same(&fit.similarity(), &truth3(), &from, 1e-12);
}

#[test]
fn what_is_not_determined_is_refused_with_its_number() {
    let options = SimilarityOptions::default();
    let line: Vec<[f64; 3]> = (0..9).map(|i| [f64::from(i), 2.0 * f64::from(i) + 7.0, 5e6]).collect();
    let to: Vec<_> = line.iter().map(|p| truth3().apply(p)).collect();
    let message = fit_similarity(&line, &to, &options).unwrap_err().to_string();
    assert!(message.contains("collinear") && message.contains("1.000e-4"), "{message}");
    assert!(iterate_similarity(&line, &to, &truth3(), &options).is_err());
    let one_place = vec![[4.5e5, 5.8e6]; 5];
    let message = fit_similarity(&square(), &one_place, &options).unwrap_err().to_string();
    assert!(message.contains("coincide"), "{message}");
    let message = fit_similarity(&box_corners()[..2], &box_corners()[..2], &options).unwrap_err().to_string();
    assert!(message.contains("number of pairs is 2.000e0"), "{message}");
    let message = fit_similarity(&[[0.0, f64::NAN]], &[[0.0, 0.0]], &options).unwrap_err().to_string();
    assert!(message.contains("pair 0"), "{message}");
    let negative = SimilarityOptions { weights: Some(&[1.0, 1.0, -1.0, 1.0, 1.0]), fixed_scale: false };
    assert!(fit_similarity(&square(), &square(), &negative).unwrap_err().to_string().contains("pair 2"));
    assert!(fit_similarity(&square(), &square()[1..], &options).is_err());
}

#[test]
fn a_start_half_a_turn_away_ends_at_the_truth_or_says_that_it_did_not() {
    let from = square();
    let to: Vec<_> = from.iter().map(|p| truth2().apply(p)).collect();
    let opposite = Similarity { rotation: -truth2().rotation, ..truth2() };
    match iterate_similarity(&from, &to, &opposite, &SimilarityOptions::default()) {
        Ok(fit) => assert_same(&fit.similarity(), &truth2(), &from, 1e-12),
        Err(error) => assert!(matches!(error, Error::NotConverged { .. }), "{error}"),
    }
    // From the truth itself there is nothing to do.
    let fit = iterate_similarity(&from, &to, &truth2(), &SimilarityOptions::default()).unwrap();
    assert_same(&fit.similarity(), &truth2(), &from, 1e-12);
}
