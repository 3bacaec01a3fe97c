//! What differs between the published models.

use rare::pose::{Mode, Ransac};

use crate::checkpoint::Parameters;

/// The settings of a model and of what is made of its features.
#[derive(Debug, Clone, PartialEq)]
pub struct FcgfConfig {
    /// Edge of a voxel, metres. It is not in the weights: it must be that of the training.
    pub voxel: f64,
    /// Offsets along an edge of the first kernel, odd. [`FcgfConfig::fitted`] takes it from the weights.
    pub first_kernel: usize,
    /// Length of a feature. [`FcgfConfig::fitted`] takes it from the weights.
    pub features: usize,
    /// Whether features are divided by their norm.
    pub unit_features: bool,
    /// Which features belong together.
    pub matching: Matching,
    /// What finds the pose.
    pub ransac: Ransac,
}

/// Which keypoints are matched.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Matching {
    /// Each source keypoint with the nearest target feature.
    Nearest,
    /// Those that are each other's nearest.
    Mutual,
}

/// What the authors' scripts search at most.
const ITERATIONS: usize = 4_000_000;

impl FcgfConfig {
    /// Rooms at 2.5 cm, features of 32 numbers.
    #[must_use]
    pub fn three_d_match() -> FcgfConfig {
        let voxel = 0.025;
        FcgfConfig {
            voxel,
            first_kernel: 7,
            features: 32,
            unit_features: true,
            matching: Matching::Nearest,
            ransac: ransac(1.5 * voxel),
        }
    }

    /// Streets at 30 cm.
    #[must_use]
    pub fn kitti() -> FcgfConfig {
        let voxel = 0.3;
        FcgfConfig { voxel, first_kernel: 5, ransac: ransac(voxel), ..FcgfConfig::three_d_match() }
    }

    /// The published model that the weights are of: by the settings of their training, which the authors' files hold, or
    /// else by the size of the first kernel.
    #[must_use]
    pub fn of(parameters: &Parameters) -> FcgfConfig {
        let setting = |name: &str| parameters.metadata().get(name).map(String::as_str);
        let voxel = setting("config.voxel_size").and_then(|text| text.parse::<f64>().ok());
        let voxel = voxel.filter(|voxel| *voxel > 0.0 && voxel.is_finite());
        let is_outdoors = match voxel {
            Some(voxel) => voxel > 0.1,
            None => {
                parameters.shape("conv1.kernel").is_some_and(|shape| shape.first() == Some(&125))
            }
        };
        let config = if is_outdoors { FcgfConfig::kitti() } else { FcgfConfig::three_d_match() };
        let unit_features = match setting("config.normalize_feature") {
            Some("false") => false,
            Some("true") => true,
            _ => config.unit_features,
        };
        let voxel = voxel.unwrap_or(config.voxel);
        let threshold = config.ransac.inlier_threshold * voxel / config.voxel;
        FcgfConfig { voxel, unit_features, ransac: ransac(threshold), ..config }.fitted(parameters)
    }

    /// With the size of the first kernel and the length of features that the weights have; unchanged where they have no
    /// such tensors.
    #[must_use]
    pub fn fitted(mut self, parameters: &Parameters) -> FcgfConfig {
        if let Some([offsets, ..]) = parameters.shape("conv1.kernel") {
            let fits = |side: &usize| side.checked_pow(3).is_some_and(|cube| cube <= *offsets);
            let side = (1..=*offsets).take_while(fits).last();
            // A kernel without a middle is none that the network knows: the layout will say so.
            self.first_kernel = side.filter(|side| side % 2 == 1).unwrap_or(self.first_kernel);
        }
        if let Some([.., features]) = parameters.shape("final.kernel") {
            self.features = *features;
        }
        self
    }
}

/// Four points, edges that agree to a tenth, residuals within `threshold` metres.
fn ransac(threshold: f64) -> Ransac {
    Ransac {
        inlier_threshold: threshold,
        sample_size: 4,
        max_iterations: ITERATIONS,
        edge_ratio: 0.9,
        check_residuals: true,
        mode: Mode::Fixed,
        ..Ransac::three_d_match()
    }
}
