//! The two RMS figures of the conventions, never mixed.

/// How well pixels agree.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rms {
    /// √(Σ(vx² + vy²) / 2n): per coordinate.
    pub rms: f64,
    /// √(Σ(vx² + vy²) / n): radial.
    pub rmse: f64,
    /// √(Σ vx² / n).
    pub rms_x: f64,
    /// √(Σ vy² / n).
    pub rms_y: f64,
}

impl Rms {
    /// Of residuals; NaN where there are none.
    pub fn of<'a>(residuals: impl IntoIterator<Item = &'a [f64; 2]>) -> Self {
        let (mut n, mut xx, mut yy) = (0.0, 0.0, 0.0);
        for v in residuals {
            n += 1.0;
            xx += v[0] * v[0];
            yy += v[1] * v[1];
        }
        Self {
            rms: ((xx + yy) / (2.0 * n)).sqrt(),
            rmse: ((xx + yy) / n).sqrt(),
            rms_x: (xx / n).sqrt(),
            rms_y: (yy / n).sqrt(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_source_papers_figures_are_per_coordinate() {
        let rms = Rms::of(&[[16.5, 2.5], [-16.5, -2.5]]);
        assert!((rms.rms - 11.8).abs() < 0.01 && (rms.rmse - 16.69).abs() < 0.01);
        assert_eq!((rms.rms_x, rms.rms_y), (16.5, 2.5));
        assert!(Rms::of(&[]).rms.is_nan());
    }
}
