//! Poses and cameras: from points to pixels and back, with derivatives. Small, pure functions.

mod block;
mod camera;
mod cube;
mod field;
mod fisheye;
mod frustum;
mod polynomial;
mod pose;
mod project;
mod roots;
mod similarity;
mod tangents;
mod view;

#[cfg(target_arch = "x86_64")]
pub(crate) use block::Registers;
pub use block::{Block, BlockProjector, LANES};
pub use camera::{Camera, Depth, MAX_PARAMS, Model, Projection};
pub(crate) use cube::{CUBE_FACES, cube_face, cube_face_of};
pub use field::forward_field;
pub use frustum::Frustum;
pub use pose::{Pose, rotation_exp, rotation_log, skew_matrix};
pub use project::{ViewJacobian, project, project_into, unproject};
pub use similarity::Similarity;
pub use tangents::tangents;
pub use view::{DltParts, View};
