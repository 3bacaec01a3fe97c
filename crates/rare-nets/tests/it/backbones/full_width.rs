//! What networks of the published widths cost: run by hand, one at a time, with `--ignored --nocapture`.

use std::fs;
use std::path::Path;

use rare::nalgebra::Point3;
use rare_nets::backbones::cofinet::{self, CoFiNet, CoFiNetConfig};
use rare_nets::backbones::fcgf::FcgfConfig;
use rare_nets::backbones::kpconv::NeighbourLimits;
use rare_nets::backbones::predator::{self, Predator, PredatorConfig};
use rare_nets::backbones::{Description, Selection};
use rare_nets::checkpoint::{Layout, Parameters};

use super::formula::{open_tensors, uniform};
use crate::shared::GoldenTensors;

/// CPU seconds of this process so far, and its largest resident memory, MB (Linux).
fn used() -> (f64, f64) {
    let stat = fs::read_to_string("/proc/self/stat").unwrap();
    let fields: Vec<&str> = stat.rsplit(')').next().unwrap().split_whitespace().collect();
    let ticks = fields[11].parse::<f64>().unwrap() + fields[12].parse::<f64>().unwrap();
    let status = fs::read_to_string("/proc/self/status").unwrap();
    let peak = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).unwrap();
    let peak: f64 = peak.trim().trim_end_matches(" kB").parse().unwrap();
    (ticks / 100.0, peak / 1024.0)
}

/// The recorded pair of rooms at 2.5 cm.
fn rooms() -> Option<[Vec<Point3<f64>>; 2]> {
    let golden = GoldenTensors::open("backbones/geotransformer_full3dmatch.safetensors")?;
    let values = golden.array("in.points.0").values;
    let points: Vec<_> = values.chunks_exact(3).map(|p| Point3::new(p[0], p[1], p[2])).collect();
    let (target, source) = points.split_at(golden.array("in.lengths.0").usize()[0]);
    Some([source.to_vec(), target.to_vec()])
}

fn measured<T>(what: &str, work: impl FnOnce() -> T) -> T {
    let before = used();
    let result = work();
    let after = used();
    println!(
        "{what}: {:.2} s of CPU, peak {:.0} MB (before: {:.0} MB)",
        after.0 - before.0,
        after.1,
        before.1
    );
    result
}

#[test]
#[ignore = "measures"]
fn fcgf_on_rooms() {
    let Some([source, target]) = rooms() else { return };
    let config = FcgfConfig::three_d_match();
    let network = super::fcgf::load(&config, &[], config.clone()).unwrap();
    measured("fcgf: source alone", || network.run(&source).unwrap());
    let selection = Selection { count: 5000, ..Selection::default() };
    let description =
        measured("fcgf: pair", || network.describe(&source, &target, &selection).unwrap());
    say(&description);
}

fn say(description: &Description) {
    let keypoints = [&description.source, &description.target].map(|side| side.features.len());
    println!(
        "{keypoints:?} keypoints, {} correspondences, pose: {}, {:?}",
        description.correspondences.len(),
        description.target_from_source.is_ok(),
        description.warnings
    );
}

/// Weights by the formula: uniform, as large as keeps the scale of activations; kernel points on a sphere.
fn weights(folder: &Path, layout: &Layout, kernel_radius: f32) -> Parameters {
    let tensor = |(name, shape): (&String, &Vec<usize>)| {
        let mut values: Vec<f32> =
            uniform(name, shape.iter().product()).map(|value| value as f32).collect();
        let factor = match shape.as_slice() {
            [_, inputs, _] if name.ends_with("KPConv.weights") => (3.0 / *inputs as f32).sqrt(),
            [_, 3] => kernel_radius,
            [_, inputs, ..] => (3.0 / *inputs as f32).sqrt(),
            [] => 1.0,
            _ => 0.1,
        };
        values.iter_mut().for_each(|value| *value *= factor);
        if name.ends_with("kernel_points") {
            for point in values.chunks_exact_mut(3) {
                let norm = point.iter().map(|value| value * value).sum::<f32>().sqrt();
                point.iter_mut().for_each(|value| *value *= 0.66 * kernel_radius / norm);
            }
        }
        (name.clone(), shape.clone(), values)
    };
    open_tensors(folder, &layout.iter().map(tensor).collect::<Vec<_>>())
}

/// The clouds twelve times as large, with the spacing of the networks for streets.
fn streets() -> Option<[Vec<Point3<f64>>; 2]> {
    Some(rooms()?.map(|cloud| cloud.iter().map(|point| point * 12.0).collect()))
}

fn selection() -> Selection {
    Selection { count: 5000, ..Selection::default() }
}

fn cofinet(
    config: CoFiNetConfig,
    limits: &NeighbourLimits,
    [source, target]: [Vec<Point3<f64>>; 2],
) {
    let folder = tempfile::tempdir().unwrap();
    let radius = config.pyramid.radius(0) as f32;
    let parameters = weights(folder.path(), &cofinet::layout(&config), radius);
    let network = CoFiNet::load(&parameters, config).unwrap();
    let expected = network.expected_bytes(&source, &target, limits).unwrap() >> 20;
    println!("expected: {expected} MB");
    let description = measured("cofinet: pair", || {
        network.describe(&source, &target, limits, &selection()).unwrap()
    });
    say(&description);
}

fn predator(
    config: PredatorConfig,
    limits: &NeighbourLimits,
    [source, target]: [Vec<Point3<f64>>; 2],
) {
    let folder = tempfile::tempdir().unwrap();
    let radius = config.pyramid.radius(0) as f32;
    let parameters = weights(folder.path(), &predator::layout(&config), radius);
    let network = Predator::load(&parameters, config).unwrap();
    let expected = network.expected_bytes(&source, &target, limits).unwrap() >> 20;
    println!("expected: {expected} MB");
    let description = measured("predator: pair", || {
        network.describe(&source, &target, limits, &selection()).unwrap()
    });
    say(&description);
}

#[test]
#[ignore = "measures"]
fn cofinet_on_rooms() {
    let Some(clouds) = rooms() else { return };
    cofinet(CoFiNetConfig::three_d_match(), &NeighbourLimits::three_d_match(), clouds);
}

#[test]
#[ignore = "measures"]
fn cofinet_on_streets() {
    let Some(clouds) = streets() else { return };
    cofinet(CoFiNetConfig::kitti(), &NeighbourLimits(vec![60, 80, 80, 80]), clouds);
}

#[test]
#[ignore = "measures"]
fn predator_on_rooms() {
    let Some(clouds) = rooms() else { return };
    predator(PredatorConfig::three_d_match(), &NeighbourLimits::three_d_match(), clouds);
}

#[test]
#[ignore = "measures"]
fn predator_on_streets() {
    let Some(clouds) = streets() else { return };
    predator(PredatorConfig::kitti(), &NeighbourLimits(vec![60, 80, 80, 80]), clouds);
}
