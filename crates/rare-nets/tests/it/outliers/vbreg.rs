//! VBReg without noise, tensor by tensor.

use std::collections::BTreeSet;

use rare::Error;
use rare::pose::{Mode, PoseEstimator};
use rare_nets::outliers::vbreg::{Vbreg, VbregConfig, layout};

use super::*;
use crate::shared::Golden;

fn golden() -> Option<(Golden, Vbreg)> {
    let network = network(Mode::Faithful)?;
    Some((Golden::open("estimators/vbreg_random.npz")?, network))
}

fn network(mode: Mode) -> Option<Vbreg> {
    let parameters = parameters("vbreg_random.safetensors")?;
    Some(Vbreg::load(&parameters, VbregConfig::three_d_match(mode)).unwrap())
}

#[test]
fn the_layout_is_that_of_the_checkpoints() {
    let Some(listed) = listed_layout("vbreg_random.tensors.txt") else { return };
    assert_eq!(listed.len(), 342);
    assert_eq!(layout(), listed);
}

#[test]
fn features_and_confidences_are_those_of_the_official_code() {
    let (Some((mut golden, network)), Some(pairs)) = (golden(), golden_pairs()) else { return };
    let encoding = network.encode(&pairs).unwrap();
    assert!(feature_error(&mut golden, "features", &encoding.features) < 1e-4);
    let confidences = golden.array("confidence").values;
    let error = relative_difference(&encoding.confidences, &confidences);
    println!("confidence: {error:.1e}");
    assert!(error < 1e-4);
    let seeds = golden.array("seeds").usize();
    let positive = seeds.iter().zip(&encoding.seeds).take_while(|(a, b)| a == b).count();
    println!("seeds: the first {positive} of {} are the same", seeds.len());
    let all: BTreeSet<usize> = seeds.into_iter().collect();
    assert_eq!(encoding.seeds.iter().copied().collect::<BTreeSet<usize>>(), all);
}

#[test]
fn attention_is_that_of_the_official_code() {
    let (Some((mut golden, network)), Some(pairs)) = (golden(), golden_pairs()) else { return };
    let rows = network.attention(&pairs, 0, &[0, 1, 2, 3]).unwrap();
    let error = relative_difference(&rows.concat(), &golden.array("attention0").values);
    println!("attention of the first layer: {error:.1e}");
    assert!(error < 1e-4);
    assert!(matches!(network.attention(&pairs, 12, &[0]), Err(Error::InvalidInput(_))));
    assert!(matches!(network.attention(&pairs, 0, &[1000]), Err(Error::InvalidInput(_))));
}

#[test]
fn votes_and_poses_are_those_of_the_official_code() {
    let (Some((mut golden, network)), Some(pairs)) = (golden(), golden_pairs()) else { return };
    let encoding = network.encode(&pairs).unwrap();
    let seeds = golden.array("seeds").usize();
    let consensus = golden.array("consensus_idxs").usize();
    let fitness = golden.array("fitness").values;
    let (mut shared, mut same, mut error) = (0, 0, 0.0_f64);
    for ((seed, consensus), fitness) in seeds.iter().zip(consensus.chunks_exact(40)).zip(fitness) {
        let at = encoding.seeds.iter().position(|other| other == seed).unwrap();
        assert_eq!((consensus[0], encoding.consensus[at][0]), (*seed, *seed));
        let expected: BTreeSet<usize> = consensus.iter().copied().collect();
        let found: BTreeSet<usize> = encoding.consensus[at].iter().copied().collect();
        shared += found.intersection(&expected).count();
        if found == expected {
            same += 1;
            let found = encoding.poses[at].map_or(0.0, |(_, fitness)| fitness);
            error = error.max((found - fitness).abs());
        }
    }
    println!("consensus: {same} sets, {shared} members, fitness {error:.1e}");
    // Bounds take few values: the last members are often tied, and any of them may be taken.
    assert!(same > 950 && shared > 39_500 && error < 1e-5);
}

#[test]
fn labels_and_pose_are_those_of_the_official_code() {
    let (Some((mut golden, network)), Some(pairs)) = (golden(), golden_pairs()) else { return };
    let estimate = network.estimate(&no_cloud(), &no_cloud(), &pairs).unwrap();
    assert!(pose_error(&estimate.target_from_source, &golden_pose(&mut golden)) < 1e-3);
    let labels = golden.array("labels").values;
    let labelled: Vec<usize> = (0..labels.len()).filter(|&i| labels[i] > 0.5).collect();
    println!("{} of {} labels", estimate.inliers.len(), labelled.len());
    assert_eq!(estimate.inliers, labelled);
}

#[test]
fn nothing_depends_on_the_number_of_threads() {
    let (Some(parameters), Some(pairs)) = (parameters("vbreg_random.safetensors"), golden_pairs())
    else {
        return;
    };
    // More than one block of everything that is computed in blocks.
    let pairs = &pairs[..600];
    for noise in [None, Some(3)] {
        let config = VbregConfig { noise, ..VbregConfig::three_d_match(Mode::Fixed) };
        let network = Vbreg::load(&parameters, config).unwrap();
        let run = || {
            let encoding = network.encode(pairs).unwrap();
            (encoding, network.estimate(&no_cloud(), &no_cloud(), &pairs[..300]).ok())
        };
        assert_eq!(on_threads(1, run), on_threads(3, run));
    }
}

#[test]
fn noise_changes_features_and_repeats_with_its_seed() {
    let (Some(parameters), Some(pairs)) = (parameters("vbreg_random.safetensors"), golden_pairs())
    else {
        return;
    };
    let features = |noise| {
        let config = VbregConfig { noise, ..VbregConfig::three_d_match(Mode::Fixed) };
        Vbreg::load(&parameters, config).unwrap().encode(&pairs[..200]).unwrap().features
    };
    assert_eq!(features(Some(1)), features(Some(1)));
    assert_ne!(features(Some(1)), features(Some(2)));
    assert_ne!(features(Some(1)), features(None));
}

#[test]
fn a_clear_case_is_solved_and_a_hopeless_one_refused() {
    for mode in [Mode::Faithful, Mode::Fixed] {
        let Some(network) = network(mode) else { return };
        solves_the_clear_and_refuses_the_hopeless(&network);
    }
}
