//! The layers of which the U-Net and the `ControlNet` are made.
//!
//! Each layer is loaded by the name of its tensors and run by as few operations of the backend as possible: a
//! normalisation is the prologue of the convolution after it, a residual the end of the convolution before it.

mod block;
mod conditioning;
mod loader;
mod normalization;
mod resnet;
mod time_embedding;
mod transformer;

pub(crate) use block::Block;
pub(crate) use conditioning::Conditioning;
pub use conditioning::{Contexts, Timestep};
pub(crate) use loader::Loader;
pub(crate) use normalization::{GroupNormalization, LayerNormalization};
pub(crate) use time_embedding::TimeEmbedding;
