//! RANSAC on synthetic correspondences.

use rare::pose::{Mode, PoseEstimator, Ransac, RansacScore};
use rare::{Correspondence, PointCloud, RigidTransform};

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

#[test]
fn clouds_decide_where_that_is_asked_for() {
    // More pairs follow a wrong motion, but the clouds are those of the right one.
    let wrong = RigidTransform::from_translation(nalgebra::Vector3::new(0.0, 1.0, 0.0)) * motion();
    let mut pairs = synthetic(60, 1.0, &wrong, 3);
    pairs.extend(synthetic(50, 1.0, &motion(), 4));
    let source: Vec<_> = synthetic(400, 1.0, &motion(), 5).iter().map(|pair| pair.source).collect();
    let target = PointCloud::new(motion().apply_all(&source)).unwrap();
    let source = PointCloud::new(source).unwrap();
    for (score, truth) in
        [(RansacScore::Correspondences, wrong), (RansacScore::CloudFitness, motion())]
    {
        for mode in [Mode::Faithful, Mode::Fixed] {
            let settings = Ransac { score, mode, ..Ransac::three_d_match() };
            let found = settings.estimate(&source, &target, &pairs).unwrap();
            let error = found.target_from_source.error_to(&truth);
            assert!(error.translation < 0.02, "{score:?} {mode:?} {error:?}");
            let expected = if score == RansacScore::CloudFitness { 400.0 } else { 60.0 };
            assert_eq!(found.score.floor(), expected);
        }
    }
}

#[test]
fn a_sample_whose_own_residuals_are_too_large_is_dropped() {
    // Edges agree within a tenth, but not to a centimetre.
    let stretched: Vec<_> = (synthetic(30, 1.0, &RigidTransform::identity(), 6).iter())
        .map(|pair| Correspondence { target: pair.target * 1.08, ..*pair })
        .collect();
    let cloud = PointCloud::new(stretched.iter().map(|pair| pair.source).collect()).unwrap();
    let settings = Ransac { inlier_threshold: 0.02, ..Ransac::three_d_match() };
    let message = |check_residuals| {
        let settings = Ransac { check_residuals, max_iterations: 1000, ..settings.clone() };
        settings.estimate(&cloud, &cloud, &stretched).unwrap_err().to_string()
    };
    assert!(message(true).contains("none of 1000 samples"), "{}", message(true));
    assert!(message(false).contains("random ones"), "{}", message(false));
}

#[test]
fn faithful_samples_repeat_correspondences() {
    // Of three pairs, two ninths of all samples with replacement have three different ones.
    let pairs = synthetic(3, 1.0, &motion(), 7);
    let run = |mode| {
        let settings =
            Ransac { mode, max_iterations: 1, sample_size: 3, ..Ransac::three_d_match() };
        (0..30)
            .map(|seed| Ransac { seed, ..settings.clone() })
            .filter(|settings| {
                let cloud = PointCloud::new(vec![pairs[0].source]).unwrap();
                let found = settings.estimate(&cloud, &cloud, &pairs);
                found.is_err_and(|error| error.to_string().contains("none of 1 samples"))
            })
            .count()
    };
    assert_eq!(run(Mode::Fixed), 0);
    assert!((15..30).contains(&run(Mode::Faithful)));
}
