//! From control points to views: what is estimated, and how.

mod batch;
mod blunders;
mod collinearity;
mod dlt;
mod dlt_linear;
mod fit;
mod levenberg;
mod loss;
mod observations;
mod p3p;
mod parameters;
mod priors;
mod ransac;
mod resection;
mod residuals;
mod robust;
mod sampling;
mod score;
mod similarity;
mod start;
mod verdict;

pub use blunders::Criterion;
pub use dlt::{Dlt, DltMethod, DltOptions, estimate_dlt};
pub use levenberg::Stop;
pub use loss::Loss;
pub use observations::{Observations, Precision};
pub use p3p::{UpToFour, p3p, views_of_three};
pub use parameters::{FreeSet, MAX_FREE, POSE_NAMES, Parameter};
pub use priors::Prior;
pub use ransac::RansacOptions;
pub use resection::{Resection, ResectionOptions, Start, Status, check_parameters, resect, resect_robust};
pub use residuals::Rms;
pub use sampling::Random;
pub use similarity::{SimilarityFit, SimilarityOptions, fit_similarity, iterate_similarity};
pub use verdict::{Verdict, Warning};
