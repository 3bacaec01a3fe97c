//! Integration tests: one binary, one module per concern.
#![expect(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::print_stdout,
    reason = "tests fail by panicking and say what they skip"
)]

mod aggregate;
mod matching;
mod metrics;
mod shared;
mod transfer;
mod fpfh;
mod ransac;
mod real_pairs;
mod sc2_pcr;
mod shared;
mod synthetic_pairs;
mod weighted_fit;
