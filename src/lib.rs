//! Colours laser scans from photographs and says how accurate the result is.
//!
//! The story, bottom up: [`geometry`] knows poses and cameras and takes points to pixels and back. [`estimation`] finds
//! views from control points, [`adjustment`] says how sure they are. [`render`] keeps depth buffers and makes surfaces
//! of them, and the synthetic camera image, which [`matching`] compares with the photo; [`icp`] brings image points
//! without known pairs together, by their nearest [`neighbours`]; [`colour`] says which photo sees a point and what
//! colour it has there; [`backproject`] goes the other way, from pixels to points of space. [`records`] and [`lzf`] are
//! the inner loops of reading and writing clouds. [`simulate`] casts rays into scenes, for data whose truth is known.
//! The core knows neither Python nor files; the bindings in `python` (feature `python`) wrap it.
//!
//! Conventions: the camera frame is x right, y down, z forward; pixel (0, 0) is the *centre* of the top-left pixel;
//! object space is float64 in the cloud's own frame and unit; angles are radians.

pub mod adjustment;
pub mod backproject;
pub mod colour;
pub mod error;
pub mod estimation;
pub mod geometry;
pub mod icp;
pub mod lzf;
pub mod matching;
mod memory;
pub mod neighbours;
pub mod records;
pub mod render;
pub mod simulate;

#[cfg(feature = "python")]
mod python;

pub use error::{Error, Result};
pub use geometry::{Camera, Model, Pose, View};
