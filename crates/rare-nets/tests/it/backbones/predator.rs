//! Predator against recorded stages of the official code.

use rare::nalgebra::Point3;
use rare_nets::backbones::Selection;
use rare_nets::backbones::kpconv::{NeighbourLimits, PyramidConfig};
use rare_nets::backbones::predator::{Predator, PredatorConfig, layout};

use super::recorded::{
    TOLERANCE, clouds, compare, compare_change, described, finds_the_step, moved, official_layout,
    pyramid, weights,
};
use crate::shared::{GoldenTensors, relative_difference};

fn tiny() -> PredatorConfig {
    let rooms = PredatorConfig::three_d_match();
    PredatorConfig {
        pyramid: PyramidConfig { voxel: 0.1, ..rooms.pyramid },
        width: 32,
        coarse_channels: 32,
        ..rooms
    }
}

#[test]
fn every_stage_is_the_official_one() {
    let Some(golden) = GoldenTensors::open("backbones/predator_tiny.safetensors") else { return };
    let Some(weights) = weights("predator_tiny") else { return };
    let network = Predator::load(&weights, tiny()).unwrap();
    let output = network.run(&pyramid(&golden, &tiny().pyramid)).unwrap();
    for (features, name) in output.encoded.iter().zip(["enc.1", "enc.4", "enc.7"]) {
        compare(&golden, name, features);
    }
    compare(&golden, "bottle", &output.bottleneck);
    let [alone, together, again] = &output.attended;
    for (cloud, call) in ["", "#call2"].into_iter().enumerate() {
        compare(&golden, &format!("gnn.0{call}"), &alone[cloud]);
        // The official code records what the attention adds.
        compare_change(&golden, &format!("gnn.1{call}"), &together[cloud], &alone[cloud]);
        compare(&golden, &format!("gnn.2{call}"), &again[cloud]);
    }
    compare(&golden, "dec.5", &output.decoded);
    compare(&golden, "out.feats_f", &output.features);
    for (name, scores) in [("overlap", &output.overlap), ("saliency", &output.saliency)] {
        let golden = golden.array(&format!("out.scores_{name}")).values;
        let difference = relative_difference(scores, &golden);
        println!("predator {name}: {difference:.1e}");
        assert!(difference < TOLERANCE, "{name}: {difference:.2e}");
    }
    assert_eq!(output.degrees, [10, 10]);
}

#[test]
fn tensors_are_those_of_the_official_models() {
    let Some(official) = official_layout("predator_indoor") else { return };
    assert!(layout(&PredatorConfig::three_d_match()) == official);
    let Some(official) = official_layout("predator_kitti") else { return };
    assert!(layout(&PredatorConfig::kitti()) == official);
}

fn network() -> Option<Predator> {
    let mut config = tiny();
    config.ransac.inlier_threshold = 0.1;
    Some(Predator::load(&weights("predator_tiny")?, config).unwrap())
}

#[test]
fn two_clouds_are_described_whatever_the_number_of_threads() {
    let Some(golden) = GoldenTensors::open("backbones/predator_tiny.safetensors") else { return };
    let Some(network) = network() else { return };
    let [source, target] = clouds(&golden);
    let limits = NeighbourLimits(vec![24; 4]);
    let selection = Selection { count: 300, ..Selection::default() };
    let description =
        described(|| network.describe(&source, &target, &limits, &selection).unwrap());
    for (side, cloud) in [(&description.source, &source), (&description.target, &target)] {
        assert_eq!((side.features.len(), side.features.dimension()), (300, 32));
        assert!(side.scores.is_sorted_by(|a, b| a >= b) && side.scores[0] <= 1.0);
        assert!(side.features.points().iter().all(|point| cloud.contains(point)));
    }
    assert_eq!(description.correspondences.len(), 300);
    assert!(description.warnings.is_empty(), "{:?}", description.warnings);
}

#[test]
fn a_moved_cloud_is_found() {
    let Some(golden) = GoldenTensors::open("backbones/predator_tiny.safetensors") else { return };
    let Some(network) = network() else { return };
    let [cloud, _] = clouds(&golden);
    let limits = NeighbourLimits(vec![24; 4]);
    let selection = Selection { count: 800, ..Selection::default() };
    let description = network.describe(&cloud, &moved(&cloud), &limits, &selection).unwrap();
    finds_the_step(&description, 0.02);
}

#[test]
fn small_clouds_are_described_with_a_warning_and_single_points_refused() {
    let Some(network) = network() else { return };
    let (limits, selection) = (NeighbourLimits(vec![24; 4]), Selection::default());
    let wall = |width: usize| -> Vec<Point3<f64>> {
        let place = |index: usize| [index % width, index / width].map(|step| step as f64 * 0.1);
        (0..width * width).map(place).map(|[x, y]| Point3::new(x, y, 2.0 + 0.1 * x * y)).collect()
    };
    let small = wall(16);
    let description = network.describe(&small, &small, &limits, &selection).unwrap();
    assert!(
        description.warnings[0].contains("nearest coarse points"),
        "{:?}",
        description.warnings
    );
    let refused = |cloud: &[Point3<f64>]| {
        network.describe(&small, cloud, &limits, &selection).unwrap_err().to_string()
    };
    assert!(refused(&wall(1)).contains("at least 2 coarse points"));
    assert!(refused(&[]).contains("0 points"));
    assert!(refused(&[Point3::new(0.0, f64::NAN, 0.0)]).contains("NaN"));
    let sparse: Vec<_> = small.iter().map(|point| point * 30.0).collect();
    let warnings = network.describe(&small, &sparse, &limits, &selection).unwrap().warnings;
    assert!(warnings[0].contains("trained on points 0.1 m apart"), "{warnings:?}");
}
