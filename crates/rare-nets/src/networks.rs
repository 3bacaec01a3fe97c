//! The networks on points by name: which one a weight file is of, and opening it.

use std::fmt;
use std::path::Path;

use rare::pose::{Mode, PoseEstimator};
use rare::{Error, Result};
use serde::{Deserialize, Serialize};

use crate::backbones::cofinet::{self, CoFiNetConfig};
use crate::backbones::fcgf::{self, FcgfConfig};
use crate::backbones::geotransformer::{self, GeoTransformerConfig};
use crate::backbones::kpconv::PyramidConfig;
use crate::backbones::predator::{self, PredatorConfig};
use crate::backbones::{Backbone, fitted};
use crate::checkpoint::{Differences, Layout, Parameters, compare};
use crate::outliers::pointdsc::{self, PointDsc, PointDscConfig};
use crate::outliers::vbreg::{self, Vbreg, VbregConfig};

/// A network on points.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Network {
    /// [`crate::backbones::geotransformer`].
    GeoTransformer,
    /// [`crate::backbones::predator`].
    Predator,
    /// [`crate::backbones::cofinet`].
    CoFiNet,
    /// [`crate::backbones::fcgf`].
    Fcgf,
    /// [`crate::outliers::pointdsc`].
    PointDsc,
    /// [`crate::outliers::vbreg`].
    Vbreg,
}

/// What the weights of a network were trained on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum TrainedOn {
    /// Rooms, seen by depth cameras: points 2.5 cm apart.
    #[serde(rename = "3dmatch")]
    ThreeDMatch,
    /// Streets, seen by a rotating scanner: points 30 cm apart.
    Kitti,
}

impl Network {
    /// All of them.
    pub const ALL: [Network; 6] = [
        Network::GeoTransformer,
        Network::Predator,
        Network::CoFiNet,
        Network::Fcgf,
        Network::PointDsc,
        Network::Vbreg,
    ];

    /// The name that options and files have for it.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Network::GeoTransformer => "geotransformer",
            Network::Predator => "predator",
            Network::CoFiNet => "cofinet",
            Network::Fcgf => "fcgf",
            Network::PointDsc => "pointdsc",
            Network::Vbreg => "vbreg",
        }
    }

    /// Whether it tells right correspondences from wrong ones, instead of describing clouds.
    #[must_use]
    pub fn is_filter(self) -> bool {
        matches!(self, Network::PointDsc | Network::Vbreg)
    }
}

impl TrainedOn {
    /// By the spacing of the points, metres.
    pub(crate) fn from_voxel(voxel: f64) -> TrainedOn {
        if voxel > 0.15 { TrainedOn::Kitti } else { TrainedOn::ThreeDMatch }
    }
}

impl fmt::Display for Network {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(match self {
            Network::GeoTransformer => "GeoTransformer",
            Network::Predator => "Predator",
            Network::CoFiNet => "CoFiNet",
            Network::Fcgf => "FCGF",
            Network::PointDsc => "PointDSC",
            Network::Vbreg => "VBReg",
        })
    }
}

impl fmt::Display for TrainedOn {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(match self {
            TrainedOn::ThreeDMatch => "3DMatch",
            TrainedOn::Kitti => "KITTI",
        })
    }
}

/// What a weight file holds.
#[derive(Debug, Clone, PartialEq)]
pub struct Identity {
    /// The network.
    pub network: Network,
    /// What it was trained on, by its sizes and lengths.
    pub trained_on: TrainedOn,
    /// Its sizes and lengths in words.
    pub configuration: String,
    /// Where the tensors differ from what the network needs.
    pub differences: Differences,
}

/// A network with certain sizes, of which a file may be.
struct Candidate {
    network: Network,
    trained_on: TrainedOn,
    configuration: String,
    layout: Layout,
}

/// The least share of a network's names by which a file counts as its weights.
const LEAST_SHARE: f64 = 0.5;

/// Opens a checkpoint of a network on points: what data-parallel training puts before every name is taken off.
///
/// # Errors
/// Those of [`Parameters::open`].
pub fn open(path: &Path) -> Result<Parameters> {
    const PREFIX: &str = "module.";
    let parameters = Parameters::open(path)?;
    if !parameters.names().all(|name| name.starts_with(PREFIX)) {
        return Ok(parameters);
    }
    parameters.renamed(|name| name.strip_prefix(PREFIX).map(str::to_owned))
}

/// Which network the weights are of, by names, shapes and the few numbers that say what it was trained on; `None` if of
/// none that is known.
#[must_use]
pub fn identify(parameters: &Parameters) -> Option<Identity> {
    let share = |candidate: &Candidate| {
        let found = candidate.layout.keys().filter(|name| parameters.contains(name)).count();
        found as f64 / candidate.layout.len().max(1) as f64
    };
    let (share, best) = candidates(parameters)
        .into_iter()
        .map(|candidate| (share(&candidate), candidate))
        .max_by(|(a, _), (b, _)| a.total_cmp(b))?;
    (share >= LEAST_SHARE).then(|| Identity {
        network: best.network,
        trained_on: best.trained_on,
        configuration: best.configuration,
        differences: compare(&best.layout, parameters),
    })
}

/// Every network, with the sizes that the weights would have if they were of it; where not even those can be told, with
/// those of the released one.
fn candidates(parameters: &Parameters) -> Vec<Candidate> {
    let rooms = GeoTransformerConfig::three_d_match;
    let geotransformer = fitted::geotransformer(parameters).unwrap_or_else(|_| rooms());
    let rooms = PredatorConfig::three_d_match;
    let predator = fitted::predator(parameters).unwrap_or_else(|_| rooms());
    let rooms = CoFiNetConfig::three_d_match;
    let cofinet = fitted::cofinet(parameters).unwrap_or_else(|_| rooms());
    vec![
        geotransformer_candidate(&geotransformer),
        predator_candidate(&predator),
        cofinet_candidate(&cofinet),
        fcgf_candidate(parameters),
        filter_candidate(Network::PointDsc, pointdsc::layout(), parameters),
        filter_candidate(Network::Vbreg, vbreg::layout(), parameters),
    ]
}

fn geotransformer_candidate(config: &GeoTransformerConfig) -> Candidate {
    let layout = geotransformer::layout(config);
    of_pyramid(Network::GeoTransformer, &config.pyramid, config.features, layout)
}

fn predator_candidate(config: &PredatorConfig) -> Candidate {
    of_pyramid(Network::Predator, &config.pyramid, config.features, predator::layout(config))
}

fn cofinet_candidate(config: &CoFiNetConfig) -> Candidate {
    of_pyramid(Network::CoFiNet, &config.pyramid, config.features, cofinet::layout(config))
}

fn of_pyramid(
    network: Network,
    pyramid: &PyramidConfig,
    features: usize,
    layout: Layout,
) -> Candidate {
    let (stages, voxel) = (pyramid.stages, pyramid.voxel);
    let configuration =
        format!("{stages} stages, the first of points {voxel} m apart; {features} features");
    Candidate { network, trained_on: TrainedOn::from_voxel(voxel), configuration, layout }
}

fn fcgf_candidate(parameters: &Parameters) -> Candidate {
    let config = FcgfConfig::of(parameters);
    let unit = if config.unit_features { "of unit length" } else { "of any length" };
    Candidate {
        network: Network::Fcgf,
        trained_on: TrainedOn::from_voxel(config.voxel),
        configuration: format!(
            "voxels of {} m, first kernel {1} x {1} x {1}, {2} features {unit}",
            config.voxel, config.first_kernel, config.features
        ),
        layout: fcgf::layout_as_stored(&config, parameters),
    }
}

fn filter_candidate(network: Network, layout: Layout, parameters: &Parameters) -> Candidate {
    let reach = compatible_difference(parameters);
    Candidate {
        network,
        trained_on: trained_filter(reach),
        configuration: match reach {
            Some(reach) => format!("lengths of right pairs differ by less than {reach} m"),
            None => "lengths of right pairs: not stated".to_owned(),
        },
        layout,
    }
}

/// The difference of lengths, metres, up to which a filter takes two pairs for compatible: a parameter of its training.
fn compatible_difference(parameters: &Parameters) -> Option<f32> {
    parameters.read("sigma_spat", &[1]).ok()?.to_f32().first().copied()
}

/// Rooms: 10 cm; streets: 1.2 m.
fn trained_filter(compatible_difference: Option<f32>) -> TrainedOn {
    match compatible_difference {
        Some(difference) if difference > 0.4 => TrainedOn::Kitti,
        _ => TrainedOn::ThreeDMatch,
    }
}

/// Reads all weights of a network once.
///
/// # Errors
/// If some are missing, of another shape, or not finite.
pub fn check(identity: &Identity, parameters: &Parameters) -> Result<()> {
    if identity.network.is_filter() {
        open_filter(identity.network, parameters, None).map(|_| ())
    } else {
        Backbone::load(identity.network, parameters).map(|_| ())
    }
}

/// Opens a network that tells right correspondences from wrong ones, with the lengths of what it was trained on. With
/// `noise`, a seed, VBReg samples its states, as its authors let it; otherwise it takes their means.
///
/// # Errors
/// `InvalidInput` if the weights are of another network, or damaged; `Internal` if the network is none of this kind.
pub fn open_filter(
    network: Network,
    parameters: &Parameters,
    noise: Option<u64>,
) -> Result<Box<dyn PoseEstimator>> {
    let trained_on = trained_filter(compatible_difference(parameters));
    Ok(match (network, trained_on) {
        (Network::PointDsc, TrainedOn::ThreeDMatch) => {
            Box::new(PointDsc::load(parameters, PointDscConfig::three_d_match(Mode::Fixed))?)
        }
        (Network::PointDsc, TrainedOn::Kitti) => {
            Box::new(PointDsc::load(parameters, PointDscConfig::kitti(Mode::Fixed))?)
        }
        (Network::Vbreg, trained_on) => {
            let config = match trained_on {
                TrainedOn::ThreeDMatch => VbregConfig::three_d_match(Mode::Fixed),
                TrainedOn::Kitti => VbregConfig::kitti(Mode::Fixed),
            };
            Box::new(Vbreg::load(parameters, VbregConfig { noise, ..config })?)
        }
        (network, _) => {
            return Err(Error::Internal(format!("{network} filters no correspondences")));
        }
    })
}
