//! From control points to views: what is estimated, and how.

mod parameters;

pub use parameters::{FreeSet, MAX_FREE, POSE_NAMES, Parameter};
