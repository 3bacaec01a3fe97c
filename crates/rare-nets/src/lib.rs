//! Every network of `rare`, on its own CPU engine.
//!
//! | module | what it holds |
//! |---|---|
//! | [`engine`] | tensors, operations of fused size, kernels for each processor |
//! | [`checkpoint`] | weight files, read without executing anything |
//! | [`backbones`] | networks that describe and match two clouds |
//! | [`networks`] | the networks on points by name: which one a weight file is of |
//! | [`outliers`] | networks that tell right correspondences from wrong ones |
//! | [`cache`] | features that were computed before |
//! | [`diffusion`] | Stable Diffusion 1.5 with a depth `ControlNet`: features of depth maps |
//! | [`official`] | fragments and lists of pairs of the official repositories |
//! | [`weights`] | where weight files come from, and whether they are intact |
//!
//! The networks are written once, generic over [`engine::Backend`]; the geometry that uses their features is in the
//! crate `rare`.

pub mod backbones;
pub mod cache;
pub mod checkpoint;
pub mod diffusion;
pub mod engine;
mod layers;
mod matrix;
pub mod networks;
pub mod official;
pub mod outliers;
mod parameter;
pub mod weights;

pub use matrix::Matrix;
pub use parameter::{Parameter, Values};
