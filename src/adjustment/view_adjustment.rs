//! A view adjusted from control points, with everything that is said about it.

use nalgebra::{DMatrix, Vector3};

use super::error_map::{at_depth, photo_grid};
use super::full::{Adjusted, FullOptions, adjust_fully};
use super::gauss_helmert::Observed;
use super::view_conditions::{ParameterPriors, ViewConditions, ViewConstraint, design_of};
use super::view_covariance::ViewCovariance;
use crate::error::{Error, Result};
use crate::estimation::FreeSet;
use crate::geometry::View;

/// Places over the photo at which the effect of undetected biases is looked at.
const GRID: (usize, usize) = (9, 7);
/// A parameter whose sigma exceeds this share of its natural size (a radian, the distance, the focal length) is not
/// determined: the linearised statistics have no meaning there.
const UNDETERMINED: f64 = 0.3;
/// The variance factor that is counted with at least when the geometry is judged.
const SMALLEST_SCALE: f64 = 0.01;

/// Columns of one table.
#[derive(Debug, Clone, Copy)]
pub struct ControlPoints<'a> {
    /// World frame.
    pub xyz: &'a [[f64; 3]],
    /// Pixels.
    pub xy: &'a [[f64; 2]],
    /// m², one for each point.
    pub covariance_xyz: &'a [[[f64; 3]; 3]],
    /// px², one for each point.
    pub covariance_xy: &'a [[[f64; 2]; 2]],
}

impl ControlPoints<'_> {
    fn check(&self) -> Result<()> {
        let n = self.xyz.len();
        for (name, m) in [
            ("xy", self.xy.len()),
            ("covariance_xyz", self.covariance_xyz.len()),
            ("covariance_xy", self.covariance_xy.len()),
        ] {
            if m != n {
                return Err(Error::invalid(format!("{n} control points, but {m} rows of {name}")));
            }
        }
        Ok(())
    }

    /// Their mean, rounded: a near origin that costs no digits.
    fn origin(&self) -> Vector3<f64> {
        let sum: Vector3<f64> = self.xyz.iter().map(|p| Vector3::from(*p)).sum();
        (sum / self.xyz.len().max(1) as f64).map(f64::round)
    }
}

/// A view and its statistics.
#[derive(Debug, Clone)]
pub struct ViewAdjustment {
    /// In the world frame.
    pub view: View,
    /// The parameters that were free.
    pub free: FreeSet,
    /// Everything else; its state is in a local frame.
    pub adjusted: Adjusted<View, 2, 5>,
}

impl ViewAdjustment {
    /// The parameters' covariance, scaled.
    pub fn covariance(&self) -> Result<ViewCovariance> {
        ViewCovariance::new(self.free.clone(), self.adjusted.covariance.clone())
    }
}

/// Adjusts a view from its starting values.
pub fn adjust_view(
    start: &View,
    points: &ControlPoints<'_>,
    free: &FreeSet,
    priors: Option<&ParameterPriors>,
    constraints: &[ViewConstraint],
    options: &FullOptions,
) -> Result<ViewAdjustment> {
    points.check()?;
    let mut conditions = ViewConditions::new(free.clone(), start, points.origin())?.with_constraints(constraints)?;
    if let Some(priors) = priors {
        conditions = conditions.with_priors(priors)?;
    }
    let observed: Vec<Observed<5>> = (0..points.xyz.len())
        .map(|i| {
            conditions.observed(&points.xy[i], &points.covariance_xy[i], &points.xyz[i], &points.covariance_xyz[i])
        })
        .collect();
    let middle = median_depth(start, points.xyz);
    let places = |view: &View| -> Vec<DMatrix<f64>> {
        let grid = photo_grid(view, GRID.0, GRID.1, true);
        grid.iter().filter_map(|xy| design_of(free, view, &at_depth(view, xy, middle)?)).collect()
    };
    let adjusted = adjust_fully(&conditions, &conditions.to_local(start), &observed, options, places)?;
    refuse_undetermined(free, &adjusted, middle)?;
    Ok(ViewAdjustment { view: conditions.to_world(&adjusted.solution.state), free: free.clone(), adjusted })
}

fn median_depth(view: &View, xyz: &[[f64; 3]]) -> f64 {
    let mut depths: Vec<f64> = xyz.iter().filter_map(|p| view.project(p).map(|(_, depth)| depth)).collect();
    depths.sort_by(f64::total_cmp);
    depths.get(depths.len() / 2).copied().unwrap_or(1.0)
}

/// First-order statistics need sigmas that are small against what they are sigmas of.
fn refuse_undetermined(free: &FreeSet, adjusted: &Adjusted<View, 2, 5>, distance: f64) -> Result<()> {
    let view = &adjusted.solution.state;
    for (k, name) in free.names().into_iter().enumerate() {
        let size = match name {
            "rx" | "ry" | "rz" => 1.0,
            "cx_world" | "cy_world" | "cz_world" => distance,
            "f" | "fx" | "fy" | "aspect" => free.values(view)[k],
            "cx" | "cy" => view.camera.params()[0],
            _ => continue,
        };
        // Data without noise leave a variance factor of zero, which would make any geometry look strong.
        let variance = adjusted.solution.cofactor[(k, k)] * adjusted.scale.max(SMALLEST_SCALE);
        let share = variance.sqrt() / size;
        if share > UNDETERMINED || share.is_nan() {
            return Err(Error::Degenerate {
                what: format!("the points do not determine {name}"),
                quantity: "its sigma over its natural size",
                value: share,
                limit: UNDETERMINED,
                remedy: "spread the points over the photo and in depth, add some, or free fewer parameters",
            });
        }
    }
    Ok(())
}
