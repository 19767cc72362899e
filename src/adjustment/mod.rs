//! How sure a result is: rigorous adjustment, its statistics, and what they mean for every point of a cloud.
//!
//! [`adjust`] is one engine for views, DLT matrices and similarities; [`adjust_fully`] adds the tests; the rest carries
//! the covariance on, over the photo and onto the surfaces.

mod check_points;
mod distributions;
mod error_map;
mod full;
mod gauss_helmert;
mod next_point;
mod normal_equations;
mod propagation;
mod reliability;
mod scanner;
mod sigma_blocks;
mod sigma_tables;
mod similarity_conditions;
mod snooping;
mod variance_components;
mod view_adjustment;
mod view_conditions;
mod view_covariance;

pub use check_points::{CheckPoint, CheckReport, RootMeanSquare, check_points};
pub use distributions::{Reference, VarianceTest};
pub use error_map::{PredictedError, at_depth, photo_grid, predicted_errors};
pub use full::{Adjusted, FullOptions, PointOutcome, adjust_fully};
pub use gauss_helmert::{Conditions, Constraints, Design, Linearised, Observed, PointFit, Priors, Solution, adjust};
pub use next_point::{Advice, Candidate, Criterion, NextPoints, next_points};
pub use propagation::{ObjectNoise, Slopes, SurfaceSigma};
pub use reliability::{GroupRedundancy, PointReliability, PointTest, TestLevels, reliability};
pub use scanner::ScannerModel;
pub use similarity_conditions::{SimilarityAdjustment, SimilarityConditions, adjust_similarity};
pub use snooping::{Rejection, Snooped, adjust_and_snoop};
pub use variance_components::{VarianceComponents, variance_components};
pub use view_adjustment::{ControlPoints, ViewAdjustment, adjust_view};
pub use view_conditions::{ParameterPriors, ViewConditions, ViewConstraint};
pub use view_covariance::{DLT_NAMES, ViewCovariance};
