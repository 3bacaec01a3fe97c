//! Geometric features of points: normals and descriptors.

mod fpfh;
mod normals;

pub use fpfh::{fpfh, fpfh_at};
pub(crate) use normals::smallest_eigenvector;
pub use normals::{estimate_normals, orient_towards};
