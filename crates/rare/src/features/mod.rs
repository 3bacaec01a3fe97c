//! Geometric features of points: normals and descriptors.

mod normals;

pub use normals::{estimate_normals, orient_towards};
