//! The cloud as the photo's camera sees it: depth buffers that points are put into in any order, and from them the
//! surfaces that hide what lies behind.

mod footprint;
mod zbuffer;

pub(crate) use footprint::pixel_angle;
pub use footprint::{Footprint, Surfaces};
pub(crate) use zbuffer::fetch;
pub use zbuffer::{DepthBuffer, Grid, IndexBuffer, Located};
