//! `--report`: a registration as one HTML page that needs nothing else, neither files nor a network.
//!
//! The page is a template with the viewer's scripts, the data as JSON, and point clouds as quantised binary numbers. The
//! scripts show every text as text, so that no name in it can be anything else.

mod clouds;
mod command;
mod data;
mod index;
mod page;

use std::path::Path;

use anyhow::{Context, Result};
use rare::io::write_whole;
use rare::refine::{Illustration, IllustrationRequest};
use rare::{Refinement, Refiner, RigidTransform, Scan};

use self::data::Report;
pub(crate) use self::index::{Index, Pages};
use crate::run::Registration;

/// Of each cloud no more points than that are drawn.
const MOST_POINTS: usize = 1_000_000;

/// Looks again at a pair that was registered. The transforms are those of the pages: as given, initial, result.
///
/// # Errors
/// As those of the refiner.
pub(crate) fn illustrate(
    refiner: &Refiner,
    [source, reference]: [&Scan; 2],
    initial: Option<&RigidTransform>,
    refinement: &Refinement,
) -> rare::Result<Illustration> {
    let result = refinement.target_from_source;
    let given = RigidTransform::identity();
    let request = IllustrationRequest {
        seen_from: initial.copied().unwrap_or(result),
        poses: [Some(given), initial.copied(), Some(result)].into_iter().flatten().collect(),
        most_points: MOST_POINTS,
    };
    refiner.illustrate(source, reference, &request)
}

/// Writes the page of a registration.
///
/// # Errors
/// If the file cannot be written.
pub(crate) fn write(
    file: &Path,
    registration: &Registration,
    illustration: &Illustration,
) -> Result<()> {
    let report = Report::new(registration, illustration)?;
    let page = page::of_registration(&report)?;
    write_whole(file, |writer| writer.write_all(page.as_bytes())).context("--report")
}

/// Writes the page of an evaluation.
///
/// # Errors
/// If the file cannot be written.
pub(crate) fn write_index(file: &Path, index: &Index) -> Result<()> {
    let page = page::of_evaluation(index)?;
    write_whole(file, |writer| writer.write_all(page.as_bytes())).context("--report")
}
