//! Colours for points from photos: which photos see a point, what they show there, and what to make of several.

mod bilinear;
mod blending;
mod colourise;
mod exposure;
mod sampling;
mod visibility;

pub use blending::Blend;
pub use colourise::{Colourist, Colours};
pub use exposure::Exposure;
pub use sampling::{Interpolation, Photo, Pixels};
pub use visibility::{Limits, VisibilityMap};
