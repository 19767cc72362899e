//! Where a polynomial first crosses zero: the edge of a distortion model's valid field.

/// The smallest `s > 0` at which the polynomial `c[0] + c[1] s + c[2] s² + …` turns negative, or `None`.
///
/// Between two neighbouring roots of its derivative a polynomial is monotone, so that bisection cannot miss a crossing
/// (a fixed grid can miss two that lie close together). `c[0]` has to be positive.
pub(super) fn first_positive_crossing(c: &[f64]) -> Option<f64> {
    positive_roots(c).into_iter().next()
}

/// All positive real roots at which the sign changes, ascending.
fn positive_roots(c: &[f64]) -> Vec<f64> {
    let degree = match c.iter().rposition(|&v| v != 0.0) {
        None | Some(0) => return Vec::new(),
        Some(degree) => degree,
    };
    let c = &c[..=degree];
    if degree == 1 {
        let root = -c[0] / c[1];
        return if root > 0.0 { vec![root] } else { Vec::new() };
    }
    let derivative: Vec<f64> = c.iter().enumerate().skip(1).map(|(i, v)| i as f64 * v).collect();
    // Cauchy's bound: no root lies beyond it.
    let bound = 1.0 + c[..degree].iter().map(|v| (v / c[degree]).abs()).fold(0.0, f64::max);
    let mut borders = vec![0.0];
    borders.extend(positive_roots(&derivative));
    borders.push(bound);
    borders.windows(2).filter_map(|w| bisect(c, w[0], w[1])).collect()
}

fn evaluate(c: &[f64], s: f64) -> f64 {
    c.iter().rev().fold(0.0, |sum, v| sum * s + v)
}

fn bisect(c: &[f64], mut low: f64, mut high: f64) -> Option<f64> {
    let low_is_positive = evaluate(c, low) > 0.0;
    if low_is_positive == (evaluate(c, high) > 0.0) {
        return None;
    }
    for _ in 0..200 {
        let middle = 0.5 * (low + high);
        if middle <= low || middle >= high {
            break;
        }
        if low_is_positive == (evaluate(c, middle) > 0.0) { low = middle } else { high = middle }
    }
    Some(0.5 * (low + high))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn finds_the_first_of_several_crossings() {
        // (1 - s)(2 - s)(3 - s) = 6 - 11 s + 6 s² - s³
        let s = first_positive_crossing(&[6.0, -11.0, 6.0, -1.0]).unwrap();
        assert!((s - 1.0).abs() < 1e-12, "{s}");
    }

    #[test]
    fn finds_two_crossings_that_a_grid_would_step_over() {
        // (1 - s)(1.0001 - s), positive at 0
        let s = first_positive_crossing(&[1.0001, -2.0001, 1.0]).unwrap();
        assert!((s - 1.0).abs() < 1e-9, "{s}");
    }

    #[test]
    fn says_none_where_the_polynomial_stays_positive() {
        assert_eq!(first_positive_crossing(&[1.0, 0.3, 0.0, 0.2]), None);
        assert_eq!(first_positive_crossing(&[1.0]), None);
        assert_eq!(first_positive_crossing(&[1.0, 0.0, 0.0]), None);
    }
}
