//! An initial transform out of nothing but the clouds, for those who bring none.

use serde::{Deserialize, Serialize};

use crate::data::RigidTransform;
use crate::error::Result;
use crate::pose::{FastMac, Mac, PoseEstimate, PoseEstimator, Ransac, Sc2Pcr, Sc2PcrPlusPlus};
use crate::refine::hypotheses::{Candidate, moved_onto_surface, rank};
use crate::refine::search::putative;
use crate::refine::working_pair::WorkingPair;
use crate::verify::Verifier;

/// Which estimator makes the initial transform.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum InitialMethod {
    /// SC2-PCR (second-order spatial compatibility): several hypotheses, the most believable one wins.
    #[default]
    Sc2Pcr,
    /// RANSAC with three-point samples.
    Ransac,
    /// SC2-PCR++: the poses of SC2-PCR, chosen among by features and space together.
    #[serde(rename = "sc2-pcr++")]
    Sc2PcrPlusPlus,
    /// MAC (maximal cliques): several hypotheses, the most believable one wins.
    Mac,
    /// MAC on a sample that keeps half of the matches.
    FastMac,
}

/// SC2-PCR's distinct hypotheses that are compared by their evidence.
const HYPOTHESES: usize = 10;

/// Matches fast point feature histograms and looks for the pose on which most matches agree; working frames.
pub(super) fn estimate(
    pair: &WorkingPair<'_>,
    method: InitialMethod,
    seed: u64,
    verifier: &Verifier<'_>,
) -> Result<RigidTransform> {
    let (source, target) = (pair.source.landmarks.features(), pair.target.landmarks.features());
    let voxel = pair.scale.voxel;
    let estimates = match method {
        InitialMethod::Sc2Pcr => {
            Sc2Pcr::for_voxel(voxel).hypotheses(&putative(pair)?, HYPOTHESES)?
        }
        InitialMethod::Mac => Mac::for_voxel(voxel).hypotheses(&putative(pair)?, HYPOTHESES)?,
        InitialMethod::FastMac => {
            let estimator = FastMac { seed, ..FastMac::for_voxel(voxel) };
            estimator.hypotheses(&putative(pair)?, HYPOTHESES)?
        }
        InitialMethod::Ransac => {
            let estimator = Ransac { seed, ..Ransac::for_voxel(voxel) };
            let pairs = putative(pair)?;
            vec![estimator.estimate(pair.source_cloud, pair.target_cloud, &pairs)?]
        }
        InitialMethod::Sc2PcrPlusPlus => {
            let estimator = Sc2PcrPlusPlus { seed, ..Sc2PcrPlusPlus::for_voxel(voxel) };
            let (pairs, candidates) = estimator.correspond(source, target)?;
            vec![estimator.estimate_with(&pairs, &candidates)?]
        }
    };
    Ok(most_believable(pair, &estimates, verifier))
}

/// The most believable pose after a rough alignment; estimators give at least one.
fn most_believable(
    pair: &WorkingPair<'_>,
    estimates: &[PoseEstimate],
    verifier: &Verifier<'_>,
) -> RigidTransform {
    let poses: Vec<RigidTransform> =
        estimates.iter().map(|estimate| estimate.target_from_source).collect();
    let Some((first, others)) = poses.split_first() else { return RigidTransform::identity() };
    if others.is_empty() {
        return *first;
    }
    let moved = moved_onto_surface(pair, &poses);
    let judged = poses.iter().chain(&moved).map(|pose| Candidate::judged(*pose, true, verifier));
    let ranked = rank(judged.collect(), pair.scale.voxel);
    ranked.first().map_or(*first, |best| best.target_from_source)
}
