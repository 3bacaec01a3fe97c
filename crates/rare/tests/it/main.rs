//! Integration tests: one binary, one module per concern.
#![expect(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::print_stdout,
    reason = "tests fail by panicking and say what they skip"
)]

mod densify;
mod hint;
mod project;
mod reduce;
mod shared;
