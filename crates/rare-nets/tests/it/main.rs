//! Integration tests: golden data and real files.
#![expect(
    clippy::unwrap_used,
    clippy::panic,
    clippy::print_stdout,
    reason = "tests fail by panicking and say what they skip"
)]

mod checkpoint;
mod pipeline;
mod shared;
