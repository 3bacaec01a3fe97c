//! SC2-PCR++ against the released implementation, and on synthetic candidates.

use nalgebra::{Point3, Vector3};
use rare::pose::{FeatureCandidates, Mode, Sc2Pcr, Sc2PcrPlusPlus};
use rare::random::Random;
use rare::{Correspondence, Error, PointFeatures, RigidTransform};

use crate::synthetic_pairs::{motion, synthetic};

fn in_mode(mode: Mode) -> Sc2PcrPlusPlus {
    let settings = Sc2PcrPlusPlus::three_d_match_fpfh();
    Sc2PcrPlusPlus { sc2_pcr: Sc2Pcr { mode, ..settings.sc2_pcr }, ..settings }
}

/// More pairs follow a wrong motion than the right one, but almost every keypoint has its true point among its
/// candidates.
fn misleading() -> (Vec<Correspondence>, FeatureCandidates) {
    let wrong = RigidTransform::from_translation(Vector3::new(0.0, 1.0, 0.0)) * motion();
    let mut pairs = synthetic(25, 1.0, &motion(), 42);
    pairs.extend(synthetic(35, 1.0, &wrong, 41));
    pairs.extend(synthetic(300, 0.0, &motion(), 43));
    let mut candidates = FeatureCandidates::of_pairs(&pairs);
    for (source, targets) in candidates.source.iter().zip(&mut candidates.targets) {
        targets.push(motion().apply(source));
    }
    (pairs, candidates)
}

#[test]
fn candidates_decide_where_matches_mislead() {
    let (pairs, candidates) = misleading();
    for mode in [Mode::Faithful, Mode::Fixed] {
        let settings = in_mode(mode);
        let by_matches = settings.sc2_pcr.hypotheses(&pairs, 1).unwrap();
        assert!(by_matches[0].target_from_source.error_to(&motion()).translation > 0.9);
        let found = settings.estimate_with(&pairs, &candidates).unwrap();
        let error = found.target_from_source.error_to(&motion());
        assert!(error.rotation_degrees < 0.5 && error.translation < 0.02, "{mode:?} {error:?}");
        assert!(found.score >= 300.0, "{}", found.score);
        assert!(found.runner_up.is_some_and(|other| other < 0.5 * found.score));
    }
}

#[test]
fn without_candidates_the_pose_of_sc2_pcr_stands() {
    let pairs = synthetic(200, 0.2, &motion(), 44);
    let none = FeatureCandidates::default();
    let found = in_mode(Mode::Fixed).estimate_with(&pairs, &none).unwrap();
    assert!(found.target_from_source.error_to(&motion()).translation < 0.02);
    assert_eq!((found.score, found.runner_up), (0.0, None));
    let message = in_mode(Mode::Faithful).estimate_with(&pairs, &none).unwrap_err().to_string();
    assert!(message.contains("near a candidate"), "{message}");
}

#[test]
fn a_match_further_off_than_it_may_be_is_taken_in_faithful_mode_alone() {
    // The nearest feature belongs to a point 13 cm off, another to the right one. In faithful mode the far points,
    // each to another side, are the new matches, of which hardly two are consistent.
    let pairs = synthetic(200, 0.3, &motion(), 45);
    let mut random = Random::new(46, 0);
    let mut candidates = FeatureCandidates::of_pairs(&pairs);
    for (source, targets) in candidates.source.iter().zip(&mut candidates.targets) {
        let side = Vector3::from_fn(|_, _| random.normal()).normalize();
        let right = motion().apply(source);
        *targets = vec![right + 0.13 * side, right];
    }
    let [faithful, fixed] = [Mode::Faithful, Mode::Fixed].map(|mode| {
        let settings = in_mode(mode);
        settings.estimate_with(&pairs, &candidates).unwrap().score
    });
    assert_eq!(fixed, 200.0);
    assert!(faithful < 150.0, "{faithful}");
}

#[test]
fn correspondences_and_candidates_come_from_features() {
    let mut random = Random::new(47, 0);
    let mut features = |count: usize| {
        let points = (0..count).map(|_| Point3::from([(); 3].map(|()| random.normal())));
        let points: Vec<_> = points.collect();
        let values = (0..4 * count).map(|_| random.normal() as f32).collect();
        PointFeatures::new(points, 4, values).unwrap()
    };
    let (source, target) = (features(300), features(200));
    let all = Sc2PcrPlusPlus { candidates: 7, ..in_mode(Mode::Fixed) };
    let (pairs, candidates) = all.correspond(&source, &target).unwrap();
    assert_eq!((pairs.len(), candidates.source.len()), (300, 300));
    for (pair, targets) in pairs.iter().zip(&candidates.targets) {
        assert_eq!((targets.len(), targets[0]), (7, pair.target));
    }
    for (mode, repeats) in [(Mode::Fixed, false), (Mode::Faithful, true)] {
        let drawn = Sc2PcrPlusPlus { keypoints: Some(100), ..in_mode(mode) };
        let (pairs, candidates) = drawn.correspond(&source, &target).unwrap();
        assert_eq!((pairs.len(), candidates.targets[0].len()), (100, 100));
        let mut sources: Vec<f64> = pairs.iter().map(|pair| pair.source.x).collect();
        sources.sort_by(f64::total_cmp);
        sources.dedup();
        assert_eq!(sources.len() < 100, repeats);
    }
    assert!(all.correspond(&source, &PointFeatures::new(vec![], 3, vec![]).unwrap()).is_ok());
}

#[test]
fn the_thresholds_are_checked() {
    let (pairs, candidates) = misleading();
    let settings = Sc2PcrPlusPlus { consistency_threshold: 0.0, ..Sc2PcrPlusPlus::kitti() };
    let message = settings.estimate_with(&pairs, &candidates).unwrap_err().to_string();
    assert!(message.contains("consistency threshold"), "{message}");
    let unrelated = synthetic(500, 0.0, &motion(), 48);
    let candidates = FeatureCandidates::of_pairs(&unrelated);
    let found = Sc2PcrPlusPlus::for_voxel(0.05).estimate_with(&unrelated, &candidates);
    assert!(matches!(found, Err(Error::NoPose { .. })), "{found:?}");
}
