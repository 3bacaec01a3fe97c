//! Integration tests: golden data and real files.
#![allow(clippy::unwrap_used, clippy::panic)]

#[cfg(feature = "fetch")]
mod weights;
#[cfg(feature = "fetch")]
mod weights_server;
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::print_stdout)]

mod checkpoint;
mod shared;
