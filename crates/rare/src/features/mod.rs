//! Geometric features of points: normals and descriptors.

mod fpfh;
mod normals;

pub use fpfh::{fpfh, fpfh_at};
pub use normals::{estimate_normals, orient_towards};
