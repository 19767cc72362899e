//! How far places in the image leave room between them.

use super::surface::MOST;

type Place = [f64; 2];

/// Exchanges of a corner after which a triangle that is still not empty is given up: it never takes more than a few.
const EXCHANGES: usize = 64;

fn minus(a: &Place, b: &Place) -> Place {
    [a[0] - b[0], a[1] - b[1]]
}

fn cross(a: &Place, b: &Place) -> f64 {
    a[0] * b[1] - a[1] * b[0]
}

fn square(a: &Place) -> f64 {
    a[0] * a[0] + a[1] * a[1]
}

/// From one place to the next one, the median: along a bar as on a wall, so that the space between bars stands out.
pub(super) fn spacing(places: &[Place]) -> f64 {
    let mut to_next = [f64::INFINITY; MOST];
    for i in 1..places.len() {
        for k in 0..i {
            let d = square(&minus(&places[i], &places[k]));
            to_next[i] = d.min(to_next[i]);
            to_next[k] = d.min(to_next[k]);
        }
    }
    to_next[..places.len()].select_nth_unstable_by(places.len() / 2, f64::total_cmp).1.sqrt()
}

/// The triangle of the places around the origin that no other lies in the circle of: Delaunay's.
#[derive(Debug, Clone, Copy)]
pub(super) struct Triangle {
    /// Numbers of the places at its corners.
    pub corners: [usize; 3],
    /// Barycentric coordinates of the origin.
    pub shares: [f64; 3],
    /// Of the circle.
    pub radius: f64,
}

/// A triangle of the places around the origin, which they have to surround: the first one, and those beside the direction
/// opposite to it.
fn around(places: &[Place]) -> Option<[usize; 3]> {
    let first = places.first()?;
    let (mut left, mut right) = (None::<usize>, None::<usize>);
    for (i, p) in places.iter().enumerate() {
        let side = cross(first, p);
        if side > 0.0 || (side == 0.0 && first[0] * p[0] + first[1] * p[1] < 0.0) {
            left = left.filter(|l| cross(&places[*l], p) <= 0.0).or(Some(i));
        } else if side < 0.0 {
            right = right.filter(|r| cross(&places[*r], p) >= 0.0).or(Some(i));
        }
    }
    Some([0, left?, right?])
}

/// Centre and squared radius of the circle through three places.
fn circle([a, b, c]: &[Place; 3]) -> Option<(Place, f64)> {
    let (u, v) = (minus(b, a), minus(c, a));
    let d = 2.0 * cross(&u, &v);
    let centre = [(v[1] * square(&u) - u[1] * square(&v)) / d, (u[0] * square(&v) - v[0] * square(&u)) / d];
    let radius = square(&centre);
    radius.is_finite().then_some(([a[0] + centre[0], a[1] + centre[1]], radius))
}

/// The triangle around the origin, which the places, nearest first, have to surround.
///
/// On the paraboloid z = x² + y² it is the lowest facet at the origin, a linear programme: the place deepest in the circle
/// takes the corner that the simplex method's ratios name, until none is inside.
pub(super) fn triangle(places: &[Place]) -> Option<Triangle> {
    let mut corners = around(places)?;
    for _ in 0..EXCHANGES {
        let at = corners.map(|i| places[i]);
        let (centre, radius) = circle(&at)?;
        let (mut deepest, mut nearest) = (corners[0], radius * (1.0 - 1e-9));
        for (i, p) in places.iter().enumerate() {
            let distance = square(&minus(p, &centre));
            if distance < nearest {
                (deepest, nearest) = (i, distance);
            }
        }
        // Barycentric coordinates in the triangle.
        let twice = cross(&minus(&at[1], &at[0]), &minus(&at[2], &at[0]));
        let share = |p: &Place, i: usize| cross(&minus(&at[(i + 1) % 3], p), &minus(&at[(i + 2) % 3], p)) / twice;
        let shares = [0, 1, 2].map(|i| share(&[0.0; 2], i));
        if nearest >= radius * (1.0 - 1e-9) {
            return Some(Triangle { corners, shares, radius: radius.sqrt() });
        }
        let new = [0, 1, 2].map(|i| share(&places[deepest], i));
        let leaves =
            (0..3).filter(|&i| new[i] > 0.0).min_by(|&a, &b| (shares[a] / new[a]).total_cmp(&(shares[b] / new[b])))?;
        corners[leaves] = deepest;
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    fn places(n: usize) -> Vec<Place> {
        let mut state = 7u64;
        let mut uniform = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1u64 << 53) as f64
        };
        (0..n).map(|_| [8.0 * uniform() - 4.0, 8.0 * uniform() - 4.0]).collect()
    }

    #[test]
    fn the_circle_is_that_of_the_only_empty_triangle_around_the_origin() {
        let all = places(4000);
        let mut found = 0;
        for set in all.chunks(20) {
            let mut empty = Vec::new();
            for i in 0..set.len() {
                for k in 0..i {
                    for m in 0..k {
                        let corners = [set[i], set[k], set[m]];
                        let turn = |a: &Place, b: &Place| cross(a, b) > 0.0;
                        let turns = [turn(&set[i], &set[k]), turn(&set[k], &set[m]), turn(&set[m], &set[i])];
                        let (centre, radius) = circle(&corners).unwrap();
                        let inside = set.iter().filter(|p| square(&minus(p, &centre)) < radius * (1.0 - 1e-9)).count();
                        if turns.iter().all(|t| *t == turns[0]) && inside == 0 {
                            empty.push(radius.sqrt());
                        }
                    }
                }
            }
            let mut nearest_first = set.to_vec();
            nearest_first.sort_by(|a, b| square(a).total_cmp(&square(b)));
            if let [radius] = empty[..] {
                found += 1;
                let found = triangle(&nearest_first).unwrap();
                assert!((found.radius - radius).abs() < 1e-9 * radius);
                let origin: f64 = (0..2)
                    .map(|axis| {
                        (0..3).map(|i| found.shares[i] * nearest_first[found.corners[i]][axis]).sum::<f64>().abs()
                    })
                    .sum();
                assert!(origin < 1e-9 && (found.shares.iter().sum::<f64>() - 1.0).abs() < 1e-12);
                assert!(found.shares.iter().all(|share| *share >= 0.0));
            }
        }
        assert!(found > 190, "{found}");
    }

    #[test]
    fn a_grid_leaves_the_same_everywhere_and_a_missing_row_more() {
        for (x, y) in [(0.5, 0.5), (0.01, 0.5), (0.3, 0.77), (0.999, 0.002)] {
            let grid: Vec<Place> =
                (-2..=3).flat_map(|i| (-2..=3).map(move |k| [f64::from(i) - x, f64::from(k) - y])).collect();
            let mut sorted = grid.clone();
            sorted.sort_by(|a, b| square(a).total_cmp(&square(b)));
            assert!((spacing(&sorted[..MOST]) - 1.0).abs() < 1e-12);
            assert!((triangle(&sorted[..MOST]).unwrap().radius - 0.5f64.sqrt()).abs() < 1e-9);
            sorted.retain(|p| (p[0] + x - 1.0).abs() > 0.5);
            assert!((triangle(&sorted).unwrap().radius - 1.25f64.sqrt()).abs() < 1e-9);
        }
    }
}
