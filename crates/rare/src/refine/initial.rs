//! An initial transform out of nothing but the clouds, for those who bring none.

use serde::{Deserialize, Serialize};

use crate::data::{Correspondence, PointFeatures, RigidTransform};
use crate::error::Result;
use crate::matching::{correspondences, nearest};
use crate::pose::{PoseEstimator, Ransac, Sc2Pcr};
use crate::random::Random;
use crate::refine::hypotheses::{Candidate, rank};
use crate::refine::working_pair::WorkingPair;
use crate::verify::Verifier;

/// Which estimator makes the initial transform.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum InitialMethod {
    /// SC2-PCR (second-order spatial compatibility): several hypotheses, the most depth-consistent one wins.
    #[default]
    Sc2Pcr,
    /// RANSAC with three-point samples.
    Ransac,
}

/// Voxel points that get a feature.
const KEYPOINTS: usize = 5000;
/// Matches in which consensus is sought.
const MATCHES: usize = 3000;
/// SC2-PCR's distinct hypotheses that are compared by depth consistency.
const HYPOTHESES: usize = 10;

/// Matches fast point feature histograms and looks for the pose on which most matches agree; working frames.
pub(super) fn estimate(
    pair: &WorkingPair<'_>,
    method: InitialMethod,
    seed: u64,
    verifier: &Verifier<'_>,
) -> Result<RigidTransform> {
    let source = pair.source.histograms(&pair.scale, KEYPOINTS, &mut Random::new(seed, 2))?;
    let target = pair.target.histograms(&pair.scale, KEYPOINTS, &mut Random::new(seed, 3))?;
    let pairs = putative(&source, &target)?;
    match method {
        InitialMethod::Ransac => {
            let estimator = Ransac { seed, ..Ransac::for_voxel(pair.scale.voxel) };
            Ok(estimator.estimate(pair.source_cloud, pair.target_cloud, &pairs)?.target_from_source)
        }
        InitialMethod::Sc2Pcr => {
            let estimates = Sc2Pcr::for_voxel(pair.scale.voxel).hypotheses(&pairs, HYPOTHESES)?;
            let poses: Vec<RigidTransform> =
                estimates.iter().map(|estimate| estimate.target_from_source).collect();
            let first = Candidate::judged(poses[0], verifier);
            Ok(rank(&poses[1..], &first, verifier)[0].target_from_source)
        }
    }
}

/// For every source keypoint its nearest target keypoint in feature space; the best-scored ones. Matches are not
/// required to be mutual: at low overlap that costs more right ones than it removes wrong ones.
fn putative(source: &PointFeatures, target: &PointFeatures) -> Result<Vec<Correspondence>> {
    let mut pairs = correspondences(source, target, &nearest(source, target, None)?, 1);
    pairs.sort_by(|a, b| b.score.total_cmp(&a.score));
    pairs.truncate(MATCHES);
    Ok(pairs)
}
