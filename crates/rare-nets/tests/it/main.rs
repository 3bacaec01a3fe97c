//! Integration tests: golden data and real files.
#![expect(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::print_stdout,
    reason = "tests fail by panicking and say what they skip"
)]

mod backbones;
mod checkpoint;
mod encoder;
mod engine;
mod network_shapes;
mod networks;
mod official;
mod outliers;
mod pickle_writer;
mod pipeline;
mod reference_backend;
mod sampler;
mod schedule;
mod shared;
mod text_encoder;
mod tokenizer;
#[cfg(feature = "fetch")]
mod weights;
#[cfg(feature = "fetch")]
#[expect(dead_code, reason = "shared with the tests of the program, which make other mistakes")]
mod weights_server;
