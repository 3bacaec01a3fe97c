//! Estimators by name, on correspondences that came from elsewhere.

use std::sync::Arc;

use rare::pose::{FastMac, Mac, PoseEstimator, Ransac, Sc2Pcr, Sc2PcrPlusPlus};
use rare::scale::Scale;
use rare::{Correspondence, Error, InitialMethod, RefinerConfig, Result, RigidTransform, Scan};

use rare_nets::backbones::Description;

use crate::backbone::filtered;

/// An estimator of the paper's tables.
#[derive(Clone)]
pub(crate) enum Estimator {
    /// With so many samples.
    Ransac(usize),
    Sc2Pcr,
    Sc2PcrPlusPlus,
    Mac,
    FastMac,
    /// A network that tells right correspondences from wrong ones.
    Filter(Arc<dyn PoseEstimator>),
}

impl From<InitialMethod> for Estimator {
    fn from(method: InitialMethod) -> Estimator {
        match method {
            InitialMethod::Ransac => Estimator::Ransac(Ransac::three_d_match().max_iterations),
            InitialMethod::Sc2Pcr => Estimator::Sc2Pcr,
            InitialMethod::Sc2PcrPlusPlus => Estimator::Sc2PcrPlusPlus,
            InitialMethod::Mac => Estimator::Mac,
            InitialMethod::FastMac => Estimator::FastMac,
        }
    }
}

impl Estimator {
    /// Applies it to what a network said of two clouds.
    ///
    /// # Errors
    /// What the estimator has.
    pub(crate) fn on_description(
        &self,
        description: &Description,
        source: &Scan,
        reference: &Scan,
        config: &RefinerConfig,
    ) -> Result<RigidTransform> {
        let Estimator::Sc2PcrPlusPlus = self else {
            return self.on_pairs(&description.correspondences, source, reference, config);
        };
        let voxel =
            Scale::new(config.profile, config.voxel, &source.cloud, &reference.cloud)?.voxel;
        let estimator = Sc2PcrPlusPlus { seed: config.seed, ..Sc2PcrPlusPlus::for_voxel(voxel) };
        let [source, target] = [&description.source, &description.target]
            .map(|keypoints| keypoints.features.normalised());
        let (pairs, candidates) = estimator.correspond(&source, &target)?;
        Ok(estimator.estimate_with(&pairs, &candidates)?.target_from_source)
    }

    /// Applies it to given correspondences, with the presets that fit the size of the clouds.
    ///
    /// # Errors
    /// What the estimator has.
    pub(crate) fn on_pairs(
        &self,
        pairs: &[Correspondence],
        source: &Scan,
        reference: &Scan,
        config: &RefinerConfig,
    ) -> Result<RigidTransform> {
        let (source, reference) = (&source.cloud, &reference.cloud);
        let voxel = Scale::new(config.profile, config.voxel, source, reference)?.voxel;
        let estimate = |estimator: &dyn PoseEstimator| {
            Ok(estimator.estimate(source, reference, pairs)?.target_from_source)
        };
        match self {
            Estimator::Ransac(max_iterations) => estimate(&Ransac {
                max_iterations: *max_iterations,
                seed: config.seed,
                ..Ransac::for_voxel(voxel)
            }),
            Estimator::Sc2Pcr => estimate(&Sc2Pcr::for_voxel(voxel)),
            Estimator::Mac => estimate(&Mac::for_voxel(voxel)),
            Estimator::FastMac => {
                estimate(&FastMac { seed: config.seed, ..FastMac::for_voxel(voxel) })
            }
            Estimator::Filter(filter) => filtered(&**filter, source, reference, pairs),
            Estimator::Sc2PcrPlusPlus => Err(Error::Unsupported(
                "sc2-pcr++ needs the descriptors of all keypoints, which came not with the start"
                    .to_owned(),
            )),
        }
    }
}
