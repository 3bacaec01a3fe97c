//! `rare weights check FILE`: which network a checkpoint is of, and whether it is whole.

use std::path::Path;

use anyhow::{Result, bail};
use rare_nets::checkpoint::{Differences, Misshapen, Parameters};
use rare_nets::networks::{self, Identity};

use crate::run::print;
use crate::{BAD_INPUT, SUCCESS};

/// Names listed before the rest is only counted.
const LISTED: usize = 20;

/// Prints what a file holds; every weight is read once, so that damage shows.
pub(super) fn check(file: &Path) -> Result<u8> {
    let parameters = networks::open(file)?;
    let Some(identity) = networks::identify(&parameters) else {
        let first: Vec<&str> = parameters.names().take(3).collect();
        bail!(
            "{}: of no network on points that is known: {} tensors ({}, ...); a diffusion pipeline is checked as a folder",
            file.display(),
            parameters.names().count(),
            first.join(", ")
        );
    };
    print(&describe(&identity, &parameters))?;
    if !identity.differences.is_empty() {
        return Ok(BAD_INPUT);
    }
    networks::check(&identity, &parameters)?;
    Ok(SUCCESS)
}

fn describe(identity: &Identity, parameters: &Parameters) -> String {
    let numbers: usize =
        parameters.names().filter_map(|name| parameters.shape(name)).map(size).sum();
    let Differences { missing, surplus, misshapen } = &identity.differences;
    let lines = [
        ("network", identity.network.to_string()),
        ("trained on", format!("data like {}", identity.trained_on)),
        ("configuration", identity.configuration.clone()),
        ("tensors", format!("{} with {numbers} numbers", parameters.names().count())),
        ("missing", listed(missing)),
        ("surplus", listed(surplus)),
        ("of another shape", listed(&shapes(misshapen))),
    ];
    lines.into_iter().map(|(name, value)| format!("{name:<18}{value}\n")).collect()
}

fn size(shape: &[usize]) -> usize {
    shape.iter().product()
}

fn shapes(misshapen: &[Misshapen]) -> Vec<String> {
    misshapen.iter().map(ToString::to_string).collect()
}

/// The names, or as many as anyone reads.
fn listed(names: &[String]) -> String {
    match names.len() {
        0 => "none".to_owned(),
        count if count > LISTED => {
            format!("{}, and {} more", names[..LISTED].join(", "), count - LISTED)
        }
        _ => names.join(", "),
    }
}
