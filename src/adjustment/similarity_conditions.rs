//! Similarity transformations as the condition of an adjustment: both frames' coordinates are uncertain.
//!
//! `f = s R X + t − x`, with X in the source and x in the target frame: D conditions on 2 D observations, target first.

use nalgebra::{DMatrix, Matrix3, SMatrix, SVector, Vector3};

use super::full::{Adjusted, FullOptions, adjust_fully};
use super::gauss_helmert::{Conditions, Design, Linearised, Observed};
use crate::error::{Error, Result};
use crate::estimation::{SimilarityOptions, fit_similarity};
use crate::geometry::{Similarity, rotation_exp, skew_matrix};

/// Between frames whose origins lie near the points: scale, rotation (an angle, or a small vector applied on the left),
/// translation.
pub struct SimilarityConditions<const D: usize>;

/// The parameters' names, in order.
fn names(d: usize) -> &'static [&'static str] {
    if d == 2 { &["scale", "angle", "tx", "ty"] } else { &["scale", "rx", "ry", "rz", "tx", "ty", "tz"] }
}

/// ∂(R p)/∂(rotation parameters) for `p` already turned.
fn by_rotation<const D: usize>(turned: &SVector<f64, D>) -> DMatrix<f64> {
    if D == 2 {
        DMatrix::from_column_slice(2, 1, &[-turned[1], turned[0]])
    } else {
        let k = skew_matrix(&Vector3::new(turned[0], turned[1], turned[2]));
        DMatrix::from_fn(3, 3, |i, j| -k[(i, j)])
    }
}

fn turn<const D: usize>(by: &[f64]) -> SMatrix<f64, D, D> {
    if D == 2 {
        let (s, c) = by[0].sin_cos();
        SMatrix::from_fn(|i, j| [[c, -s], [s, c]][i][j])
    } else {
        let r: Matrix3<f64> = rotation_exp(&Vector3::new(by[0], by[1], by[2]));
        SMatrix::from_fn(|i, j| r[(i, j)])
    }
}

macro_rules! conditions {
    ($d:literal, $m:literal) => {
        impl Conditions<$d, $m> for SimilarityConditions<$d> {
            type State = Similarity<$d>;

            fn names(&self) -> Vec<String> {
                names($d).iter().map(|n| (*n).into()).collect()
            }

            fn linearise(
                &self,
                state: &Self::State,
                l: &SVector<f64, $m>,
                design: Option<&mut Design<$d>>,
            ) -> Option<Linearised<$d, $m>> {
                let target = l.fixed_rows::<$d>(0).into_owned();
                let source = l.fixed_rows::<$d>($d).into_owned();
                let turned = state.rotation * source;
                if let Some(rows) = design {
                    let by_turn = by_rotation::<$d>(&turned);
                    for i in 0..$d {
                        rows[i] = [0.0; crate::estimation::MAX_FREE];
                        rows[i][0] = turned[i];
                        for k in 0..by_turn.ncols() {
                            rows[i][1 + k] = state.scale * by_turn[(i, k)];
                        }
                        rows[i][1 + by_turn.ncols() + i] = 1.0;
                    }
                }
                let f = turned * state.scale + state.translation - target;
                let mut b = SMatrix::<f64, $d, $m>::zeros();
                b.fixed_view_mut::<$d, $d>(0, 0).copy_from(&(-SMatrix::<f64, $d, $d>::identity()));
                b.fixed_view_mut::<$d, $d>(0, $d).copy_from(&(state.rotation * state.scale));
                Some((f, b))
            }

            fn apply(&self, state: &Self::State, delta: &[f64]) -> Result<Self::State> {
                let turns = delta.len() - 1 - $d;
                let scale = state.scale + delta[0];
                if !(scale > 0.0 && scale.is_finite()) {
                    return Err(Error::invalid(format!("a scale of {scale} is not possible")));
                }
                let rotation = turn::<$d>(&delta[1..1 + turns]) * state.rotation;
                let shift = SVector::<f64, $d>::from_column_slice(&delta[1 + turns..]);
                Ok(Similarity { scale, rotation, translation: state.translation + shift })
            }
        }
    };
}
conditions!(2, 4);
conditions!(3, 6);

/// A similarity and its statistics.
#[derive(Debug, Clone)]
pub struct SimilarityAdjustment<const D: usize, const M: usize> {
    /// From the source to the target frame.
    pub similarity: Similarity<D>,
    /// Covariance of its parameters, with the translation between the frames' own origins; scaled.
    pub covariance: DMatrix<f64>,
    /// Everything else, between frames whose origins lie near the points.
    pub adjusted: Adjusted<Similarity<D>, D, M>,
}

/// Adjusts a similarity; the start is the closed form.
pub fn adjust_similarity<const D: usize, const M: usize>(
    source: &[[f64; D]],
    target: &[[f64; D]],
    covariance_source: &[[[f64; D]; D]],
    covariance_target: &[[[f64; D]; D]],
    options: &FullOptions,
) -> Result<SimilarityAdjustment<D, M>>
where
    SimilarityConditions<D>: Conditions<D, M, State = Similarity<D>>,
{
    let n = source.len();
    for (name, m) in [
        ("target", target.len()),
        ("covariance_source", covariance_source.len()),
        ("covariance_target", covariance_target.len()),
    ] {
        if m != n {
            return Err(Error::invalid(format!("{n} source points, but {m} rows of {name}")));
        }
    }
    let (from, to) = (origin(source), origin(target));
    let local = |points: &[[f64; D]], origin: &SVector<f64, D>| -> Vec<[f64; D]> {
        points.iter().map(|p| std::array::from_fn(|i| p[i] - origin[i])).collect()
    };
    let (near_source, near_target) = (local(source, &from), local(target, &to));
    let start = fit_similarity(&near_source, &near_target, &SimilarityOptions::default())?.similarity();
    let observed: Vec<Observed<M>> = (0..n)
        .map(|i| Observed {
            value: SVector::from_fn(|k, _| if k < D { near_target[i][k] } else { near_source[i][k - D] }),
            covariance: SMatrix::from_fn(|a, b| match (a < D, b < D) {
                (true, true) => covariance_target[i][a][b],
                (false, false) => covariance_source[i][a - D][b - D],
                _ => 0.0,
            }),
        })
        .collect();
    let conditions = SimilarityConditions::<D>;
    let places = |state: &Similarity<D>| -> Vec<DMatrix<f64>> {
        let u = names(D).len();
        observed
            .iter()
            .filter_map(|o| {
                let mut rows = [[0.0; crate::estimation::MAX_FREE]; D];
                conditions.linearise(state, &o.value, Some(&mut rows))?;
                Some(DMatrix::from_fn(D, u, |i, k| rows[i][k]))
            })
            .collect()
    };
    let adjusted = adjust_fully(&conditions, &start, &observed, options, places)?;
    let near = &adjusted.solution.state;
    // x = to + t' + s R (X − from): the translation between the frames' own origins hangs on scale and rotation.
    let arm = near.rotation * from;
    let similarity = Similarity {
        scale: near.scale,
        rotation: near.rotation,
        translation: to + near.translation - arm * near.scale,
    };
    let u = names(D).len();
    let mut map = DMatrix::identity(u, u);
    let by_turn = by_rotation::<D>(&arm);
    for i in 0..D {
        let row = u - D + i;
        map[(row, 0)] = -arm[i];
        for k in 0..by_turn.ncols() {
            map[(row, 1 + k)] = -near.scale * by_turn[(i, k)];
        }
    }
    let covariance = &map * &adjusted.covariance * map.transpose();
    Ok(SimilarityAdjustment { similarity, covariance, adjusted })
}

fn origin<const D: usize>(points: &[[f64; D]]) -> SVector<f64, D> {
    let mut sum = SVector::<f64, D>::zeros();
    for p in points {
        sum += SVector::from(*p);
    }
    (sum / points.len().max(1) as f64).map(f64::round)
}
