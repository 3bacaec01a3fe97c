//! The program as its users see it: files in, files, exit codes and messages out.
#![expect(clippy::unwrap_used, clippy::print_stdout, reason = "tests fail by panicking")]

mod backbones;
mod bad_input;
#[path = "../../../rare/examples/synthetic_benchmark/benchmark.rs"]
mod benchmark;
mod commands;
mod diffusion;
mod eval;
mod eval_networks;
mod features;
mod icp;
mod options;
mod outputs;
#[path = "../../../rare-nets/tests/it/pickle_writer.rs"]
mod pickle_writer;
mod readme;
mod registration;
mod report;
mod shared;
mod synthetic_benchmark;
#[cfg(feature = "fetch")]
mod weights;
#[cfg(feature = "fetch")]
#[path = "../../../rare-nets/tests/it/weights_server.rs"]
#[expect(dead_code, reason = "shared with the tests of the library, which make more mistakes")]
mod weights_server;
