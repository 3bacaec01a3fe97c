//! The program as its users see it: files in, files, exit codes and messages out.
#![expect(clippy::unwrap_used, reason = "tests fail by panicking")]

mod bad_input;
mod commands;
mod features;
mod options;
mod outputs;
mod readme;
mod registration;
mod shared;
