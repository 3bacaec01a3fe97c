//! The `rare` program: registers point clouds and refines given registrations.
//!
//! `args` is what was typed, `options` what it means, `run` what is done, `record` and `summary` what is said of it.
//! Everything that fails says so in one line on stderr; the exit code tells a wrong input from a pose that nobody
//! should trust.
#![forbid(unsafe_code)]

mod args;
mod backbone;
mod estimators;
mod figures;
mod given_weights;
mod images;
mod memory;
mod network;
mod options;
mod outputs;
mod plots;
mod progress;
mod record;
mod report;
mod run;
mod speed;
mod summary;

use std::process::ExitCode;

use clap::FromArgMatches;

use crate::args::Cli;

/// The pose passed verification, or the command did what it was asked.
const SUCCESS: u8 = 0;
/// No pose that can be trusted.
const NO_POSE: u8 = 1;
/// The input, the options or a file cannot be used.
const BAD_INPUT: u8 = 2;

fn main() -> ExitCode {
    let typed = Cli::from_arg_matches(&args::command().get_matches());
    let code = run::run(typed.unwrap_or_else(|error| error.exit())).unwrap_or_else(|error| {
        summary::say(&format!("error: {error:#}"));
        code_of(&error)
    });
    ExitCode::from(code)
}

fn code_of(error: &anyhow::Error) -> u8 {
    match error.downcast_ref::<rare::Error>() {
        Some(rare::Error::NoPose { .. }) => NO_POSE,
        _ => BAD_INPUT,
    }
}
