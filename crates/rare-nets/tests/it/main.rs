//! Integration tests: golden data and real files.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::print_stdout)]

mod checkpoint;
mod pipeline;
mod shared;
