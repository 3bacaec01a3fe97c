//! Layers of networks on points: linear layers, normalisations and activations of the rows of a [`crate::Matrix`].
//!
//! The matrix products are those of the engine. What lies between them is small and written plainly; sums over points
//! run over blocks of fixed size, so that no result depends on the number of threads.

mod activation;
mod linear;
mod normalization;
mod weights;

pub(crate) use activation::Activation;
pub(crate) use linear::{Linear, products};
pub(crate) use normalization::{
    group_normalization, instance_normalization, layer_normalization, unit_rows,
};
pub(crate) use weights::Weights;
