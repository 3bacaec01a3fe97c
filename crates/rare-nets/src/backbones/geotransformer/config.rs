//! The sizes of the network.

use rare::pose::{LocalToGlobal, Mode};

use crate::backbones::kpconv::PyramidConfig;

/// The sizes and settings of a `GeoTransformer`; lengths in metres.
#[derive(Debug, Clone, PartialEq)]
pub struct GeoTransformerConfig {
    /// What it was trained on, for messages.
    pub name: &'static str,
    /// The stages of the clouds.
    pub pyramid: PyramidConfig,
    /// Groups of the group normalisations.
    pub groups: usize,
    /// Channels of the first layer; stage `l` has `2^(l + 1)` times as many.
    pub width: usize,
    /// Channels of the features of points.
    pub features: usize,
    /// Points of a patch at most.
    pub patch_points: usize,
    /// The transformer of the superpoints.
    pub transformer: TransformerConfig,
    /// Pairs of superpoints that are matched point by point.
    pub superpoint_matches: usize,
    /// Iterations of the optimal transport.
    pub sinkhorn_iterations: usize,
    /// The matching of points and the pose.
    pub fine: FineMatchingConfig,
}

/// The transformer of the superpoints.
#[derive(Debug, Clone, PartialEq)]
pub struct TransformerConfig {
    /// Channels inside.
    pub hidden: usize,
    /// Channels of what it gives.
    pub output: usize,
    /// Attention heads.
    pub heads: usize,
    /// Pairs of a layer of self-attention and one of cross-attention.
    pub blocks: usize,
    /// The distance that counts as one in the embedding, metres.
    pub sigma_distance: f64,
    /// The angle that counts as one, degrees.
    pub sigma_angle: f64,
    /// Neighbours of a superpoint to which angles are measured.
    pub angle_neighbours: usize,
}

/// The matching of points and the pose.
#[derive(Debug, Clone, PartialEq)]
pub struct FineMatchingConfig {
    /// A match is among so many best of both of its points.
    pub best: usize,
    /// A match has a higher score.
    pub confidence: f32,
    /// A correspondence agrees with a pose if its residual is smaller, metres.
    pub acceptance_radius: f64,
    /// Matches of a pair of patches that propose a pose, at least.
    pub smallest_group: usize,
    /// Fits after the election of a pose.
    pub refinement_steps: usize,
}

impl GeoTransformerConfig {
    /// The released network for rooms.
    #[must_use]
    pub fn three_d_match() -> GeoTransformerConfig {
        GeoTransformerConfig {
            name: "3DMatch",
            pyramid: PyramidConfig { voxel: 0.025, stages: 4, radius: 2.5, sigma: 2.0 },
            groups: 32,
            width: 64,
            features: 256,
            patch_points: 64,
            transformer: TransformerConfig {
                hidden: 256,
                output: 256,
                heads: 4,
                blocks: 3,
                sigma_distance: 0.2,
                sigma_angle: 15.0,
                angle_neighbours: 3,
            },
            superpoint_matches: 256,
            sinkhorn_iterations: 100,
            fine: FineMatchingConfig {
                best: 3,
                confidence: 0.05,
                acceptance_radius: 0.1,
                smallest_group: 3,
                refinement_steps: 5,
            },
        }
    }

    /// The released network for streets.
    #[must_use]
    pub fn kitti() -> GeoTransformerConfig {
        let rooms = GeoTransformerConfig::three_d_match();
        GeoTransformerConfig {
            name: "KITTI",
            pyramid: PyramidConfig { voxel: 0.3, stages: 5, radius: 4.25, sigma: 2.0 },
            patch_points: 128,
            transformer: TransformerConfig {
                hidden: 128,
                sigma_distance: 4.8,
                ..rooms.transformer
            },
            fine: FineMatchingConfig { best: 2, acceptance_radius: 0.6, ..rooms.fine },
            ..rooms
        }
    }

    /// Channels of a stage, the finest being 0.
    pub(super) fn channels(&self, stage: usize) -> usize {
        self.width << (stage + 1)
    }
}

impl FineMatchingConfig {
    /// How the pose is found from matches: each pair of patches proposes one, all matches vote (Qin et al., CVPR 2022,
    /// section 3.4).
    #[must_use]
    pub fn local_to_global(&self) -> LocalToGlobal {
        LocalToGlobal {
            acceptance_radius: self.acceptance_radius,
            refinement_steps: self.refinement_steps,
            smallest_group: self.smallest_group,
            mode: Mode::Faithful,
        }
    }
}
