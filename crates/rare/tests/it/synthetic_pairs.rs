//! Correspondences with a known motion and a known share of outliers.

use nalgebra::{Point3, Rotation3, Vector3};
use rare::pose::{PoseEstimate, PoseEstimator};
use rare::random::Random;
use rare::{Correspondence, PointCloud, RigidTransform};

/// `count` pairs of which `share` follow `truth` up to 1 cm of noise; the rest joins random points.
pub(crate) fn synthetic(
    count: usize,
    share: f64,
    truth: &RigidTransform,
    seed: u64,
) -> Vec<Correspondence> {
    let mut random = Random::new(seed, 0);
    let mut pair = |i: usize| {
        let mut somewhere =
            || Point3::new(4.0 * random.uniform(), 3.0 * random.uniform(), 2.5 * random.uniform());
        let (source, elsewhere) = (somewhere(), somewhere());
        let noise = Vector3::new(random.normal(), random.normal(), random.normal()) * 0.01;
        let is_inlier = (i as f64) < share * count as f64;
        let target = truth.apply(if is_inlier { &source } else { &elsewhere }) + noise;
        Correspondence { source, target, score: 1.0 }
    };
    (0..count).map(&mut pair).collect()
}

pub(crate) fn motion() -> RigidTransform {
    RigidTransform::new(Rotation3::new(Vector3::new(1.5, -0.7, 0.4)), Vector3::new(3.0, -2.0, 1.0))
}

/// The estimate from clouds of the pairs' own points.
pub(crate) fn estimate(estimator: &dyn PoseEstimator, pairs: &[Correspondence]) -> PoseEstimate {
    let source = PointCloud::new(pairs.iter().map(|pair| pair.source).collect()).unwrap();
    let target = PointCloud::new(pairs.iter().map(|pair| pair.target).collect()).unwrap();
    estimator.estimate(&source, &target, pairs).unwrap()
}
