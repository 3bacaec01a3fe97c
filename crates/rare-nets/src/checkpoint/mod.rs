//! Weight files, read without executing anything.
//!
//! A file of any format becomes [`Tensor`]s: a number type, a shape, strides and a place in the file. The values are
//! read when they are asked for, so opening costs as little as the list of names, and memory never holds the file.
//! [`Parameters`] puts the tensors of one network together, under one naming, wherever they come from.

mod element;
mod layout;
mod parameters;
mod pickle;
mod safetensors;
mod shards;
mod tensor;
mod weight_file;

pub use element::ElementType;
pub(crate) use layout::require;
pub use layout::{Differences, Layout, Misshapen, compare};
pub use parameters::Parameters;
pub use pickle::{Instance, Object, open_pickle};
pub use tensor::Tensor;
