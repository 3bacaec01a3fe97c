//! PointDSC, tensor by tensor.

use std::collections::BTreeSet;

use rare::pose::{Mode, PoseEstimator};
use rare_nets::outliers::pointdsc::{PointDsc, PointDscConfig, layout};

use super::*;
use crate::shared::Golden;

fn golden() -> Option<(Golden, PointDsc)> {
    let parameters = parameters("pointdsc_random.safetensors")?;
    let config = PointDscConfig::three_d_match(Mode::Faithful);
    let network = PointDsc::load(&parameters, config).unwrap();
    Some((Golden::open("estimators/pointdsc_random.npz")?, network))
}

#[test]
fn the_layout_is_that_of_the_checkpoints() {
    let Some(listed) = listed_layout("pointdsc_random.tensors.txt") else { return };
    assert_eq!(listed.len(), 358);
    assert_eq!(layout(), listed);
}

#[test]
fn features_and_confidences_are_those_of_the_official_code() {
    let (Some((mut golden, network)), Some(pairs)) = (golden(), golden_pairs()) else { return };
    let mut watched = Vec::new();
    let encoding = network
        .encode(&pairs, |number, features| watched.push((number, features.clone())))
        .unwrap();
    assert!(watched.iter().map(|(number, _)| *number).eq(0..=12));
    let features = [("layer0", 0), ("block0", 1), ("features", 12)];
    for (name, number) in features {
        assert!(feature_error(&mut golden, name, &watched[number].1) < 1e-4);
    }
    assert_eq!(watched[12].1, encoding.features);
    let confidences = golden.array("confidence").values;
    let error = relative_difference(&encoding.confidences, &confidences);
    println!("confidence: {error:.1e}");
    assert!(error < 1e-4);
    let seeds: BTreeSet<usize> = golden.array("seeds").usize().into_iter().collect();
    let found: BTreeSet<usize> = encoding.seeds.iter().copied().collect();
    println!("seeds: {} of {} differ", seeds.difference(&found).count(), seeds.len());
    assert_eq!(found, seeds);
}

#[test]
fn labels_and_pose_are_those_of_the_official_code() {
    let (Some((mut golden, network)), Some(pairs)) = (golden(), golden_pairs()) else { return };
    let estimate = network.estimate(&no_cloud(), &no_cloud(), &pairs).unwrap();
    assert!(pose_error(&estimate.target_from_source, &golden_pose(&mut golden)) < 1e-3);
    let labels = golden.array("labels").values;
    let labelled: Vec<usize> = (0..labels.len()).filter(|&i| labels[i] > 0.5).collect();
    assert_eq!(estimate.inliers, labelled);
    assert_eq!(estimate.score, labelled.len() as f64 / pairs.len() as f64);
}

#[test]
fn nothing_depends_on_the_number_of_threads() {
    let (Some((_, network)), Some(pairs)) = (golden(), golden_pairs()) else { return };
    let run = || {
        let encoding = network.encode(&pairs, |_, _| ()).unwrap();
        (encoding, network.estimate(&no_cloud(), &no_cloud(), &pairs).unwrap())
    };
    assert_eq!(on_threads(1, run), on_threads(3, run));
}

#[test]
fn a_clear_case_is_solved_and_a_hopeless_one_refused() {
    let Some(parameters) = parameters("pointdsc_random.safetensors") else { return };
    for mode in [Mode::Faithful, Mode::Fixed] {
        let network = PointDsc::load(&parameters, PointDscConfig::three_d_match(mode)).unwrap();
        solves_the_clear_and_refuses_the_hopeless(&network);
    }
}

#[test]
fn settings_that_make_no_sense_are_refused() {
    let Some(parameters) = parameters("pointdsc_random.safetensors") else { return };
    let mut config = PointDscConfig::kitti(Mode::Fixed);
    config.consensus.seed_ratio = f64::NAN;
    assert!(PointDsc::load(&parameters, config).is_err());
}
