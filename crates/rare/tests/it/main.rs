//! Integration tests: one binary, one module per concern.
#![expect(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::print_stdout,
    reason = "tests fail by panicking and say what they skip"
)]

mod aggregate;
mod clouds;
mod densify;
mod encoded_views;
mod estimator_properties;
mod eval;
mod fast_mac;
mod fpfh;
mod hint;
mod hostile_files;
mod icp;
mod icp_pairs;
mod local_to_global;
mod mac;
mod matching;
mod metrics;
mod poses;
mod project;
mod ransac;
mod real_pairs;
mod reduce;
mod refine;
mod refined_real_pairs;
mod sc2_pcr;
mod sc2_pcr_plus_plus;
mod shared;
mod synthetic_pairs;
mod transfer;
mod weighted_fit;
