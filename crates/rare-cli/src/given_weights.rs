//! Which of the paths of `--weights` is for what: checkpoints of networks on points are known by their tensors, the rest
//! is for the diffusion pipeline.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use rare_nets::cache::WeightsIdentity;
use rare_nets::networks::{self, Identity, Network, TrainedOn};
use serde::Serialize;

use crate::options::{Encoder, Settings};

/// The paths and what is in them.
pub(crate) struct GivenWeights(Vec<Given>);

struct Given {
    path: PathBuf,
    /// `None`: no network on points.
    identity: Option<Identity>,
}

/// Which weights a network has that tells right correspondences from wrong ones.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct FilterIdentity {
    network: Network,
    /// SHA-256 of the name, length and samples of the file.
    weights_fingerprint: String,
}

impl GivenWeights {
    /// Those of networks that tell right correspondences from wrong ones.
    ///
    /// # Errors
    /// If a file cannot be read.
    pub(crate) fn filters(&self) -> Result<Vec<FilterIdentity>> {
        let networks = self.0.iter().filter_map(|given| {
            let network = given.identity.as_ref()?.network;
            network.is_filter().then_some((network, &given.path))
        });
        networks
            .map(|(network, path)| {
                let weights_fingerprint =
                    WeightsIdentity::of(std::slice::from_ref(path))?.fingerprint;
                Ok(FilterIdentity { network, weights_fingerprint })
            })
            .collect()
    }

    /// Looks into every path: at names and shapes, and at the few numbers that say what a network was trained on.
    ///
    /// # Errors
    /// If a path does not exist, or is a file that is no checkpoint.
    pub(crate) fn read(paths: &[PathBuf]) -> Result<GivenWeights> {
        paths.iter().map(|path| Given::read(path)).collect::<Result<_>>().map(GivenWeights)
    }

    /// Makes sure that there is a use for all of them.
    ///
    /// # Errors
    /// If nothing uses one of them.
    pub(crate) fn check_use(&self, settings: &Settings, networks: &[Network]) -> Result<()> {
        for given in &self.0 {
            let is_used = match &given.identity {
                Some(identity) => networks.contains(&identity.network),
                None => settings.encoder == Encoder::Diffusion,
            };
            if !is_used {
                bail!("--weights {}: {}", given.path.display(), given.why_useless());
            }
        }
        Ok(())
    }

    /// The checkpoint of a network, which `option` asked for.
    ///
    /// # Errors
    /// If there is none, or more than one.
    pub(crate) fn of(&self, network: Network, option: &str) -> Result<&Path> {
        let mut found = self.0.iter().filter(|given| given.is_of(network));
        match (found.next(), found.next()) {
            (Some(given), None) => Ok(&given.path),
            (Some(first), Some(second)) => bail!(
                "--weights: {} and {} are both of {network}: name one of them",
                first.path.display(),
                second.path.display()
            ),
            (None, _) => {
                let others: Vec<String> = self.0.iter().map(Given::describe).collect();
                let others = if others.is_empty() {
                    String::new()
                } else {
                    format!(" ({})", others.join("; "))
                };
                bail!(
                    "{option} needs the weights of {network}{others}: add --weights FILE; `rare weights list` says where its authors publish them"
                )
            }
        }
    }

    /// The checkpoint of a network that was trained on this kind of data, if there is one.
    pub(crate) fn trained_on(&self, network: Network, trained_on: TrainedOn) -> Option<&Path> {
        let fits = |given: &&Given| {
            given.identity.as_ref().is_some_and(|identity| {
                identity.network == network && identity.trained_on == trained_on
            })
        };
        self.0.iter().find(fits).map(|given| given.path.as_path())
    }

    /// What is left for the diffusion pipeline.
    ///
    /// # Errors
    /// If that is more than one.
    pub(crate) fn diffusion(&self) -> Result<Option<&Path>> {
        let mut left = self.0.iter().filter(|given| given.identity.is_none());
        match (left.next(), left.next()) {
            (Some(first), Some(second)) => bail!(
                "--weights: neither {} nor {} is of a network on points, and the diffusion pipeline is one folder",
                first.path.display(),
                second.path.display()
            ),
            (first, _) => Ok(first.map(|given| given.path.as_path())),
        }
    }
}

impl Given {
    fn read(path: &Path) -> Result<Given> {
        let metadata =
            std::fs::metadata(path).with_context(|| format!("--weights {}", path.display()))?;
        let identity = if metadata.is_dir() {
            None
        } else {
            networks::identify(&networks::open(path).context("--weights")?)
        };
        Ok(Given { path: path.to_owned(), identity })
    }

    fn is_of(&self, network: Network) -> bool {
        self.identity.as_ref().is_some_and(|identity| identity.network == network)
    }

    fn describe(&self) -> String {
        let path = self.path.display();
        match &self.identity {
            Some(identity) => format!("{path} is of {}", identity.network),
            None => format!("{path} is of no network on points"),
        }
    }

    fn why_useless(&self) -> String {
        match &self.identity {
            Some(identity) if identity.network.is_filter() => format!(
                "the weights of {0}, which is not used: add --init-method {1}",
                identity.network,
                identity.network.name()
            ),
            Some(identity) => format!(
                "the weights of {0}, which is not used: add --backbone {1}",
                identity.network,
                identity.network.name()
            ),
            None => "the weights of no network on points; for a diffusion pipeline add --encoder diffusion".to_owned(),
        }
    }
}
