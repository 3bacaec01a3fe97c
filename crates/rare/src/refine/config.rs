//! What can be set, with defaults.

use serde::{Deserialize, Serialize};

use crate::encode::Recorded;
use crate::reduce::DEFAULT_COMPONENTS;
use crate::scale::Profile;
use crate::viewpoints::CameraChoice;

/// Everything that [`crate::Refiner`] can be told. The default is the default preset.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RefinerConfig {
    /// Which fixed constants to use; `auto` derives them from the clouds.
    pub profile: Profile,
    /// Which virtual cameras to use; `auto` chooses by the kind of scene.
    pub camera: CameraChoice,
    /// Voxel size, metres, instead of the profile's; all other lengths follow it.
    pub voxel: Option<f64>,
    /// Seed of everything random (the choice of keypoints).
    pub seed: u64,
    /// What is done, beyond lengths.
    pub recipe: Recipe,
}

/// The switches between the paper's recipe and the default preset; each is one documented difference.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Recipe {
    /// Whether depths are taken in metres as the recipe has them, instead of in units that make a voxel 5 cm.
    pub metric: bool,
    /// How often the clouds are rendered, matched and aligned; the paper does it once.
    pub rounds: usize,
    /// Principal components kept per layer and view; `None` leaves the features as they are. The paper keeps 128.
    pub components: Option<usize>,
    /// Whether features are interpolated at the keypoints with aligned corners (the paper's source FreeReg) instead
    /// of being taken from the keypoint's own cell.
    pub aligned_corners: bool,
    /// Whether the sets of common points (fused features) are used beside those of either kind of feature alone.
    pub feature_transfer: bool,
    /// Whether the sets vote for the best of their transforms, instead of one weighted fit over all correspondences.
    pub inlier_aggregation: bool,
    /// Whether each set gives hypotheses by consensus (SC2-PCR) instead of one weighted fit over all its pairs.
    pub consensus: bool,
    /// Whether the initial transform competes with what is proposed, and the most believable one wins.
    pub verify: bool,
    /// Whether, unless the initial transform leads to something certain, transforms are sought by 3D features and around
    /// the initial one.
    pub search: bool,
    /// Whether the surfaces are aligned at the end, held by the matches of the depth maps; undone if it verifies worse.
    pub polish: bool,
    /// Times the weights are recomputed from the surviving inliers (`N_r` of section 3.3).
    pub reweighting_rounds: usize,
    /// Number of best correspondences in the last fit (`K` of section 3.3).
    pub top: usize,
    /// Most 3D keypoints used per cloud; `None`: 500, LiDAR 1000.
    pub keypoints: Option<usize>,
}

impl Default for RefinerConfig {
    fn default() -> RefinerConfig {
        RefinerConfig {
            profile: Profile::Auto,
            camera: CameraChoice::Auto,
            voxel: None,
            seed: 0,
            recipe: Recipe::default(),
        }
    }
}

impl Default for Recipe {
    fn default() -> Recipe {
        Recipe {
            metric: false,
            rounds: 2,
            components: None,
            aligned_corners: false,
            feature_transfer: true,
            inlier_aggregation: true,
            consensus: true,
            verify: true,
            search: true,
            polish: true,
            reweighting_rounds: 5,
            top: 250,
            keypoints: None,
        }
    }
}

impl Recipe {
    /// The paper's recipe unchanged.
    #[must_use]
    pub fn paper() -> Recipe {
        Recipe {
            metric: true,
            rounds: 1,
            components: Some(128),
            aligned_corners: true,
            feature_transfer: true,
            inlier_aggregation: true,
            consensus: false,
            verify: false,
            search: false,
            polish: false,
            reweighting_rounds: 5,
            top: 250,
            keypoints: None,
        }
    }

    /// The same recipe for features of a network with several layers, as FreeReg treats them: principal components of
    /// each layer, interpolation with aligned corners.
    #[must_use]
    pub fn for_network(self) -> Recipe {
        Recipe { components: Some(DEFAULT_COMPONENTS), aligned_corners: true, ..self }
    }

    /// The same recipe for recorded features: one round, because under another pose the views show other things, and
    /// the reduction and interpolation that were recorded with them.
    #[must_use]
    pub fn for_recorded(self, recorded: &Recorded) -> Recipe {
        let recipe = Recipe { rounds: 1, search: false, ..self };
        match recorded.recording() {
            Some(recording) => Recipe {
                components: recording.components,
                aligned_corners: recording.aligned_corners,
                ..recipe
            },
            None => recipe,
        }
    }
}
