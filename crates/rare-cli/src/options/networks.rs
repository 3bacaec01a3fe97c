//! The options of the networks on points: `--backbone`, `--weights`, and learned methods of `--init-method`.

use std::path::PathBuf;

use anyhow::{Result, bail};
use rare::InitialMethod;
use rare_nets::backbones::{Selection, SelectionRule};
use rare_nets::networks::Network;
use serde::{Deserialize, Deserializer, Serialize};

use super::Options;

/// What describes the clouds in 3D.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum BackboneChoice {
    /// Fast point feature histograms, built in.
    Fpfh,
    GeoTransformer,
    Predator,
    CoFiNet,
    Fcgf,
}

/// A network that tells right correspondences from wrong ones.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Filter {
    PointDsc,
    Vbreg,
}

/// How the initial transform is estimated.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(untagged)]
pub(crate) enum InitMethod {
    Builtin(InitialMethod),
    Filter(Filter),
}

/// A network that describes the clouds, with nothing left open but what depends on its weights.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Backbone {
    pub(crate) network: Network,
    /// Most neighbours of a point, stage by stage; those of the authors, or those of the clouds, if `None`.
    pub(crate) neighbour_limits: Option<Vec<usize>>,
    /// So many keypoints; as the paper has it for what the network was trained on, if `None`.
    pub(crate) keypoints: Option<usize>,
    pub(crate) rule: SelectionRule,
}

impl BackboneChoice {
    fn network(self) -> Option<Network> {
        match self {
            BackboneChoice::Fpfh => None,
            BackboneChoice::GeoTransformer => Some(Network::GeoTransformer),
            BackboneChoice::Predator => Some(Network::Predator),
            BackboneChoice::CoFiNet => Some(Network::CoFiNet),
            BackboneChoice::Fcgf => Some(Network::Fcgf),
        }
    }
}

impl Filter {
    pub(crate) fn network(self) -> Network {
        match self {
            Filter::PointDsc => Network::PointDsc,
            Filter::Vbreg => Network::Vbreg,
        }
    }
}

impl Backbone {
    /// What is kept of the keypoints.
    pub(crate) fn selection(&self, default_count: usize, seed: u64) -> Selection {
        Selection { count: self.keypoints.unwrap_or(default_count), rule: self.rule, seed }
    }
}

impl Options {
    /// The network that describes the clouds, if one was asked for.
    ///
    /// # Errors
    /// If options of networks are given without one, or a number is impossible.
    pub(super) fn resolve_backbone(&self) -> Result<Option<Backbone>> {
        if self.keypoints == Some(0) {
            bail!("--keypoints 0: at least three are needed for a transform");
        }
        let Some(network) = self.backbone.and_then(BackboneChoice::network) else {
            let useless = [
                ("--neighbor-limits", self.neighbor_limits.is_some()),
                ("--keypoint-rule", self.keypoint_rule.is_some()),
            ];
            if let Some((option, _)) = useless.into_iter().find(|(_, given)| *given) {
                bail!("{option} is for networks: add --backbone NETWORK");
            }
            return Ok(None);
        };
        if network == Network::Fcgf && self.neighbor_limits.is_some() {
            bail!("--neighbor-limits is of no use to FCGF, which has no neighbourhoods");
        }
        Ok(Some(Backbone {
            network,
            neighbour_limits: self.neighbor_limits.clone(),
            keypoints: self.keypoints,
            rule: self.keypoint_rule.unwrap_or_default(),
        }))
    }
}

/// One path or several.
pub(super) fn one_or_more<'de, D: Deserializer<'de>>(
    deserializer: D,
) -> Result<Vec<PathBuf>, D::Error> {
    #[derive(Deserialize)]
    #[serde(untagged)]
    enum Paths {
        One(PathBuf),
        More(Vec<PathBuf>),
    }
    Ok(match Paths::deserialize(deserializer)? {
        Paths::One(path) => vec![path],
        Paths::More(paths) => paths,
    })
}
