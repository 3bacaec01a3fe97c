//! Writes a benchmark of simulated scans in the layout of `rare eval folder`: clouds, pairs with their truth, and three
//! sets of initial transforms.
//!
//! `cargo run --release --example synthetic_benchmark -- rooms|streets|objects COUNT SEED FOLDER`
//!
//! The same arguments give the same bytes.
#![expect(clippy::print_stderr, reason = "says what is wrong with the arguments")]

mod benchmark;

use std::path::Path;
use std::process::ExitCode;

use benchmark::Scenes;
use rare::{Error, Result};

const USAGE: &str = "usage: synthetic_benchmark rooms|streets|objects COUNT SEED FOLDER";

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    match run(&arguments) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::from(2)
        }
    }
}

fn run(arguments: &[String]) -> Result<()> {
    let [scenes, count, seed, folder] = arguments else {
        return Err(Error::invalid(USAGE));
    };
    let seed = seed
        .parse()
        .map_err(|cause| Error::invalid(format!("the seed is {seed:?}: {cause}; {USAGE}")))?;
    let count = count.parse().map_err(|cause| {
        Error::invalid(format!("the number of pairs is {count:?}: {cause}; {USAGE}"))
    })?;
    benchmark::write(Scenes::named(scenes)?, count, seed, Path::new(folder))
}
