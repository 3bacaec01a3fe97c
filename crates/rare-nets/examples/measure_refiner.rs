//! Refines every labelled pair of a benchmark folder in one process and prints one line per pair, for development:
//! evidence beside the truth.
//!
//! `cargo run --release --example measure_refiner -- FOLDER PAIRS.json INIT.json [paper] [-v] [key=value ...]`
//!
//! With `diffusion=PRESET weights=DIR` and perhaps `cache=DIR` the features of depth maps are those of Stable Diffusion,
//! so this is the program that measures what trained weights are worth.
#![expect(clippy::print_stdout, clippy::unwrap_used, reason = "a measuring program")]

use std::collections::BTreeMap;
use std::path::Path;
use std::time::Instant;

use rare::data::PoseError;
use rare::encode::DepthEncoder;
use rare::nalgebra::Matrix4;
use rare::scale::SceneKind;
use rare::{Correspondence, Recipe, Refinement, Refiner, RefinerConfig, RigidTransform, Scan};
use rare_nets::cache::{CachedEncoder, WeightsIdentity};
use rare_nets::diffusion::{DiffusionEncoder, Pipeline, Preset};
use rare_nets::engine::CpuBackend;
use serde_json::Value;

/// Settings that are not the refiner's.
const OTHER_SETTINGS: [&str; 3] = ["diffusion", "weights", "cache"];

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let folder = Path::new(&arguments[0]);
    let (pairs, initials) = (json(folder, &arguments[1]), json(folder, &arguments[2]));
    let refiner = refiner(&arguments);
    let verbose = arguments.iter().any(|argument| argument == "-v");
    let mut clouds = Clouds { folder, known: BTreeMap::new() };
    let mut totals = Totals::default();
    let limits = Limits::of(folder);
    for pair in pairs.as_array().unwrap() {
        let same = |entry: &&Value| entry["src"] == pair["src"] && entry["ref"] == pair["ref"];
        let Some(entry) = initials["pairs"].as_array().unwrap().iter().find(same) else { continue };
        let (truth, initial) = (transform(&pair["gt"]), transform(&entry["init"]));
        let ids = [&pair["src"], &pair["ref"]].map(|id| id.as_u64().unwrap());
        ids.into_iter().for_each(|id| clouds.read(id));
        let start = Instant::now();
        let (source, reference) = (&clouds.known[&ids[0]], &clouds.known[&ids[1]]);
        let result = refiner.refine(source, reference, &initial);
        let seconds = start.elapsed().as_secs_f64();
        let line = match &result {
            Ok(result) => totals.add(result, &truth, &initial, &limits, seconds),
            Err(error) => error.to_string(),
        };
        if verbose || result.is_err() {
            println!("{:3} {:3} {line}", ids[0], ids[1]);
        }
    }
    let name = folder.file_name().unwrap().to_string_lossy();
    println!("{name} {} {}: {}", arguments[1], arguments[2], totals.describe());
    if verbose {
        totals.print_details();
    }
}

fn json(folder: &Path, name: &str) -> Value {
    serde_json::from_slice(&std::fs::read(folder.join(name)).unwrap()).unwrap()
}

fn transform(value: &Value) -> RigidTransform {
    let rows = value.as_array().unwrap().iter().flat_map(|row| row.as_array().unwrap());
    let numbers: Vec<f64> = rows.map(|number| number.as_f64().unwrap()).collect();
    RigidTransform::from_matrix(&Matrix4::from_row_slice(&numbers)).unwrap()
}

/// `key=value` among the arguments.
fn setting<'a>(arguments: &'a [String], key: &str) -> Option<&'a str> {
    let pairs = arguments.iter().filter_map(|argument| argument.split_once('='));
    pairs.filter(|(name, _)| *name == key).map(|(_, value)| value).next_back()
}

fn refiner(arguments: &[String]) -> Refiner {
    let mut config = config(arguments);
    let Some(preset) = setting(arguments, "diffusion") else { return Refiner::new(config) };
    config.recipe = config.recipe.for_network();
    let encoder = encoder(arguments, preset);
    Refiner::new(config).with_encoder(encoder)
}

/// Loaded once for all pairs; features that come back are taken from the cache.
fn encoder(arguments: &[String], preset: &str) -> Box<dyn DepthEncoder> {
    let weights = setting(arguments, "weights").unwrap_or("weights");
    let pipeline = Pipeline::open(Path::new(weights)).unwrap();
    if let Some(remark) = &pipeline.remark {
        println!("warning: {remark}");
    }
    let settings = preset.parse::<Preset>().unwrap().settings();
    let lidar = arguments[0].contains("lidar");
    let kind = if lidar { SceneKind::Lidar } else { SceneKind::Indoor };
    let settings = settings.with_prompt_for(kind);
    let identity = WeightsIdentity::of(&pipeline.files).unwrap().on_this_machine;
    let identity = format!("{identity} {}", serde_json::to_string(&settings).unwrap());
    let backend = CpuBackend::new(settings.precision).unwrap();
    let encoder = DiffusionEncoder::load(backend, &pipeline, &settings).unwrap();
    let cache = setting(arguments, "cache").map(Path::new);
    Box::new(CachedEncoder::new(encoder, &identity, cache).unwrap())
}

fn config(arguments: &[String]) -> RefinerConfig {
    let mut config = serde_json::to_value(RefinerConfig::default()).unwrap();
    if arguments.iter().any(|argument| argument == "paper") {
        config["recipe"] = serde_json::to_value(Recipe::paper()).unwrap();
    }
    let pairs = arguments.iter().filter_map(|argument| argument.split_once('='));
    for (key, value) in pairs.filter(|(key, _)| !OTHER_SETTINGS.contains(key)) {
        let value = serde_json::from_str(value).unwrap_or(Value::String(value.to_owned()));
        let object = if config.get(key).is_some() { &mut config } else { &mut config["recipe"] };
        object[key] = value;
    }
    serde_json::from_value(config).unwrap()
}

/// Clouds are read once.
struct Clouds<'a> {
    folder: &'a Path,
    known: BTreeMap<u64, Scan>,
}

impl Clouds<'_> {
    fn read(&mut self, id: u64) {
        let file = self.folder.join(format!("cloud_bin_{id}.ply"));
        let read = || Scan::from(rare::io::read_cloud(file).unwrap());
        self.known.entry(id).or_insert_with(read);
    }
}

/// What counts as solved, and as a right correspondence.
struct Limits {
    degrees: f64,
    metres: f64,
    inlier_distance: f64,
}

impl Limits {
    fn of(folder: &Path) -> Limits {
        if folder.to_string_lossy().contains("lidar") {
            Limits { degrees: 5.0, metres: 0.6, inlier_distance: 0.6 }
        } else {
            Limits { degrees: 15.0, metres: 0.3, inlier_distance: 0.1 }
        }
    }

    fn solved(&self, error: &PoseError) -> bool {
        error.rotation_degrees < self.degrees && error.translation < self.metres
    }
}

/// Sums over pairs.
#[derive(Default)]
struct Totals {
    pairs: usize,
    solved_before: usize,
    solved_after: usize,
    lost: usize,
    rotation: f64,
    translation: f64,
    seconds: f64,
    timings: BTreeMap<String, f64>,
    /// Correspondences and right ones.
    sets: BTreeMap<String, (usize, usize)>,
}

impl Totals {
    /// Adds a pair; gives its line.
    fn add(
        &mut self,
        result: &Refinement,
        truth: &RigidTransform,
        initial: &RigidTransform,
        limits: &Limits,
        seconds: f64,
    ) -> String {
        let (before, after) = (initial.error_to(truth), result.target_from_source.error_to(truth));
        let (was_solved, solved) = (limits.solved(&before), limits.solved(&after));
        self.pairs += 1;
        self.seconds += seconds;
        self.solved_before += usize::from(was_solved);
        self.lost += usize::from(was_solved && !solved);
        if solved {
            self.solved_after += 1;
            self.rotation += after.rotation_degrees;
            self.translation += after.translation;
        }
        for timing in &result.timings {
            *self.timings.entry(timing.step.clone()).or_default() += timing.seconds;
        }
        self.add_sets(result, truth, limits.inlier_distance);
        line(&before, &after, solved, result)
    }

    fn add_sets(&mut self, result: &Refinement, truth: &RigidTransform, distance: f64) {
        for set in &result.matches.sets {
            let right = |pair: &&Correspondence| {
                (truth.apply(&pair.source) - pair.target).norm() < distance
            };
            let entry = self.sets.entry(set.name.to_string()).or_default();
            entry.0 += set.pairs.len();
            entry.1 += set.pairs.iter().filter(right).count();
        }
    }

    fn describe(&self) -> String {
        let (pairs, solved) = (self.pairs as f64, self.solved_after as f64);
        format!(
            "n {} RR {:.1} -> {:.1} RE {:.2} TE {:.1} cm lost {}, {:.0} ms",
            self.pairs,
            100.0 * self.solved_before as f64 / pairs,
            100.0 * solved / pairs,
            self.rotation / solved,
            100.0 * self.translation / solved,
            self.lost,
            1e3 * self.seconds / pairs
        )
    }

    fn print_details(&self) {
        let pairs = self.pairs as f64;
        for (name, time) in &self.timings {
            println!("  {name} {:.0} ms", 1e3 * time / pairs);
        }
        for (name, &(all, right)) in &self.sets {
            let (mean, share) = (all as f64 / pairs, right as f64 / all as f64);
            println!("  {name} {mean:.0} pairs, {share:.3} right");
        }
    }
}

fn line(before: &PoseError, after: &PoseError, solved: bool, result: &Refinement) -> String {
    let error =
        |error: &PoseError| format!("{:6.2} {:6.3}", error.rotation_degrees, error.translation);
    let consistency = &result.evidence.consistency;
    format!(
        "{} -> {} {} {:9} conf {:.2} ov {:.2} inl {}/{} agree {} occ {} viol {} gross {} truth",
        error(before),
        error(after),
        if solved { "ok " } else { "BAD" },
        format!("{:?}", result.verdict),
        result.confidence,
        result.overlap,
        result.inliers,
        result.correspondences,
        consistency.agree,
        consistency.occluded,
        consistency.violation,
        consistency.gross_violation
    )
}
