//! What is shown of a registration agrees with what the registration says.

use nalgebra::Vector3;
use rare::refine::{Illustration, IllustrationRequest};
use rare::verify::Visibility;
use rare::{PointCloud, Refiner, RigidTransform, Scan, SetName};

use super::{Pair, default, room};

/// The room under its start and under the truth.
fn illustrated(pair: &Pair, most_points: usize) -> Illustration {
    let request = IllustrationRequest {
        seen_from: pair.initial,
        poses: vec![pair.initial, pair.truth],
        most_points,
    };
    Refiner::new(default()).illustrate(&pair.source, &pair.target, &request).unwrap()
}

fn median(values: &[f32]) -> f32 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f32::total_cmp);
    sorted[sorted.len() / 2]
}

fn share(visibility: &[Visibility], of: Visibility) -> f64 {
    let count = |of| visibility.iter().filter(|&&seen| seen == of).count() as f64;
    count(of) / (visibility.len() as f64 - count(Visibility::Unseen)).max(1.0)
}

#[test]
fn the_truth_looks_better_than_the_start() {
    let shown = illustrated(room(), usize::MAX);
    for cloud in [&shown.source, &shown.reference] {
        let [before, after] = [&cloud.residuals[0], &cloud.residuals[1]];
        // Measured: 28 and 26 mm before, 8 mm after, of those that have a partner.
        let near = |residuals: &[f32]| -> Vec<f32> {
            residuals.iter().copied().filter(|&residual| residual < 0.2).collect()
        };
        assert!(median(&near(after)) < 0.6 * median(&near(before)));
        let [before, after] = [0, 1].map(|pose| share(&cloud.visibility[pose], Visibility::Agree));
        assert!(after > 0.75 && before < after - 0.2, "{before} {after}");
    }
}

#[test]
fn maps_features_and_matches_belong_together() {
    let shown = illustrated(room(), 100);
    assert_eq!(shown.views.len(), 2);
    // Metres, not working units: the depth camera sees its own scan as deep as it is.
    let deepest = |depths: &[f32]| depths.iter().copied().fold(0.0, f32::max);
    let points = room().target.cloud.points().iter();
    let depth = points.map(|point| point.z).fold(0.0, f64::max) as f32;
    let seen = deepest(shown.views[0].reference.sparse.depth());
    assert!((seen / depth - 1.0).abs() < 0.02, "{seen} {depth}");
    for view in &shown.views {
        for map in [&view.reference, &view.source] {
            let seen = |depth: &[f32]| depth.iter().filter(|&&depth| depth > 0.0).count();
            assert!(seen(map.dense.depth()) > seen(map.sparse.depth()));
            assert!(seen(map.sparse.depth()) > 1000);
            assert_eq!(map.features.channels(), 3);
        }
        assert_eq!(view.masks.len(), 2);
        let (width, height) = (view.source.dense.width(), view.source.dense.height());
        for found in &view.matches {
            for (u, v) in [found.source, found.reference] {
                assert!(u < width && v < height);
            }
        }
        // Under the truth many matches of the dense features are right.
        let dense = [SetName::DiffusionReference, SetName::DiffusionSource];
        let dense: Vec<_> = view.matches.iter().filter(|one| dense.contains(&one.set)).collect();
        let right = dense.iter().filter(|found| found.inlier).count();
        assert!(dense.len() > 100 && 2 * right > dense.len(), "{right} of {}", dense.len());
    }
}

#[test]
fn no_more_points_than_asked_for_and_those_of_the_cloud() {
    let pair = room();
    let shown = illustrated(pair, 500);
    for (cloud, scan) in [(&shown.source, &pair.source), (&shown.reference, &pair.target)] {
        assert!((250..=500).contains(&cloud.indices.len()), "{}", cloud.indices.len());
        assert!(cloud.indices.iter().all(|&index| index < scan.cloud.len()));
        assert!(cloud.residuals.iter().all(|of_pose| of_pose.len() == cloud.indices.len()));
        assert!(cloud.visibility.iter().all(|of_pose| of_pose.len() == cloud.indices.len()));
    }
}

#[test]
fn where_the_clouds_lie_and_the_number_of_threads_do_not_show() {
    let pair = room();
    let expected = illustrated(pair, 500);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    assert_eq!(pool.install(|| illustrated(pair, 500)), expected);
    // In the coordinates of a national grid.
    let far = Vector3::new(500_000.0, 5_400_000.0, 300.0);
    let moved = |scan: &Scan| -> Scan {
        let points = scan.cloud.world_points().into_iter().map(|point| point + far);
        PointCloud::new(points.collect()).unwrap().into()
    };
    let shift = RigidTransform::from_translation(far);
    let there = |pose: &RigidTransform| shift * *pose * shift.inverse();
    let elsewhere = Pair {
        source: moved(&pair.source),
        target: moved(&pair.target),
        truth: there(&pair.truth),
        initial: there(&pair.initial),
    };
    let found = illustrated(&elsewhere, 500);
    let difference = |pose: usize| {
        let [a, b] = [&found, &expected].map(|shown| median(&shown.source.residuals[pose]));
        (a - b).abs()
    };
    assert!(difference(0) < 1e-3 && difference(1) < 1e-3);
}
