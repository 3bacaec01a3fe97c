//! What every estimator owes: the right pose where there is one, none where there is none, and neither frames, order
//! nor threads show.

use nalgebra::{Point3, Rotation3, Vector3};
use rare::pose::{
    FastMac, Mac, Mode, PoseEstimate, PoseEstimator, Ransac, RansacScore, Sc2Pcr, Sc2PcrPlusPlus,
};
use rare::random::Random;
use rare::{Correspondence, Error, PointCloud, RigidTransform};

use crate::synthetic_pairs::{estimate, motion, synthetic};

/// All of them, for pairs that agree within 10 cm.
fn estimators() -> Vec<(&'static str, Box<dyn PoseEstimator>)> {
    let faithful = Sc2Pcr { mode: Mode::Faithful, ..Sc2Pcr::three_d_match() };
    let by_clouds = Ransac {
        score: RansacScore::CloudFitness,
        check_residuals: true,
        mode: Mode::Faithful,
        ..Ransac::three_d_match()
    };
    let plus_plus = Sc2PcrPlusPlus::three_d_match_fpfh();
    let faithful_plus_plus = Sc2PcrPlusPlus { sc2_pcr: faithful.clone(), ..plus_plus.clone() };
    vec![
        ("ransac", Box::new(Ransac::three_d_match())),
        ("ransac by clouds", Box::new(by_clouds)),
        ("sc2-pcr", Box::new(Sc2Pcr::three_d_match())),
        ("sc2-pcr as released", Box::new(faithful)),
        ("sc2-pcr++", Box::new(plus_plus)),
        ("sc2-pcr++ as released", Box::new(faithful_plus_plus)),
        ("mac", Box::new(Mac::three_d_match())),
        ("mac as released", Box::new(Mac { mode: Mode::Faithful, ..Mac::three_d_match() })),
        ("fast-mac", Box::new(FastMac { ratio: 0.9, ..FastMac::three_d_match() })),
    ]
}

/// Those that score a pose by the pairs. How much of one cloud the other covers depends on which of them is moved, and
/// its best pose is not one that the fits to the pairs settle at, so that it varies with the samples drawn.
fn scored_by_pairs() -> impl Iterator<Item = (&'static str, Box<dyn PoseEstimator>)> {
    estimators().into_iter().filter(|(name, _)| *name != "ransac by clouds")
}

fn try_estimate(
    estimator: &dyn PoseEstimator,
    pairs: &[Correspondence],
) -> Result<PoseEstimate, Error> {
    let cloud = |point: fn(&Correspondence) -> Point3<f64>| {
        PointCloud::new(pairs.iter().map(point).chain([Point3::origin()]).collect()).unwrap()
    };
    estimator.estimate(&cloud(|pair| pair.source), &cloud(|pair| pair.target), pairs)
}

fn random_motion(random: &mut Random) -> RigidTransform {
    let mut vector = |scale: f64| Vector3::from_fn(|_, _| scale * random.normal());
    RigidTransform::new(Rotation3::new(vector(1.5)), vector(5.0))
}

fn exact_pairs(count: usize, random: &mut Random, truth: &RigidTransform) -> Vec<Correspondence> {
    let pair = |_| {
        let source = Point3::from(Vector3::from_fn(|_, _| 3.0 * random.uniform()));
        Correspondence { source, target: truth.apply(&source), score: 1.0 }
    };
    (0..count).map(pair).collect()
}

/// Fifty right pairs among a thousand.
fn hard_pairs(seed: u64) -> Vec<Correspondence> {
    synthetic(1000, 0.05, &motion(), seed)
}

fn assert_close(name: &str, found: &RigidTransform, expected: &RigidTransform) {
    let error = found.error_to(expected);
    assert!(error.rotation_degrees < 0.1 && error.translation < 5e-3, "{name}: {error:?}");
}

#[test]
fn exact_motions_are_recovered_exactly() {
    let mut random = Random::new(21, 0);
    for count in [3, 4, 10, 50] {
        let truth = random_motion(&mut random);
        let pairs = exact_pairs(count, &mut random, &truth);
        for (name, estimator) in estimators() {
            let found = estimate(&*estimator, &pairs);
            let error = found.target_from_source.error_to(&truth);
            assert!(error.rotation_degrees < 1e-6 && error.translation < 1e-6, "{name} {error:?}");
            assert!(found.inliers.iter().copied().eq(0..count), "{name}");
        }
    }
}

#[test]
fn fifty_right_pairs_among_a_thousand_are_found() {
    for seed in 0..3 {
        let pairs = hard_pairs(seed);
        for (name, estimator) in scored_by_pairs() {
            let found = estimate(&*estimator, &pairs);
            let error = found.target_from_source.error_to(&motion());
            assert!(error.rotation_degrees < 0.5 && error.translation < 0.04, "{name} {error:?}");
            assert!((0..50).all(|i| found.inliers.contains(&i)), "{name}");
        }
    }
}

#[test]
fn a_common_motion_of_either_cloud_moves_the_pose_along() {
    let mut random = Random::new(22, 0);
    let (of_source, of_target) = (random_motion(&mut random), random_motion(&mut random));
    let pairs = hard_pairs(4);
    let moved: Vec<Correspondence> = (pairs.iter())
        .map(|pair| Correspondence {
            source: of_source.apply(&pair.source),
            target: of_target.apply(&pair.target),
            ..*pair
        })
        .collect();
    for (name, estimator) in estimators() {
        let found = estimate(&*estimator, &pairs);
        let expected = of_target * found.target_from_source * of_source.inverse();
        let of_moved = estimate(&*estimator, &moved);
        assert_close(name, &of_moved.target_from_source, &expected);
        assert_eq!(of_moved.inliers, found.inliers, "{name}");
    }
}

#[test]
fn swapping_the_clouds_inverts_the_pose() {
    let pairs = hard_pairs(5);
    let swapped: Vec<Correspondence> = (pairs.iter())
        .map(|pair| Correspondence { source: pair.target, target: pair.source, ..*pair })
        .collect();
    for (name, estimator) in scored_by_pairs() {
        let found = estimate(&*estimator, &pairs);
        let of_swapped = estimate(&*estimator, &swapped);
        assert_close(name, &of_swapped.target_from_source.inverse(), &found.target_from_source);
        assert_eq!(of_swapped.inliers, found.inliers, "{name}");
    }
}

#[test]
fn the_order_of_the_pairs_does_not_show() {
    let pairs = hard_pairs(6);
    let order = Random::new(23, 0).sample(pairs.len(), pairs.len());
    let shuffled: Vec<Correspondence> = order.iter().map(|&i| pairs[i]).collect();
    for (name, estimator) in scored_by_pairs() {
        let found = estimate(&*estimator, &pairs);
        let of_shuffled = estimate(&*estimator, &shuffled);
        assert_close(name, &of_shuffled.target_from_source, &found.target_from_source);
        let mut inliers: Vec<usize> = of_shuffled.inliers.iter().map(|&i| order[i]).collect();
        inliers.sort_unstable();
        assert_eq!(inliers, found.inliers, "{name}");
    }
}

#[test]
fn the_number_of_threads_does_not_show_anywhere() {
    let pairs = hard_pairs(7);
    for (name, estimator) in estimators() {
        let run = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| estimate(&*estimator, &pairs))
        };
        assert_eq!(run(1), run(3), "{name}");
    }
}

/// Random points in a box, or on its floor and walls.
fn unrelated(count: usize, flat: bool, seed: u64) -> Vec<Correspondence> {
    let mut random = Random::new(seed, 1);
    let mut point = || {
        let mut point = Vector3::new(4.0, 3.0, 2.5).map(|size| size * random.uniform());
        if flat {
            point[random.below(3)] = 0.0;
        }
        Point3::from(point)
    };
    (0..count).map(|_| Correspondence { source: point(), target: point(), score: 1.0 }).collect()
}

#[test]
fn unrelated_pairs_have_no_pose() {
    for (count, seeds) in [(3, 20), (10, 20), (100, 20), (1000, 5), (5000, 1)] {
        for seed in 0..seeds {
            for flat in [false, true] {
                let pairs = unrelated(count, flat, seed);
                for (name, estimator) in estimators() {
                    let found = try_estimate(&*estimator, &pairs);
                    let refused = matches!(found, Err(Error::NoPose { .. }));
                    assert!(refused, "{name}, {count} pairs, seed {seed}: {found:?}");
                }
            }
        }
    }
}

#[test]
fn repeated_pairs_are_no_evidence_and_do_no_harm() {
    let repeat = |pairs: Vec<Correspondence>| -> Vec<Correspondence> {
        pairs.iter().flat_map(|pair| [*pair; 4]).collect()
    };
    let (right, wrong) =
        (repeat(synthetic(100, 0.2, &motion(), 8)), repeat(unrelated(50, false, 8)));
    for (name, estimator) in estimators() {
        let error = estimate(&*estimator, &right).target_from_source.error_to(&motion());
        assert!(error.rotation_degrees < 1.0 && error.translation < 0.03, "{name} {error:?}");
        let found = try_estimate(&*estimator, &wrong);
        assert!(matches!(found, Err(Error::NoPose { .. })), "{name}: {found:?}");
    }
}

#[test]
fn too_little_to_go_by_is_no_pose() {
    let pairs = synthetic(10, 1.0, &motion(), 9);
    let identical = vec![pairs[0]; 100];
    let line: Vec<Correspondence> = (0..100)
        .map(|i| {
            let point = Point3::new(0.01 * f64::from(i), 0.0, 0.0);
            Correspondence { source: point, target: point, score: 1.0 }
        })
        .collect();
    for (name, estimator) in estimators() {
        for few in [&pairs[..0], &pairs[..1], &pairs[..2], &identical, &line] {
            let found = try_estimate(&*estimator, few);
            assert!(matches!(found, Err(Error::NoPose { .. })), "{name}: {found:?}");
        }
        let mut broken = pairs.clone();
        broken[3].source.y = f64::INFINITY;
        let cloud = PointCloud::new(vec![Point3::origin()]).unwrap();
        let found = estimator.estimate(&cloud, &cloud, &broken);
        assert!(matches!(found, Err(Error::InvalidInput(_))), "{name}: {found:?}");
    }
}
