//! What differs between the published models.

use rare::pose::Ransac;

use crate::backbones::hourglass::{DecoderSizes, EncoderSizes};
use crate::backbones::kpconv::PyramidConfig;

/// The settings of a model and of what is made of its features.
#[derive(Debug, Clone, PartialEq)]
pub struct CoFiNetConfig {
    /// What it was trained on, for messages.
    pub name: &'static str,
    /// Stages of points and the reach of the convolutions.
    pub pyramid: PyramidConfig,
    /// Channels of the first stage.
    pub width: usize,
    /// Channels of the attention between coarse points.
    pub coarse_channels: usize,
    /// Length of the feature of a fine point.
    pub features: usize,
    /// Heads of the attentions.
    pub heads: usize,
    /// Iterations of both Sinkhorn normalisations.
    pub iterations: usize,
    /// Coarse pairs count if their confidence is above this,
    pub first_threshold: f64,
    /// which is lowered by this much
    pub threshold_step: f64,
    /// until there are so many.
    pub fewest_pairs: usize,
    /// No more coarse pairs than this, those of the highest confidence. The published code has no bound: weights that
    /// were trained for such clouds give some hundreds.
    pub most_pairs: usize,
    /// Fine points around a coarse one, at most.
    pub patch: usize,
    /// What finds the pose.
    pub ransac: Ransac,
}

impl CoFiNetConfig {
    /// Rooms at 2.5 cm.
    #[must_use]
    pub fn three_d_match() -> CoFiNetConfig {
        CoFiNetConfig {
            name: "3DMatch",
            pyramid: PyramidConfig { voxel: 0.025, stages: 4, radius: 2.5, sigma: 2.0 },
            width: 128,
            coarse_channels: 256,
            features: 32,
            heads: 4,
            iterations: 100,
            first_threshold: 0.2,
            threshold_step: 0.001,
            fewest_pairs: 200,
            most_pairs: 4000,
            patch: 64,
            ransac: Ransac {
                inlier_threshold: 0.05,
                check_residuals: true,
                ..Ransac::three_d_match()
            },
        }
    }

    /// Streets at 30 cm.
    #[must_use]
    pub fn kitti() -> CoFiNetConfig {
        let rooms = CoFiNetConfig::three_d_match();
        CoFiNetConfig {
            name: "KITTI",
            pyramid: PyramidConfig { voxel: 0.3, stages: 4, radius: 4.25, sigma: 2.0 },
            threshold_step: 0.01,
            patch: 32,
            ransac: Ransac { inlier_threshold: 0.3, sample_size: 4, ..rooms.ransac },
            ..rooms
        }
    }

    pub(super) fn encoder(&self) -> EncoderSizes {
        EncoderSizes { width: self.width, stages: self.pyramid.stages, blocks: 1 }
    }

    pub(super) fn decoder(&self) -> DecoderSizes {
        DecoderSizes {
            inputs: self.coarse_channels,
            width: self.width,
            stages: self.pyramid.stages,
            outputs: self.features,
        }
    }
}
