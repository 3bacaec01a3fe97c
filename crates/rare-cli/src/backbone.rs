//! The networks on points of a run: `--backbone` and the learned methods of `--init-method`, opened before the clouds are
//! read.

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context, Result};
use rare::pose::PoseEstimator;
use rare::{PointCloud, Scan};
use rare_nets::backbones::kpconv::NeighbourLimits;
use rare_nets::backbones::{Backbone, Description, Request, Selection};
use rare_nets::cache::WeightsIdentity;
use rare_nets::networks::{self, Network, TrainedOn};
use serde::Serialize;

use crate::given_weights::GivenWeights;
use crate::memory;
use crate::options::{self, InitMethod, Settings};
use crate::progress::Progress;

/// The paper's numbers of keypoints (section 4.1).
const KEYPOINTS_IN_ROOMS: usize = 500;
const KEYPOINTS_IN_STREETS: usize = 1000;

/// The networks on points of a run.
pub(crate) struct OpenNetworks {
    pub(crate) backbone: Option<OpenBackbone>,
    pub(crate) filter: Option<Box<dyn PoseEstimator>>,
}

/// A network that describes clouds, with its weights.
pub(crate) struct OpenBackbone {
    backbone: Backbone,
    selection: Selection,
    neighbour_limits: Option<Vec<usize>>,
    record: BackboneRecord,
}

/// What the record says of it.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct BackboneRecord {
    network: Network,
    trained_on: TrainedOn,
    weights: PathBuf,
    /// SHA-256 of the name, length and samples of the weight file.
    weights_fingerprint: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    neighbor_limits: Option<Vec<usize>>,
    selection: Selection,
}

/// What a network said of a pair.
pub(crate) struct Described {
    pub(crate) description: Description,
    pub(crate) seconds: f64,
    pub(crate) record: BackboneRecord,
}

impl OpenNetworks {
    /// Opens what the settings ask for, to describe clouds and to estimate an initial transform.
    ///
    /// # Errors
    /// If weights are missing, of another network, damaged, or of no use.
    pub(crate) fn of(settings: &Settings, weights: &GivenWeights) -> Result<OpenNetworks> {
        let describing = OpenNetworks::describing(settings, weights)?;
        let open_filter = |network: Network| {
            let option = format!("--init-method {}", network.name());
            open_filter(weights.of(network, &option)?, network, settings)
        };
        Ok(OpenNetworks { filter: filter(settings).map(open_filter).transpose()?, ..describing })
    }

    /// Opens what the settings ask for where the initial transform is known. Weights of its estimator are no mistake: one
    /// configuration file serves all commands.
    ///
    /// # Errors
    /// Those of [`OpenNetworks::of`].
    pub(crate) fn describing(settings: &Settings, weights: &GivenWeights) -> Result<OpenNetworks> {
        let backbone = settings.backbone.as_ref();
        let networks = backbone.map(|backbone| backbone.network).into_iter();
        let used: Vec<Network> = networks.chain(filter(settings)).collect();
        weights.check_use(settings, &used)?;
        let open = |backbone: &options::Backbone| {
            let option = format!("--backbone {}", backbone.network.name());
            let file = weights.of(backbone.network, &option)?;
            OpenBackbone::open(file, backbone, settings)
        };
        Ok(OpenNetworks { backbone: backbone.map(open).transpose()?, filter: None })
    }

    /// Describes both clouds, if a network is to do that, and gives both scans the features.
    ///
    /// # Errors
    /// Those of [`OpenBackbone::describe`].
    pub(crate) fn describe(
        &self,
        source: &mut Scan,
        reference: &mut Scan,
        progress: &Progress,
    ) -> rare::Result<Option<Described>> {
        let Some(backbone) = &self.backbone else { return Ok(None) };
        progress.step("describe");
        backbone.describe(source, reference).map(Some)
    }
}

/// The network of a learned `--init-method`.
fn filter(settings: &Settings) -> Option<Network> {
    match settings.init_method {
        Some(InitMethod::Filter(filter)) => Some(filter.network()),
        Some(InitMethod::Builtin(_)) | None => None,
    }
}

/// Opens a network that tells right correspondences from wrong ones.
pub(crate) fn open_filter(
    file: &Path,
    network: Network,
    settings: &Settings,
) -> Result<Box<dyn PoseEstimator>> {
    let parameters = networks::open(file)?;
    let noise = settings.vbreg_noise.then_some(settings.refiner.seed);
    networks::open_filter(network, &parameters, noise).context("--weights")
}

impl OpenBackbone {
    /// Opens a network with the weights in `file`.
    ///
    /// # Errors
    /// If they are of another network, or damaged.
    pub(crate) fn open(
        file: &Path,
        wanted: &options::Backbone,
        settings: &Settings,
    ) -> Result<OpenBackbone> {
        let parameters = networks::open(file)?;
        let backbone = Backbone::load(wanted.network, &parameters).context("--weights")?;
        let trained_on = backbone.trained_on();
        let count = match trained_on {
            TrainedOn::ThreeDMatch => KEYPOINTS_IN_ROOMS,
            TrainedOn::Kitti => KEYPOINTS_IN_STREETS,
        };
        let selection = wanted.selection(count, settings.refiner.seed);
        let record = BackboneRecord {
            network: wanted.network,
            trained_on,
            weights: file.to_owned(),
            weights_fingerprint: WeightsIdentity::of(&[file.to_owned()])?.fingerprint,
            neighbor_limits: wanted.neighbour_limits.clone(),
            selection,
        };
        let neighbour_limits = wanted.neighbour_limits.clone();
        Ok(OpenBackbone { backbone, selection, neighbour_limits, record })
    }

    /// What results depend on: everything but the place of the file.
    ///
    /// # Errors
    /// If it cannot be written as JSON.
    pub(crate) fn identity(&self) -> Result<serde_json::Value> {
        let mut identity = serde_json::to_value(&self.record)?;
        if let Some(record) = identity.as_object_mut() {
            record.remove("weights");
        }
        Ok(identity)
    }

    /// Describes both clouds, and gives both scans the features.
    ///
    /// # Errors
    /// What the network has: too few points, too little memory, limits that do not fit.
    pub(crate) fn describe(
        &self,
        source: &mut Scan,
        reference: &mut Scan,
    ) -> rare::Result<Described> {
        let clock = Instant::now();
        let request = Request {
            selection: self.selection,
            neighbour_limits: self.neighbour_limits.clone().map(NeighbourLimits),
            memory: memory::available(),
        };
        let description = self.backbone.describe(&source.cloud, &reference.cloud, &request)?;
        source.features = Some(description.source.features.clone());
        reference.features = Some(description.target.features.clone());
        let neighbor_limits = description.neighbour_limits.as_ref().map(|limits| limits.0.clone());
        let record = BackboneRecord { neighbor_limits, ..self.record.clone() };
        Ok(Described { description, seconds: clock.elapsed().as_secs_f64(), record })
    }
}

/// Lets a filter find the transform between two clouds on correspondences in the frames of the clouds.
///
/// # Errors
/// What the filter has.
pub(crate) fn filtered(
    filter: &dyn PoseEstimator,
    source: &PointCloud,
    reference: &PointCloud,
    pairs: &[rare::Correspondence],
) -> rare::Result<rare::RigidTransform> {
    // Networks compute in single precision: near the origin, where the clouds are.
    let local: Vec<rare::Correspondence> = pairs
        .iter()
        .map(|pair| rare::Correspondence {
            source: pair.source - source.shift(),
            target: pair.target - reference.shift(),
            ..*pair
        })
        .collect();
    let pose = filter.estimate(source, reference, &local)?.target_from_source;
    Ok(PointCloud::to_world(reference, source, &pose))
}
