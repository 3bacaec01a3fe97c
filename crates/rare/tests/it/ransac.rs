//! RANSAC on synthetic correspondences.

use rare::pose::{PoseEstimator, Ransac};
use rare::{Correspondence, PointCloud};

use crate::synthetic_pairs::{estimate, motion, synthetic};

#[test]
fn outliers_are_survived() {
    for (count, share) in [(1000, 0.2), (1000, 0.1), (200, 0.2), (12, 0.7)] {
        let pairs = synthetic(count, share, &motion(), 3);
        let result = estimate(&Ransac::three_d_match(), &pairs);
        let error = result.target_from_source.error_to(&motion());
        assert!(error.rotation_degrees < 1.0 && error.translation < 0.03, "{count} {error:?}");
        let true_inliers = (share * count as f64) as usize;
        assert!((0..true_inliers).all(|i| result.inliers.contains(&i)));
        assert!(result.runner_up.is_none_or(|other| other < result.score));
        assert!(!result.budget_exhausted && result.iterations < 50_000);
    }
}

#[test]
fn the_budget_is_kept_and_reported() {
    let pairs = synthetic(500, 0.3, &motion(), 3);
    let settings = Ransac { max_iterations: 1500, confidence: 1.0, ..Ransac::three_d_match() };
    let result = estimate(&settings, &pairs);
    assert!(result.budget_exhausted);
    assert_eq!(result.iterations, 1500);
}

#[test]
fn neither_threads_nor_runs_show_but_the_seed_does() {
    let run = |threads, seed, pairs: &[_]| {
        let settings = Ransac { seed, polish_rounds: 0, ..Ransac::for_voxel(0.05) };
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| estimate(&settings, pairs))
    };
    // The stopping rule looks at different times for each share.
    for share in [0.06, 0.08, 0.1, 0.12, 0.15, 0.2] {
        let pairs = synthetic(500, share, &motion(), 8);
        assert_eq!(run(1, 0, &pairs), run(2, 0, &pairs));
        assert_ne!(run(1, 0, &pairs).target_from_source, run(1, 1, &pairs).target_from_source);
    }
}

#[test]
fn what_makes_no_sense_is_an_error() {
    let cloud = PointCloud::new(vec![nalgebra::Point3::origin()]).unwrap();
    let pairs = synthetic(10, 1.0, &motion(), 1);
    let same = vec![Correspondence { score: 1.0, ..pairs[0] }; 10];
    let settings = Ransac::three_d_match();
    let small = Ransac { sample_size: 2, ..settings.clone() };
    let large = Ransac { sample_size: 11, ..settings.clone() };
    for (settings, pairs, word) in [
        (&settings, &pairs[..2], "at least 3"),
        (&settings, &same, "none of 50000"),
        (&small, &pairs, "samples of at least 3"),
        (&large, &pairs, "needs 11"),
    ] {
        let message = settings.estimate(&cloud, &cloud, pairs).unwrap_err().to_string();
        assert!(message.contains(word), "{message}");
    }
}
