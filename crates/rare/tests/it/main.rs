//! Integration tests: one binary, one module per concern.
#![expect(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::print_stdout,
    reason = "tests fail by panicking and say what they skip"
)]

mod densify;
mod matching;
mod project;
mod aggregate;
mod matching;
mod metrics;
mod fpfh;
mod ransac;
mod sc2_pcr;
mod clouds;
mod hostile_files;
mod poses;
mod hint;
mod project;
mod reduce;
mod shared;
mod transfer;
mod synthetic_pairs;
mod weighted_fit;
