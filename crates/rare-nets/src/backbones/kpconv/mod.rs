//! Kernel point convolutions (Thomas et al., "`KPConv`: Flexible and Deformable Convolution for Point Clouds", ICCV 2019)
//! of two clouds together, as `GeoTransformer`, Predator and CoFiNet use them.
//!
//! | module | what it holds |
//! |---|---|
//! | `grid_subsampling` | one point for each occupied voxel |
//! | `neighbours` | the nearest points within a radius |
//! | `limits` | how many of them each stage looks at |
//! | `pyramid` | the stages of a pair of clouds and the neighbours in and between them |
//! | `memory` | what a pyramid and its features will take |
//! | `convolution` | the convolution itself |
//! | `blocks` | what surrounds it: linear layers, normalisations, shortcuts, from fine to coarse and back |
//!
//! A pyramid stacks both clouds: first the points of one, then those of the other. Points are triples of metres in
//! single precision, as the networks were trained.

mod blocks;
mod convolution;
mod grid_subsampling;
mod limits;
mod memory;
mod neighbours;
mod pyramid;

pub(crate) use blocks::{ConvolutionBlock, NormalizationKind, ResidualBlock, Unary, upsample};
pub use grid_subsampling::subsample;
pub(in crate::backbones) use limits::usual_neighbours;
pub use limits::{NeighbourLimits, calibrate};
pub use memory::pyramid_bytes;
pub use neighbours::{Neighbours, neighbours};
pub use pyramid::{Pyramid, PyramidConfig, Stage, StagePoints};

/// A point, metres.
pub type Point = [f32; 3];
