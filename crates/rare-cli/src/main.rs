//! The `rare` program.
#![forbid(unsafe_code)]

fn main() {}
