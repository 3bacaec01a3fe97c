//! Predator against recorded stages of the official code.

use rare_nets::backbones::kpconv::PyramidConfig;
use rare_nets::backbones::predator::{Predator, PredatorConfig, layout};

use super::formula::official_layout;
use super::recorded::{TOLERANCE, compare, compare_change, pyramid, weights};
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
