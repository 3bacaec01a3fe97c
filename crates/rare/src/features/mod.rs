//! Geometric features of points: normals and descriptors.

mod fpfh;
mod landmarks;
mod normals;

pub use fpfh::{fpfh, fpfh_at};
pub use landmarks::Landmarks;
pub(crate) use normals::smallest_eigenvector;
pub use normals::{estimate_normals, orient_towards};
