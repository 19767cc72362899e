//! From control points to views: what is estimated, and how.

mod parameters;
mod similarity;

pub use parameters::{FreeSet, MAX_FREE, POSE_NAMES, Parameter};
pub use similarity::{SimilarityFit, SimilarityOptions, fit_similarity, iterate_similarity};
