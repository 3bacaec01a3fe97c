//! Pose estimators: correspondences in, a rigid transform with evidence out.

mod anchored_icp;
mod consensus;
mod consistency;
mod fast_mac;
mod icp;
mod icp_target;
mod local_to_global;
mod mac;
mod normal_equations;
mod partners;
mod pose_choice;
mod ransac;
mod rigid_fit;
mod robust_kernel;
mod sc2_pcr;
mod sc2_pcr_plus_plus;
mod seeds;
mod significance;
mod spectral;

pub(crate) use anchored_icp::RING_REACH;
pub use anchored_icp::{AnchoredIcp, AnchoredIcpResult};
pub use consensus::validate as validate_pairs;
pub use consistency::{CompatibilityGraph, Consistency};
pub use fast_mac::FastMac;
pub use icp::{Icp, IcpMethod, IcpResult, IcpStage, MultiScaleIcp, OpenDirection, Trim};
pub use icp_target::{IcpSource, IcpTarget};
pub use local_to_global::LocalToGlobal;
pub use mac::{FirstOrderScore, Mac};
pub use pose_choice::PoseChoice;
pub use ransac::{Ransac, RansacScore};
pub use rigid_fit::fit_weighted;
pub use robust_kernel::RobustKernel;
pub use sc2_pcr::{Sc2Pcr, Sc2PcrSeeds};
pub use sc2_pcr_plus_plus::{FeatureCandidates, Sc2PcrPlusPlus};
pub use seeds::spread_seeds;
pub use spectral::leading_eigenvector;

use serde::{Deserialize, Serialize};

use crate::data::{Correspondence, PointCloud, RigidTransform};
use crate::error::Result;

/// Whether the quirks of an estimator's released code are kept; the estimators list theirs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Mode {
    /// As released: to repeat published numbers.
    Faithful,
    /// As one would want it.
    #[default]
    Fixed,
}

/// Estimates the rigid transform between two clouds from correspondences of which many may be wrong.
pub trait PoseEstimator: Send + Sync {
    /// The transform that moves `source` onto `target`, in their local frames, from `pairs` of their points (metres).
    ///
    /// # Errors
    /// `InvalidInput` if a setting of the estimator makes no sense, `NoPose` if the pairs do not determine a pose or
    /// agree no better than random ones would.
    fn estimate(
        &self,
        source: &PointCloud,
        target: &PointCloud,
        pairs: &[Correspondence],
    ) -> Result<PoseEstimate>;
}

/// A pose and what speaks for it.
#[derive(Debug, Clone, PartialEq)]
pub struct PoseEstimate {
    /// Moves points of the source into the target's frame.
    pub target_from_source: RigidTransform,
    /// Indices (ascending) of the pairs that agree with the pose.
    pub inliers: Vec<usize>,
    /// The estimator's own measure of agreement, higher is better; comparable only within one estimator and one set.
    pub score: f64,
    /// The score of the best pose that differs from this one; `None` if there was no other. A small gap warns of an
    /// ambiguous scene.
    pub runner_up: Option<f64>,
    /// Hypotheses that were formed and scored.
    pub iterations: usize,
    /// Whether the work ended at a limit rather than at the estimator's own criterion.
    pub budget_exhausted: bool,
}
