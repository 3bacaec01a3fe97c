//! Refines every labelled pair of a benchmark folder in one process and prints one line per pair, for development:
//! evidence beside the truth.
//!
//! `cargo run --release --example measure_refiner -- FOLDER PAIRS.json INIT.json [paper] [key=value ...]`
#![expect(clippy::print_stdout, clippy::unwrap_used, reason = "a measuring program")]

use std::collections::BTreeMap;
use std::path::Path;
use std::time::Instant;

use nalgebra::Matrix4;
use rare::{Correspondence, Recipe, Refiner, RefinerConfig, RigidTransform, Scan};
use serde_json::Value;

fn transform(value: &Value) -> RigidTransform {
    let numbers: Vec<f64> = value
        .as_array()
        .unwrap()
        .iter()
        .flat_map(|row| row.as_array().unwrap())
        .map(|x| x.as_f64().unwrap())
        .collect();
    RigidTransform::from_matrix(&Matrix4::from_row_slice(&numbers)).unwrap()
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let folder = Path::new(&arguments[0]);
    let json = |name: &str| -> Value {
        serde_json::from_slice(&std::fs::read(folder.join(name)).unwrap()).unwrap()
    };
    let pairs = json(&arguments[1]);
    let initials = json(&arguments[2]);
    let mut config = serde_json::to_value(RefinerConfig::default()).unwrap();
    if arguments.iter().any(|a| a == "paper") {
        config["recipe"] = serde_json::to_value(Recipe::paper()).unwrap();
    }
    let verbose = arguments.iter().any(|a| a == "-v");
    for setting in arguments.iter().filter_map(|a| a.split_once('=')) {
        let value = serde_json::from_str(setting.1).unwrap_or(Value::String(setting.1.to_owned()));
        let object =
            if config.get(setting.0).is_some() { &mut config } else { &mut config["recipe"] };
        object[setting.0] = value;
    }
    let config: RefinerConfig = serde_json::from_value(config).unwrap();
    let lidar = folder.to_string_lossy().contains("lidar");
    let (limit_degrees, limit_metres) = if lidar { (5.0, 0.6) } else { (15.0, 0.3) };
    let inlier_distance = if lidar { 0.6 } else { 0.1 };
    let mut clouds = BTreeMap::new();
    let (mut count, mut solved_before, mut solved_after, mut lost) = (0, 0, 0, 0);
    let (mut rotation, mut translation, mut seconds) = (0.0, 0.0, 0.0);
    let mut timings: BTreeMap<String, f64> = BTreeMap::new();
    let mut sets: BTreeMap<String, (usize, usize)> = BTreeMap::new();
    for pair in pairs.as_array().unwrap() {
        let (source_id, target_id) = (pair["src"].as_u64().unwrap(), pair["ref"].as_u64().unwrap());
        let entry = initials["pairs"]
            .as_array()
            .unwrap()
            .iter()
            .find(|e| e["src"] == pair["src"] && e["ref"] == pair["ref"]);
        let Some(entry) = entry else { continue };
        let (truth, initial) = (transform(&pair["gt"]), transform(&entry["init"]));
        for id in [source_id, target_id] {
            let read = || {
                Scan::from(
                    rare::io::read_cloud(folder.join(format!("cloud_bin_{id}.ply"))).unwrap(),
                )
            };
            clouds.entry(id).or_insert_with(read);
        }
        let start = Instant::now();
        let result = match Refiner::new(config.clone()).refine(
            &clouds[&source_id],
            &clouds[&target_id],
            &initial,
        ) {
            Ok(result) => result,
            Err(error) => {
                println!("{source_id:3} {target_id:3} {error}");
                continue;
            }
        };
        seconds += start.elapsed().as_secs_f64();
        let (before, after) =
            (initial.error_to(&truth), result.target_from_source.error_to(&truth));
        let solved = |e: &rare::data::PoseError| {
            e.rotation_degrees < limit_degrees && e.translation < limit_metres
        };
        count += 1;
        solved_before += usize::from(solved(&before));
        lost += usize::from(solved(&before) && !solved(&after));
        if solved(&after) {
            solved_after += 1;
            rotation += after.rotation_degrees;
            translation += after.translation;
        }
        for timing in &result.timings {
            *timings.entry(timing.step.clone()).or_default() += timing.seconds;
        }
        for set in &result.matches.sets {
            let right = |pair: &&Correspondence| {
                (truth.apply(&pair.source) - pair.target).norm() < inlier_distance
            };
            let entry = sets.entry(set.name.to_string()).or_default();
            entry.0 += set.pairs.len();
            entry.1 += set.pairs.iter().filter(right).count();
        }
        if verbose {
            println!(
                "{source_id:3} {target_id:3} {:6.2} {:6.3} -> {:6.2} {:6.3} {} {:9} conf {:.2} ov {:.2} inl {}/{} agree {} occ {} viol {} seen {} truth",
                before.rotation_degrees,
                before.translation,
                after.rotation_degrees,
                after.translation,
                if solved(&after) { "ok " } else { "BAD" },
                format!("{:?}", result.verdict),
                result.confidence,
                result.overlap,
                result.inliers,
                result.correspondences,
                result.consistency.agree,
                result.consistency.occluded,
                result.consistency.violation,
                result.consistency.seen
            );
        }
    }
    let n = f64::from(count);
    println!(
        "{} {} {}: n {count} RR {:.1} -> {:.1} RE {:.2} TE {:.1} cm lost {lost}, {:.0} ms",
        folder.file_name().unwrap().to_string_lossy(),
        arguments[1],
        arguments[2],
        100.0 * solved_before as f64 / n,
        100.0 * solved_after as f64 / n,
        rotation / solved_after as f64,
        100.0 * translation / solved_after as f64,
        1e3 * seconds / n
    );
    if verbose {
        for (name, time) in timings {
            println!("  {name} {:.0} ms", 1e3 * time / n);
        }
        for (name, (all, good)) in sets {
            println!("  {name} {:.0} pairs, {:.3} right", all as f64 / n, good as f64 / all as f64);
        }
    }
}
