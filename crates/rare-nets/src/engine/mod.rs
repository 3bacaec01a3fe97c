//! The network engine: operations of fused size behind one trait, and their implementation on the CPU.
//!
//! A network is written once, generic over [`Backend`]. An operation is as large as a backend can profit from: a
//! convolution takes the normalisation and activation before it and the bias, residual and activation after it, so
//! that nothing is written to memory in between. Weights are opaque to the network: each backend packs them once, its
//! own way.

mod backend;

pub use backend::{Activation, Arrangement, Backend, Convolution, Kernel, Prologue, Shape};
