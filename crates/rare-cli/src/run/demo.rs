//! `rare demo`: a registration with a known answer.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use rare::synthetic::{ScanPair, demo_pair};
use rare::{RigidTransform, io as files};

use crate::args::{Clouds, DemoArgs, Direction, Start};
use crate::options::Options;
use crate::outputs::{self, Output};
use crate::run::{Registration, aligned, refine};
use crate::summary;

/// The colour of the source cloud.
const ORANGE: [u8; 3] = [230, 120, 20];
/// The colour of the reference cloud.
const BLUE: [u8; 3] = [40, 110, 200];

pub(super) fn run(args: &DemoArgs) -> Result<u8> {
    let folder = &args.output_dir;
    check_shown(args)?;
    fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
    let pair = demo_pair(args.seed)?;
    let (clouds, start) = write_inputs(folder, &pair)?;
    let settings = Options {
        output: Some(folder.join("result.txt")),
        json: Some(folder.join("result.json")),
        report: args.report.clone(),
        figures: args.figures.clone(),
        quiet: Some(args.quiet),
        ..Options::default()
    }
    .resolve()?;
    let registration = refine::registration(&clouds, &start, settings)?;
    write_views(folder, &registration, &pair.initial)?;
    let code = registration.finish()?;
    if !args.quiet {
        summary::say(&comparison(&pair, &registration));
        summary::say(&what_was_written(folder));
    }
    Ok(code)
}

/// Refuses places for the page and the figures before anything is made.
fn check_shown(args: &DemoArgs) -> Result<()> {
    let report = args.report.iter().map(|path| Output { option: "--report", path });
    outputs::check(&[], &report.collect::<Vec<_>>())?;
    args.figures.iter().try_for_each(|folder| outputs::check_folder("--figures", folder))
}

/// Writes what `rare refine` needs, so that anybody can repeat the demo by hand.
fn write_inputs(folder: &Path, pair: &ScanPair) -> Result<(Clouds, Start)> {
    let clouds =
        Clouds { source: folder.join("source.ply"), reference: folder.join("reference.ply") };
    let init = folder.join("initial.txt");
    files::write_cloud(&clouds.source, &pair.source.world_points())?;
    files::write_cloud(&clouds.reference, &pair.target.world_points())?;
    files::write_pose(&init, &pair.initial)?;
    let start = Start {
        init,
        init_direction: Direction::SourceToTarget,
        source_features: None,
        reference_features: None,
        correspondences: None,
    };
    Ok((clouds, start))
}

/// Writes both clouds in one file, as they lay before and as they lie after.
fn write_views(folder: &Path, registration: &Registration, initial: &RigidTransform) -> Result<()> {
    let (source, reference) = (&registration.source, &registration.reference);
    let reference_points = reference.cloud.world_points();
    let found = &registration.refinement.target_from_source;
    for (name, pose) in [("before.ply", initial), ("after.ply", found)] {
        let moved = aligned(source, reference, pose);
        files::write_coloured_ply(
            folder.join(name),
            &[(&reference_points, BLUE), (&moved, ORANGE)],
        )?;
    }
    Ok(())
}

/// The errors against the truth.
fn comparison(pair: &ScanPair, registration: &Registration) -> String {
    let line = |name: &str, pose: &RigidTransform| {
        let error = pose.error_to(&pair.target_from_source);
        format!(
            "  {name:<14} rotation {:.3} degrees, translation {:.2} cm\n",
            error.rotation_degrees,
            100.0 * error.translation
        )
    };
    format!(
        "error against the known truth (the scans overlap by {:.0} %)\n{}{}",
        100.0 * pair.overlap,
        line("before", &pair.initial),
        line("after", &registration.refinement.target_from_source).trim_end()
    )
}

fn what_was_written(folder: &Path) -> String {
    let shown = |name: &str| -> String { PathBuf::from(folder).join(name).display().to_string() };
    format!(
        "wrote {} with the scans (source.ply, reference.ply), the start (initial.txt), the result (result.txt, \
         result.json)\nand both clouds in colour (before.ply, after.ply); the same by hand:\n  rare refine {} {} --init {}",
        folder.display(),
        shown("source.ply"),
        shown("reference.ply"),
        shown("initial.txt")
    )
}
