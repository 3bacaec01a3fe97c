//! Fully convolutional geometric features (Choy, Park, Koltun: ICCV 2019): a U-shaped network of sparse 3-D
//! convolutions, `ResUNetBN2C`, that gives every occupied voxel of a cloud a feature.
//!
//! | step | file | takes and gives |
//! |---|---|---|
//! | voxels | `voxels.rs` | points -> the first point of every voxel, integer coordinates |
//! | maps | `coordinates.rs`, `kernel_map.rs` | coordinates -> coarser coordinates, pairs of voxels for every kernel offset |
//! | network | `convolution.rs`, `network.rs` | maps -> features |
//! | description | `describe.rs` | features of two clouds -> correspondences and a pose |
//!
//! Each cloud is described by itself, so its features depend on no other cloud.

mod config;
mod convolution;
mod coordinates;
mod describe;
mod kernel_map;
mod layout;
mod network;
mod voxels;

pub use config::{FcgfConfig, Matching};
pub use layout::{layout, layout_as_stored};
pub use network::{Fcgf, Output};
