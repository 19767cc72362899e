//! A small simulator: ray casting of textured scenes into laser scans and photos whose truth is known.
//!
//! The project's own test data come from here. A scene of exact primitives ([`Primitive`]) with procedural materials
//! ([`Material`]) under sun and sky ([`Lighting`]) answers three questions: what a ray meets ([`Scene::cast`]), what a
//! surface reflects to a scanner or a camera ([`Scene::reflectance`]), and what a photo shows ([`Scene::picture`]).
//! Layout of scenes, scanner and camera errors are the callers'.

mod bvh;
mod image;
mod light;
mod material;
mod noise;
mod picture;
mod rays;
mod scene;
mod shape;
mod tables;

pub use image::Painting;
pub use light::{Light, LightMap, Lighting};
pub use material::{Layer, Material, Pattern, Reflectance, Spot};
pub use rays::Rays;
pub use scene::{Hit, Scene};
pub use shape::{Outline, Primitive};
pub use tables::{LAYER_COLUMNS, LIGHTING_COLUMNS, MATERIAL_COLUMNS, PRIMITIVE_COLUMNS, Tables};
