//! The pose of networks that have none of their own: random samples of their correspondences.

use rare::matching::{self, Match};
use rare::nalgebra::Point3;
use rare::pose::{PoseEstimator, Ransac};
use rare::{Correspondence, PointCloud, PointFeatures, Result, RigidTransform};

use super::Selection;

/// The matched keypoints, the highest score first. A pair's score is what `score` makes of its match.
pub(super) fn correspondences(
    source: &PointFeatures,
    target: &PointFeatures,
    matches: &[Match],
    score: impl Fn(&Match) -> f64,
) -> Vec<Correspondence> {
    let mut pairs = matching::correspondences(source, target, matches, 1);
    pairs.iter_mut().zip(matches).for_each(|(pair, found)| pair.score = score(found));
    pairs.sort_by(|a, b| b.score.total_cmp(&a.score));
    pairs
}

/// The pose on which most correspondences agree, in the frames of the clouds, with the seed of the selection.
///
/// # Errors
/// `NoPose` if they do not determine one.
pub(super) fn pose(
    ransac: &Ransac,
    clouds: [&[Point3<f64>]; 2],
    pairs: &[Correspondence],
    selection: &Selection,
) -> Result<RigidTransform> {
    let ransac = Ransac { seed: selection.seed, ..ransac.clone() };
    let [source, target] = clouds.map(|points| PointCloud::new(points.to_vec()));
    Ok(ransac.estimate(&source?, &target?, pairs)?.target_from_source)
}

/// The selection for the target: the same, with another seed, so that two equal clouds do not get the same keypoints.
pub(super) fn for_target(selection: &Selection) -> Selection {
    Selection { seed: selection.seed.wrapping_add(1), ..*selection }
}
