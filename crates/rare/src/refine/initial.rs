//! An initial transform out of nothing but the clouds, for those who bring none.

use serde::{Deserialize, Serialize};

use crate::data::{Correspondence, PointFeatures, RigidTransform};
use crate::error::Result;
use crate::matching::{correspondences, nearest};
use crate::pose::{FastMac, Mac, PoseEstimate, PoseEstimator, Ransac, Sc2Pcr, Sc2PcrPlusPlus};
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
    /// SC2-PCR++: the poses of SC2-PCR, chosen among by features and space together.
    #[serde(rename = "sc2-pcr++")]
    Sc2PcrPlusPlus,
    /// MAC (maximal cliques): several hypotheses, the most depth-consistent one wins.
    Mac,
    /// MAC on a sample that keeps half of the matches.
    FastMac,
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
    let [source, target] = histograms(pair, seed)?;
    let voxel = pair.scale.voxel;
    let estimates = match method {
        InitialMethod::Sc2Pcr => {
            Sc2Pcr::for_voxel(voxel).hypotheses(&putative(&source, &target)?, HYPOTHESES)?
        }
        InitialMethod::Mac => {
            Mac::for_voxel(voxel).hypotheses(&putative(&source, &target)?, HYPOTHESES)?
        }
        InitialMethod::FastMac => {
            let estimator = FastMac { seed, ..FastMac::for_voxel(voxel) };
            estimator.hypotheses(&putative(&source, &target)?, HYPOTHESES)?
        }
        InitialMethod::Ransac => {
            let estimator = Ransac { seed, ..Ransac::for_voxel(voxel) };
            let pairs = putative(&source, &target)?;
            vec![estimator.estimate(pair.source_cloud, pair.target_cloud, &pairs)?]
        }
        InitialMethod::Sc2PcrPlusPlus => {
            let estimator = Sc2PcrPlusPlus { seed, ..Sc2PcrPlusPlus::for_voxel(voxel) };
            let (pairs, candidates) = estimator.correspond(&source, &target)?;
            vec![estimator.estimate_with(&pairs, &candidates)?]
        }
    };
    Ok(most_consistent(&estimates, verifier, voxel))
}

/// The pose that depth consistency prefers; estimators give at least one.
fn most_consistent(
    estimates: &[PoseEstimate],
    verifier: &Verifier<'_>,
    voxel: f64,
) -> RigidTransform {
    let poses: Vec<RigidTransform> =
        estimates.iter().map(|estimate| estimate.target_from_source).collect();
    let Some((first, others)) = poses.split_first() else { return RigidTransform::identity() };
    if others.is_empty() {
        return *first;
    }
    let ranked = rank(others, &Candidate::judged(*first, verifier), verifier, voxel);
    ranked.first().map_or(*first, |best| best.target_from_source)
}

/// The matches that the estimators get, working frames.
pub(super) fn matches(pair: &WorkingPair<'_>, seed: u64) -> Result<Vec<Correspondence>> {
    let [source, target] = histograms(pair, seed)?;
    putative(&source, &target)
}

fn histograms(pair: &WorkingPair<'_>, seed: u64) -> Result<[PointFeatures; 2]> {
    let source = pair.source.histograms(&pair.scale, KEYPOINTS, &mut Random::new(seed, 2))?;
    let target = pair.target.histograms(&pair.scale, KEYPOINTS, &mut Random::new(seed, 3))?;
    Ok([source, target])
}

/// For every source keypoint its nearest target keypoint in feature space; the best-scored ones. Matches are not
/// required to be mutual: at low overlap that costs more right ones than it removes wrong ones.
fn putative(source: &PointFeatures, target: &PointFeatures) -> Result<Vec<Correspondence>> {
    let mut pairs = correspondences(source, target, &nearest(source, target, None)?, 1);
    pairs.sort_by(|a, b| b.score.total_cmp(&a.score));
    pairs.truncate(MATCHES);
    Ok(pairs)
}
