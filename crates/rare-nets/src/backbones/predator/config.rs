//! What differs between the published models.

use rare::pose::Ransac;

use crate::backbones::hourglass::{DecoderSizes, EncoderSizes};
use crate::backbones::kpconv::PyramidConfig;

/// The settings of a model and of what is made of its features.
#[derive(Debug, Clone, PartialEq)]
pub struct PredatorConfig {
    /// What it was trained on, for messages.
    pub name: &'static str,
    /// Stages of points and the reach of the convolutions.
    pub pyramid: PyramidConfig,
    /// Channels of the first stage.
    pub width: usize,
    /// Channels of the coarse points between encoder and decoder.
    pub coarse_channels: usize,
    /// Heads of the attention.
    pub heads: usize,
    /// Neighbours of a coarse point in the graph; all others where there are fewer.
    pub neighbours: usize,
    /// Length of a feature.
    pub features: usize,
    /// What finds the pose.
    pub ransac: Ransac,
}

impl PredatorConfig {
    /// Rooms at 2.5 cm.
    #[must_use]
    pub fn three_d_match() -> PredatorConfig {
        PredatorConfig {
            name: "3DMatch",
            pyramid: PyramidConfig { voxel: 0.025, stages: 4, radius: 2.5, sigma: 2.0 },
            width: 128,
            coarse_channels: 256,
            heads: 4,
            neighbours: 10,
            features: 32,
            ransac: Ransac {
                inlier_threshold: 0.05,
                check_residuals: true,
                ..Ransac::three_d_match()
            },
        }
    }

    /// Streets at 30 cm.
    #[must_use]
    pub fn kitti() -> PredatorConfig {
        let rooms = PredatorConfig::three_d_match();
        PredatorConfig {
            name: "KITTI",
            pyramid: PyramidConfig { voxel: 0.3, stages: 4, radius: 4.25, sigma: 2.0 },
            width: 256,
            ransac: Ransac { inlier_threshold: 0.3, sample_size: 4, ..rooms.ransac },
            ..rooms
        }
    }

    pub(super) fn encoder(&self) -> EncoderSizes {
        EncoderSizes { width: self.width, stages: self.pyramid.stages, blocks: 2 }
    }

    /// The decoder takes and gives two scores beside the features.
    pub(super) fn decoder(&self) -> DecoderSizes {
        DecoderSizes {
            inputs: self.coarse_channels + 2,
            width: self.width,
            stages: self.pyramid.stages,
            outputs: self.features + 2,
        }
    }
}
