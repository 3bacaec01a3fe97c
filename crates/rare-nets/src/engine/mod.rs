//! The network engine: operations of fused size behind one trait, and their implementation on the CPU.
//!
//! A network is written once, generic over [`Backend`]. An operation is as large as a backend can profit from: a
//! convolution takes the normalisation and activation before it and the bias, residual and activation after it, so
//! that nothing is written to memory in between. Weights are opaque to the network: each backend packs them once, its
//! own way.
//!
//! [`CpuBackend`] is the only one so far. From the outside in: `convolution` and `attention` cut the work into pieces
//! for the threads, `operand` and `pack` put both sides of the product in order, `tile` multiplies them in registers,
//! `simd` has the instructions of each processor. `factored_attention` and `recurrent` are for networks on points, which
//! have no other backend. All unsafe code of the workspace is in this folder.

mod arena;
mod attention;
mod backend;
mod convolution;
mod cpu;
mod curve;
mod epilogue;
mod factored_attention;
mod math;
mod normalization;
mod operand;
mod pack;
mod recurrent;
mod shared_output;
mod simd;
mod tensor;
mod tile;
mod transport;
mod vectors;
mod winograd;

pub use backend::{Activation, Arrangement, Backend, Convolution, Kernel, Prologue, Shape};
pub use cpu::{CpuBackend, Precision};
pub(crate) use curve::{Curve, MOST_ANGLES, PairEmbedding};
pub(crate) use factored_attention::{
    AlignedRows, Columns, FactorRows, Head, QUERIES as FACTORED_QUERIES, ScoreFactors,
};
pub use pack::PackedWeight;
pub use simd::Processor;
pub use tensor::Tensor;
pub(crate) use transport::log_transport;
