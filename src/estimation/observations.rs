//! What was measured: pixels of known points, and how precise each is.

use std::borrow::Cow;
use std::sync::OnceLock;

use nalgebra::Vector3;

use super::batch::{Batch, FlatView, LANES, batches};
use crate::error::{Error, Result};
use crate::geometry::View;

/// The precision of measured pixels, kept as the upper triangular factor W with WᵀW = Σ⁻¹: a misclosure v becomes W v,
/// whose two components are independent with sigma 1.
#[derive(Debug, Clone, PartialEq)]
pub enum Precision {
    /// One sigma for every coordinate, pixels.
    Same(f64),
    /// The factor (w11, w12, w22) of each point.
    Each(Vec<[f64; 3]>),
}

impl Precision {
    /// One sigma for all.
    pub fn from_sigma(sigma: f64) -> Result<Self> {
        check_sigma(sigma, "sigma_xy")?;
        Ok(Self::Same(sigma))
    }

    /// A sigma in x and one in y for each point.
    pub fn from_sigmas(sigmas: &[[f64; 2]]) -> Result<Self> {
        for (i, s) in sigmas.iter().enumerate() {
            check_sigma(s[0], &format!("sigma_xy of point {i} in x"))?;
            check_sigma(s[1], &format!("sigma_xy of point {i} in y"))?;
        }
        // Sigmas that are all the same are one sigma.
        if let Some(first) = sigmas.first()
            && sigmas.iter().flatten().all(|s| *s == first[0])
        {
            return Ok(Self::Same(first[0]));
        }
        Ok(Self::Each(sigmas.iter().map(|s| [1.0 / s[0], 0.0, 1.0 / s[1]]).collect()))
    }

    /// A covariance [[xx, xy], [yx, yy]] for each point, px².
    pub fn from_covariances(covariances: &[[f64; 4]]) -> Result<Self> {
        let mut factors = Vec::with_capacity(covariances.len());
        for (i, c) in covariances.iter().enumerate() {
            let det = c[0] * c[3] - c[1] * c[2];
            let symmetric = (c[1] - c[2]).abs() <= 1e-9 * (c[0].abs() + c[3].abs());
            let definite = c[0] > 0.0 && c[3] > 0.0 && det > 1e-12 * c[0] * c[3] && det.is_finite();
            if !symmetric || !definite {
                return Err(Error::invalid(format!(
                    "the covariance of point {i} is not symmetric and positive definite: {c:?}"
                )));
            }
            // Σ⁻¹ = WᵀW with W upper triangular.
            let w11 = (c[3] / det).sqrt();
            factors.push([w11, -c[1] / det / w11, 1.0 / c[3].sqrt()]);
        }
        Ok(Self::Each(factors))
    }

    /// The misclosure of point `i` in sigmas.
    #[inline(always)]
    pub fn whiten(&self, i: usize, v: [f64; 2]) -> [f64; 2] {
        match self {
            Self::Same(sigma) => [v[0] / sigma, v[1] / sigma],
            Self::Each(factors) => {
                let [a, b, c] = factors[i];
                [a * v[0] + b * v[1], c * v[1]]
            }
        }
    }

    /// The covariance (xx, xy, yy) of point `i`, px².
    pub fn covariance(&self, i: usize) -> [f64; 3] {
        match self {
            Self::Same(sigma) => [sigma * sigma, 0.0, sigma * sigma],
            Self::Each(factors) => {
                let [a, b, c] = factors[i];
                // Σ = W⁻¹ W⁻ᵀ
                let (p, q, r) = (1.0 / a, -b / (a * c), 1.0 / c);
                [p * p + q * q, q * r, r * r]
            }
        }
    }

    /// The geometric mean of the sigmas, pixels.
    pub fn typical_sigma(&self) -> f64 {
        match self {
            Self::Same(sigma) => *sigma,
            Self::Each(factors) if factors.is_empty() => 1.0,
            Self::Each(factors) => {
                let sum: f64 = factors.iter().map(|f| (f[0] * f[2]).ln()).sum();
                (-0.5 * sum / factors.len() as f64).exp()
            }
        }
    }

    /// The precision of some of the points.
    pub fn select(&self, indices: &[usize]) -> Self {
        match self {
            Self::Same(sigma) => Self::Same(*sigma),
            Self::Each(factors) => Self::Each(indices.iter().map(|&i| factors[i]).collect()),
        }
    }
}

fn check_sigma(sigma: f64, name: &str) -> Result<()> {
    if sigma > 0.0 && sigma.is_finite() {
        return Ok(());
    }
    Err(Error::invalid(format!("{name} = {sigma}: a sigma is positive and finite, in pixels")))
}

/// Known points and their measured pixels, the points counted from a local origin: an iteration on coordinates with
/// seven digits before the point would stand still at their rounding.
#[derive(Debug, Clone)]
pub struct Observations {
    /// What was subtracted from the world coordinates.
    pub origin: Vector3<f64>,
    /// Local coordinates.
    pub xyz: Vec<[f64; 3]>,
    /// Pixels.
    pub xy: Vec<[f64; 2]>,
    /// Of the pixels.
    pub precision: Precision,
    /// The same points eight by eight, made when they are first asked for.
    packed: OnceLock<Vec<Batch>>,
}

impl Observations {
    /// Checks and shifts. `None` as precision is one sigma of 1 px.
    pub fn new(xyz: &[[f64; 3]], xy: &[[f64; 2]], precision: Option<Precision>) -> Result<Self> {
        if xyz.len() != xy.len() {
            return Err(Error::invalid(format!("{} points in space, but {} in the photo", xyz.len(), xy.len())));
        }
        let precision = precision.unwrap_or(Precision::Same(1.0));
        if let Precision::Each(factors) = &precision
            && factors.len() != xy.len()
        {
            return Err(Error::invalid(format!("{} points, but {} sigmas", xy.len(), factors.len())));
        }
        for (i, (p, q)) in xyz.iter().zip(xy).enumerate() {
            if !p.iter().chain(q).all(|v| v.is_finite()) {
                return Err(Error::invalid(format!("point {i} is not finite: {p:?} {q:?}; leave it out")));
            }
        }
        let n = xyz.len().max(1) as f64;
        let origin = xyz.iter().fold(Vector3::zeros(), |sum, p| sum + Vector3::from(*p) / n);
        let xyz = xyz.iter().map(|p| [p[0] - origin.x, p[1] - origin.y, p[2] - origin.z]).collect();
        Ok(Self { origin, xyz, xy: xy.to_vec(), precision, packed: OnceLock::new() })
    }

    /// How many.
    pub fn len(&self) -> usize {
        self.xyz.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.xyz.is_empty()
    }

    /// Some of the points, in the same local frame.
    pub fn select(&self, indices: &[usize]) -> Self {
        Self {
            origin: self.origin,
            xyz: indices.iter().map(|&i| self.xyz[i]).collect(),
            xy: indices.iter().map(|&i| self.xy[i]).collect(),
            precision: self.precision.select(indices),
            packed: OnceLock::new(),
        }
    }

    /// As [`Observations::select`], without a copy where it is all of them.
    pub(super) fn part(&self, indices: &[usize]) -> Cow<'_, Self> {
        if indices.len() == self.len() { Cow::Borrowed(self) } else { Cow::Owned(self.select(indices)) }
    }

    /// The points in batches.
    pub(super) fn batches(&self) -> &[Batch] {
        self.packed.get_or_init(|| batches(&self.xyz, &self.xy))
    }

    /// The view for batches, where one sigma holds for all points and the camera has batches.
    pub(super) fn flat(&self, view: &View) -> Option<(FlatView, f64)> {
        match self.precision {
            Precision::Same(sigma) => Some((FlatView::new(view)?, sigma)),
            Precision::Each(_) => None,
        }
    }

    /// The squared misclosure of each point in sigmas²; infinite where it is not visible.
    pub(super) fn squares(&self, view: &View) -> Vec<f64> {
        if let Some((flat, sigma)) = self.flat(view) {
            let weight = 1.0 / (sigma * sigma);
            let mut all = vec![0.0; self.len()];
            all.chunks_mut(LANES).zip(self.batches()).for_each(|(out, batch)| {
                let squares = flat.squares(batch);
                out.iter_mut().zip(squares).for_each(|(o, s)| *o = s * weight);
            });
            return all;
        }
        (0..self.len()).map(|i| self.square(view, i)).collect()
    }

    /// The squared misclosure of a point in sigmas²; infinite where it is not visible.
    #[inline]
    pub(super) fn square(&self, view: &View, i: usize) -> f64 {
        view.project(&self.xyz[i]).map_or(f64::INFINITY, |(xy, _)| {
            let v = self.precision.whiten(i, [xy[0] - self.xy[i][0], xy[1] - self.xy[i][1]]);
            v[0] * v[0] + v[1] * v[1]
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn whitening_turns_a_covariance_into_the_identity() {
        let given = [4.0, -1.2, -1.2, 0.9];
        let precision = Precision::from_covariances(&[given]).unwrap();
        let c = precision.covariance(0);
        for (a, b) in c.iter().zip([4.0, -1.2, 0.9]) {
            assert!((a - b).abs() < 1e-12);
        }
        // W Σ Wᵀ = I
        let (a, b) = (precision.whiten(0, [1.0, 0.0]), precision.whiten(0, [0.0, 1.0]));
        let w = [[a[0], b[0]], [a[1], b[1]]];
        for i in 0..2 {
            for j in 0..2 {
                let s = [[c[0], c[1]], [c[1], c[2]]];
                let value: f64 = (0..2).map(|k| (0..2).map(|l| w[i][k] * s[k][l] * w[j][l]).sum::<f64>()).sum();
                assert!((value - f64::from(u8::from(i == j))).abs() < 1e-12);
            }
        }
        assert!((Precision::from_sigmas(&[[2.0, 0.5]]).unwrap().typical_sigma() - 1.0).abs() < 1e-12);
    }

    #[test]
    fn impossible_precisions_and_points_are_refused() {
        assert!(Precision::from_sigma(0.0).is_err());
        assert!(Precision::from_sigmas(&[[1.0, f64::NAN]]).unwrap_err().to_string().contains("point 0 in y"));
        assert!(Precision::from_covariances(&[[1.0, 2.0, 2.0, 1.0]]).is_err());
        assert!(Observations::new(&[[0.0; 3]], &[], None).is_err());
        let error = Observations::new(&[[0.0; 3], [f64::NAN; 3]], &[[0.0; 2]; 2], None).unwrap_err();
        assert!(error.to_string().contains("point 1 is not finite"));
    }
}
