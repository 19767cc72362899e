//! The cloud as the photo's camera sees it: depth buffers that points are put into in any order, and from them the
//! surfaces that hide what lies behind; and the synthetic camera image (SCI), the photo that the scanner would have taken
//! in its own light.

mod drawing;
mod extremes;
pub mod filling;
mod flat;
mod footprint;
pub mod intensity;
mod links;
mod marks;
mod patch;
mod picture;
mod plane_fit;
mod planes;
mod pyramid;
pub mod resampling;
mod sample;
pub mod sci;
mod window_fit;
mod windows;
mod zbuffer;

pub use drawing::Splat;
pub(crate) use footprint::pixel_angle;
pub use footprint::{Footprint, Surfaces};
pub use picture::picture;
pub use planes::LocalPlanes;
pub use sample::Sample;
pub(crate) use sample::clamped;
pub(crate) use zbuffer::fetch;
pub use zbuffer::{DepthBuffer, Grid, IndexBuffer, Located};
