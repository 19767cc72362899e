use proptest::prelude::*;

use super::*;

fn brute<const D: usize>(points: &[[f64; D]], q: &[f64; D], max_distance: f64) -> Vec<Neighbour> {
    let mut all: Vec<Neighbour> = points
        .iter()
        .enumerate()
        .map(|(i, p)| Neighbour { index: i as u32, distance2: p.iter().zip(q).map(|(a, b)| (a - b).powi(2)).sum() })
        .filter(|n| n.distance2 <= max_distance * max_distance)
        .collect();
    all.sort_by(|a, b| a.distance2.total_cmp(&b.distance2).then(a.index.cmp(&b.index)));
    all
}

fn agree<const D: usize>(points: &[[f64; D]], queries: &[[f64; D]], k: usize, max_distance: f64) {
    let index = Neighbours::new(points).unwrap();
    let close = |a: f64, b: f64| a == b || (a - b).abs() <= 1e-12 * (a + b);
    let distance2 = |i: u32, q: &[f64; D]| points[i as usize].iter().zip(q).map(|(a, b)| (a - b).powi(2)).sum::<f64>();
    let nearest = index.nearest(queries, max_distance).unwrap();
    let several = index.k_nearest(queries, k, max_distance).unwrap();
    let within = index.within(queries, max_distance.min(1e3)).unwrap();
    for (i, q) in queries.iter().enumerate() {
        let expected = brute(points, q, max_distance);
        let first = expected.first().copied().unwrap_or(Neighbour::NONE);
        assert!(close(nearest[i].distance2, first.distance2), "{:?} {first:?}", nearest[i]);
        let row = &several[i * k..][..k];
        let mut seen = std::collections::HashSet::new();
        for (n, found) in row.iter().enumerate() {
            let e = expected.get(n).copied().unwrap_or(Neighbour::NONE);
            assert!(close(found.distance2, e.distance2), "k = {n}: {found:?} {e:?}");
            assert_eq!(found.index == NONE, e.index == NONE);
            if let Some(j) = found.found() {
                assert!(seen.insert(j), "{j} twice");
                assert!(close(distance2(found.index, q), found.distance2));
            }
        }
        let list = &within.neighbours[within.offsets[i]..within.offsets[i + 1]];
        let expected = brute(points, q, max_distance.min(1e3));
        assert_eq!(list.len(), expected.len());
        let mut indices: Vec<u32> = list.iter().map(|n| n.index).collect();
        let mut wanted: Vec<u32> = expected.iter().map(|n| n.index).collect();
        indices.sort_unstable();
        wanted.sort_unstable();
        assert_eq!(indices, wanted);
        assert!(list.windows(2).all(|w| w[0].distance2 <= w[1].distance2));
    }
}

/// Deterministic uniform numbers.
struct Numbers(u64);

impl Numbers {
    fn next(&mut self) -> f64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 >> 11) as f64 / (1u64 << 53) as f64
    }

    fn points<const D: usize>(&mut self, n: usize, size: f64) -> Vec<[f64; D]> {
        (0..n).map(|_| std::array::from_fn(|_| size * self.next())).collect()
    }
}

/// Multiples of ¼: every distance is exact, and many points and distances coincide.
fn lattice<const D: usize>(most: usize) -> impl Strategy<Value = Vec<[f64; D]>> {
    prop::collection::vec(prop::array::uniform((-40i32..40).prop_map(|v| f64::from(v) * 0.25)), 1..most)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn plane_agrees_with_brute_force(points in lattice::<2>(400), queries in lattice::<2>(60), k in 1usize..20, r in 0i32..40) {
        agree(&points, &queries, k, f64::from(r) * 0.25);
        agree(&points, &queries, k, f64::INFINITY);
    }

    #[test]
    fn space_agrees_with_brute_force(points in lattice::<3>(400), queries in lattice::<3>(60), k in 1usize..20, r in 0i32..40) {
        agree(&points, &queries, k, f64::from(r) * 0.25);
        agree(&points, &queries, k, f64::INFINITY);
    }

    #[test]
    fn ties_in_the_grid_go_to_the_lower_index(points in lattice::<2>(400), queries in lattice::<2>(60)) {
        if let Some(grid) = Grid::new(&points) {
            for q in &queries {
                if let Some(found) = grid.nearest(q, Neighbour::NONE) {
                    prop_assert_eq!(found, brute(&points, q, f64::INFINITY)[0]);
                }
            }
        }
    }
}

#[test]
fn many_queries_in_their_own_order_agree() {
    let mut numbers = Numbers(7);
    let (points, queries) = (numbers.points::<2>(3000, 100.0), numbers.points::<2>(5000, 130.0));
    assert!(Grid::new(&points).is_some());
    agree(&points, &queries, 5, f64::INFINITY);
    agree(&points, &queries, 3, 1.5);
    let (points, queries) = (numbers.points::<3>(1500, 100.0), numbers.points::<3>(5000, 130.0));
    agree(&points, &queries, 5, f64::INFINITY);
}

#[test]
fn clusters_far_queries_and_lines_agree() {
    let mut numbers = Numbers(11);
    // Half of the points within a millionth of the rest's extent.
    let mut clustered = numbers.points::<2>(1000, 1e-3);
    clustered.extend(numbers.points::<2>(1000, 1e3));
    assert!(Grid::new(&clustered).is_none());
    let far = [[-1e5, 3.0], [1e5, 1e5], [500.0, 500.0], [0.0005, 0.0005], [1e9, -1e9]];
    agree(&clustered, &far, 4, f64::INFINITY);
    let even = numbers.points::<2>(2000, 1e3);
    agree(&even, &far, 4, f64::INFINITY);
    let axis: Vec<[f64; 2]> = (0..500).map(|_| [numbers.next() * 9.0, 4.0]).collect();
    agree(&axis, &numbers.points::<2>(100, 9.0), 4, 2.0);
    let diagonal: Vec<[f64; 2]> = (0..500).map(|_| numbers.next()).map(|v| [v * 9.0, v * 9.0]).collect();
    agree(&diagonal, &numbers.points::<2>(100, 9.0), 4, 2.0);
    // Points on a few slanted lines crowd in few cells: the cells become smaller.
    let strokes: Vec<[f64; 2]> = (0..3000)
        .map(|i| (f64::from(i % 7), numbers.next()))
        .map(|(line, t)| [300.0 * t, 90.0 * line + 60.0 * t])
        .collect();
    assert!(Grid::new(&strokes).is_some());
    agree(&strokes, &numbers.points::<2>(5000, 600.0), 4, f64::INFINITY);
    let utm: Vec<[f64; 2]> = numbers.points::<2>(900, 90.0).iter().map(|p| [p[0] + 4.5e5, p[1] + 5.8e6]).collect();
    let queries: Vec<[f64; 2]> = numbers.points::<2>(90, 90.0).iter().map(|p| [p[0] + 4.5e5, p[1] + 5.8e6]).collect();
    agree(&utm, &queries, 4, f64::INFINITY);
}

#[test]
fn points_that_coincide_agree_and_are_not_slow() {
    let mut numbers = Numbers(13);
    let mut points = vec![[0.0; 3]; 300];
    points.extend(numbers.points::<3>(200, 5.0));
    points.extend(vec![[1.0, 2.0, 3.0]; 150]);
    agree(&points, &[[0.0; 3], [1.0, 2.0, 3.0], [2.0; 3], [0.1; 3]], 7, f64::INFINITY);
    agree(&points, &[[0.0; 3], [1.0, 2.0, 3.0], [2.0; 3], [0.1; 3]], 400, 2.0);
    // Misses of a scanner, all at the origin: looking at each of them for each would take minutes.
    let misses = vec![[0.0; 3]; 200_000];
    let index = Neighbours::new(&misses).unwrap();
    assert!(index.nearest(&misses, 1.0).unwrap().iter().all(|n| *n == Neighbour { index: 0, distance2: 0.0 }));
}

#[test]
fn the_number_of_threads_changes_nothing() {
    let mut numbers = Numbers(17);
    let coarse = |p: [f64; 3]| p.map(|v| v.round() * 0.5);
    let points: Vec<_> = numbers.points::<3>(60_000, 40.0).into_iter().map(coarse).collect();
    let queries: Vec<_> = numbers.points::<3>(6_000, 40.0).into_iter().map(coarse).collect();
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| Neighbours::new(&points).unwrap().k_nearest(&queries, 6, 3.0).unwrap())
    };
    assert_eq!(run(1), run(4));
}

#[test]
fn what_cannot_be_searched_is_refused() {
    let message = |e: Result<Neighbours<2>>| e.err().unwrap().to_string();
    assert!(message(Neighbours::new(&[])).contains("no point"));
    assert!(message(Neighbours::new(&[[0.0, 1.0], [0.0, f64::NAN]])).contains("point 1 is not finite"));
    let index = Neighbours::new(&[[0.0, 1.0]]).unwrap();
    assert!(index.nearest(&[[f64::INFINITY, 0.0]], 1.0).unwrap_err().to_string().contains("query 0"));
    assert!(index.nearest(&[[0.0, 0.0]], f64::NAN).is_err());
    assert!(index.nearest(&[[0.0, 0.0]], -1.0).is_err());
    assert!(index.k_nearest(&[[0.0, 0.0]], 0, 1.0).is_err());
    assert_eq!(index.nearest(&[], 1.0).unwrap(), vec![]);
}

#[test]
fn a_known_neighbour_changes_nothing_but_the_time() {
    let mut numbers = Numbers(19);
    let points = numbers.points::<2>(2000, 100.0);
    let index = Neighbours::new(&points).unwrap();
    for (i, q) in numbers.points::<2>(500, 120.0).iter().enumerate() {
        let p = points[i];
        let known = Neighbour { index: i as u32, distance2: (p[0] - q[0]).powi(2) + (p[1] - q[1]).powi(2) };
        assert_eq!(index.nearest_from(q, known), index.nearest_one(q, f64::INFINITY));
    }
}

#[test]
fn far_queries_are_answered_and_nothing_is_nearer_than_the_rest() {
    // A crowded strip in a wide, nearly empty field: the cells are small, and most of the field is far from all points.
    let mut numbers = Numbers(7);
    let mut points: Vec<[f64; 2]> = (0..3000).map(|i| [f64::from(i) / 3.0, 500.0 + 30.0 * numbers.next()]).collect();
    points.extend((0..100).map(|_| [1000.0 * numbers.next(), 1000.0 * numbers.next()]));
    points.push(points[17]);
    let index = Neighbours::new(&points).unwrap();
    assert!(index.grid.is_some());
    for _ in 0..2000 {
        let q = [1400.0 * numbers.next() - 200.0, 1400.0 * numbers.next() - 200.0];
        let all = brute(&points, &q, f64::INFINITY);
        let limit2 = if numbers.next() < 0.5 { f64::INFINITY } else { 2.0 * numbers.next() * all[0].distance2 };
        let known = all[..5].iter().find(|n| n.distance2 <= limit2 && numbers.next() < 0.2);
        let none = Neighbour { index: NONE, distance2: limit2 };
        let (found, rest2) = index.nearest_and_rest(&q, *known.unwrap_or(&none));
        let below = |value: f64, bound: f64| value <= bound * (1.0 + 1e-12);
        if all[0].distance2 <= limit2 {
            assert!(below(found.distance2, all[0].distance2), "{found:?} {all:?}");
            assert!(below(rest2, all[1].distance2));
        } else {
            assert!(found == Neighbour::NONE && below(rest2, all[0].distance2));
        }
        assert!(below(index.nearest_one(&q, f64::INFINITY).distance2, all[0].distance2));
    }
    assert!(index.coarse.get().is_some(), "no query was far");
}
