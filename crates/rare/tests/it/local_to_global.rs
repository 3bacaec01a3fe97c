//! Local-to-global registration on synthetic groups of correspondences.

use rare::pose::{LocalToGlobal, Mode};
use rare::{Correspondence, Error, RigidTransform};

use crate::synthetic_pairs::{motion, synthetic};

fn groups(count: usize, size: usize) -> Vec<Vec<usize>> {
    (0..count / size).map(|group| (group * size..(group + 1) * size).collect()).collect()
}

#[test]
fn one_right_group_is_enough() {
    // The first 50 of 1000 pairs are right: 10 groups of 5.
    let pairs = synthetic(1000, 0.05, &motion(), 31);
    for mode in [Mode::Faithful, Mode::Fixed] {
        let settings = LocalToGlobal { mode, ..LocalToGlobal::three_d_match() };
        let found = settings.estimate(&pairs, &groups(1000, 5)).unwrap();
        let error = found.target_from_source.error_to(&motion());
        assert!(error.rotation_degrees < 0.3 && error.translation < 0.01, "{error:?}");
        assert!((0..50).all(|i| found.inliers.contains(&i)));
        assert!(found.runner_up.is_some_and(|other| other < 0.3 * found.score));
        assert_eq!(found.iterations, 200);
    }
}

#[test]
fn scores_weigh_in_fits_but_not_in_votes() {
    let lifted =
        RigidTransform::from_translation(nalgebra::Vector3::new(0.05, 0.0, 0.0)) * motion();
    let mut pairs = synthetic(60, 1.0, &motion(), 32);
    let pale = |pair: &Correspondence| Correspondence { score: 1e-3, ..*pair };
    pairs.extend(synthetic(60, 1.0, &lifted, 33).iter().map(pale));
    let found = LocalToGlobal::three_d_match().estimate(&pairs, &groups(120, 10)).unwrap();
    assert!(found.target_from_source.error_to(&motion()).translation < 0.01);
    assert_eq!(found.score, 120.0);
}

#[test]
fn without_large_groups_all_pairs_make_the_first_fit() {
    let pairs = synthetic(40, 1.0, &motion(), 34);
    for groups in [vec![], groups(40, 2)] {
        let found = LocalToGlobal::for_voxel(0.05).estimate(&pairs, &groups).unwrap();
        assert_eq!((found.iterations, found.inliers.len()), (1, 40));
    }
}

#[test]
fn the_released_refinement_returns_its_last_fit() {
    // Right pairs, and as many heavy ones about as far off as the radius reaches, which the fits drift towards.
    let drift = RigidTransform::from_translation(nalgebra::Vector3::new(0.15, 0.0, 0.0)) * motion();
    let mut pairs = synthetic(30, 1.0, &motion(), 35);
    let heavy = |pair: &Correspondence| Correspondence { score: 100.0, ..*pair };
    pairs.extend(synthetic(12, 1.0, &drift, 36).iter().map(heavy));
    let between =
        RigidTransform::from_translation(nalgebra::Vector3::new(0.08, 0.0, 0.0)) * motion();
    pairs.extend(synthetic(6, 1.0, &between, 37));
    let [faithful, fixed] = [Mode::Faithful, Mode::Fixed].map(|mode| {
        let settings = LocalToGlobal { mode, ..LocalToGlobal::three_d_match() };
        settings.estimate(&pairs, &[(42..48).collect()]).unwrap()
    });
    assert!(fixed.inliers.len() > faithful.inliers.len(), "{fixed:?} {faithful:?}");
}

#[test]
fn unrelated_pairs_have_no_pose_in_any_group() {
    for (count, seeds) in [(100, 20), (1000, 10), (5000, 2)] {
        for seed in 0..seeds {
            let pairs = synthetic(count, 0.0, &motion(), 100 + seed);
            let found = LocalToGlobal::three_d_match().estimate(&pairs, &groups(count, 5));
            assert!(matches!(found, Err(Error::NoPose { .. })), "{count} {seed}: {found:?}");
        }
    }
}

#[test]
fn what_makes_no_sense_is_an_error() {
    let pairs = synthetic(10, 1.0, &motion(), 38);
    let settings = LocalToGlobal::kitti();
    let flat = LocalToGlobal { acceptance_radius: f64::NAN, ..settings.clone() };
    let small = LocalToGlobal { smallest_group: 2, ..settings.clone() };
    let same = vec![pairs[0]; 10];
    for (settings, pairs, groups, word) in [
        (&settings, &pairs[..2], vec![], "at least 3"),
        (&settings, &pairs[..], vec![vec![0, 1, 10]], "correspondence 10"),
        (&flat, &pairs[..], groups(10, 5), "acceptance radius"),
        (&small, &pairs[..], groups(10, 5), "groups of at least 3"),
        (&settings, &same[..], groups(10, 5), "none of 2 groups"),
    ] {
        let message = settings.estimate(pairs, &groups).unwrap_err().to_string();
        assert!(message.contains(word), "{message}");
    }
}
