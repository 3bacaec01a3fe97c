//! Writes every pose that the refiner compared on a benchmark folder, with its errors and signals: what
//! `benches/calibration/fit_ranking.py` fits the models of screening and ranking to.
//!
//! `cargo run --release --example compared_poses -- FOLDER PAIRS.json STARTS.json EVERY FIRST > poses.jsonl`
//!
//! FOLDER is one of `rare eval folder`, PAIRS.json and STARTS.json lie in it. Of its pairs one in EVERY is taken,
//! beginning with number FIRST (1 and 0 take all).
#![expect(
    clippy::print_stderr,
    reason = "says what is wrong with the arguments, and how far it has come"
)]
#![expect(clippy::print_stdout, reason = "poses go to stdout")]

use std::process::ExitCode;

use nalgebra::Matrix4;
use rare::eval::dataset::{DatasetPair, StartPose, read_folder, read_folder_starts};
use rare::{Error, Hypothesis, Refiner, RefinerConfig, Result, RigidTransform, Scan};
use serde::Serialize;

const USAGE: &str = "usage: compared_poses FOLDER PAIRS.json STARTS.json EVERY FIRST";

/// A pose of a pair and what was known of it.
#[derive(Serialize)]
struct ComparedPose {
    folder: String,
    source: usize,
    reference: usize,
    rotation_error_degrees: f64,
    translation_error_metres: f64,
    /// Whether depth maps were matched under it, or it was only screened.
    supported: bool,
    signals: serde_json::Map<String, serde_json::Value>,
}

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
    let [folder, pairs, starts, every, first] = arguments else {
        return Err(Error::invalid(USAGE));
    };
    let [every, first] = [number(every)?, number(first)?];
    let data = read_folder(folder, pairs, "gt")?;
    let starts = read_folder_starts(std::path::Path::new(folder).join(starts))?;
    let refiner = Refiner::new(RefinerConfig::default());
    for pair in data.pairs.iter().skip(first).step_by(every.max(1)) {
        eprintln!("{} {}-{}", data.name, pair.truth.source, pair.truth.reference);
        for pose in compared(&refiner, pair, &starts)? {
            println!(
                "{}",
                serde_json::to_string(&pose).map_err(|cause| Error::invalid(cause.to_string()))?
            );
        }
    }
    Ok(())
}

fn number(argument: &str) -> Result<usize> {
    argument
        .parse()
        .map_err(|cause| Error::invalid(format!("{argument:?} is no number: {cause}; {USAGE}")))
}

/// What the refiner compares on its way from the start that is given for a pair; nothing without a start.
fn compared(
    refiner: &Refiner,
    pair: &DatasetPair,
    starts: &[StartPose],
) -> Result<Vec<ComparedPose>> {
    let truth = &pair.truth;
    let own =
        |start: &&StartPose| (start.source, start.reference) == (truth.source, truth.reference);
    let Some(start) = starts.iter().find(own) else {
        return Ok(Vec::new());
    };
    let read = |path| rare::io::read_cloud(path).map(Scan::from);
    let (source, reference) = (read(&pair.source)?, read(&pair.reference)?);
    let initial = RigidTransform::from_matrix(&start.target_from_source)?;
    let refinement = refiner.refine(&source, &reference, &initial)?;
    let record = |hypothesis: &Hypothesis| record(pair, hypothesis, &truth.target_from_source);
    refinement.hypotheses.iter().map(record).collect()
}

fn record(
    pair: &DatasetPair,
    hypothesis: &Hypothesis,
    truth: &Matrix4<f64>,
) -> Result<ComparedPose> {
    let error = hypothesis.target_from_source.error_to(&RigidTransform::from_matrix(truth)?);
    let signals = hypothesis.evidence.signals().into_iter();
    Ok(ComparedPose {
        folder: pair.truth.scene.clone(),
        source: pair.truth.source,
        reference: pair.truth.reference,
        rotation_error_degrees: error.rotation_degrees,
        translation_error_metres: error.translation,
        supported: hypothesis.evidence.support.is_some(),
        signals: signals.map(|(name, value)| (name.to_owned(), value.into())).collect(),
    })
}
