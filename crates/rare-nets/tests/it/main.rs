//! Integration tests: golden data and real files.
#![allow(clippy::unwrap_used, clippy::panic)]

#[cfg(feature = "fetch")]
mod weights;
#[cfg(feature = "fetch")]
mod weights_server;
