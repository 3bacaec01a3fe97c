//! Any of the networks.

use rare::{Error, PointCloud, Result};

use super::cofinet::CoFiNet;
use super::fcgf::{Fcgf, FcgfConfig};
use super::kpconv::{NeighbourLimits, PyramidConfig};
use super::predator::Predator;
use super::{Description, Request, fitted};
use crate::checkpoint::Parameters;
use crate::networks::{Network, TrainedOn};

/// A network with its weights.
pub struct Backbone {
    loaded: Loaded,
    trained_on: TrainedOn,
}

enum Loaded {
    Predator(Box<Predator>),
    CoFiNet(Box<CoFiNet>),
    Fcgf(Box<Fcgf>),
}

impl Backbone {
    /// Loads a network, with the sizes and lengths that its weights have.
    ///
    /// # Errors
    /// `InvalidInput` if the weights are of another network, or damaged; `Internal` if the network is none that
    /// describes clouds.
    pub fn load(network: Network, parameters: &Parameters) -> Result<Backbone> {
        let (loaded, voxel) = match network {
            Network::Predator => {
                let config = fitted::predator(parameters)?;
                let voxel = config.pyramid.voxel;
                (Loaded::Predator(Box::new(Predator::load(parameters, config)?)), voxel)
            }
            Network::CoFiNet => {
                let config = fitted::cofinet(parameters)?;
                let voxel = config.pyramid.voxel;
                (Loaded::CoFiNet(Box::new(CoFiNet::load(parameters, config)?)), voxel)
            }
            Network::Fcgf => {
                let config = FcgfConfig::of(parameters);
                let voxel = config.voxel;
                (Loaded::Fcgf(Box::new(Fcgf::load(parameters, config)?)), voxel)
            }
            network => return Err(Error::Internal(format!("{network} describes no clouds"))),
        };
        Ok(Backbone { loaded, trained_on: TrainedOn::from_voxel(voxel) })
    }

    /// What the weights were trained on.
    #[must_use]
    pub fn trained_on(&self) -> TrainedOn {
        self.trained_on
    }

    /// Finds keypoints, features, correspondences and a pose of two clouds, in their frames as the caller gave them.
    ///
    /// # Errors
    /// `InvalidInput` if the clouds have too few points, would need more memory than there is, or the neighbour limits
    /// do not fit.
    pub fn describe(
        &self,
        source: &PointCloud,
        target: &PointCloud,
        request: &Request,
    ) -> Result<Description> {
        let [from, to] = [source.points(), target.points()];
        let selection = &request.selection;
        let limits = NeighbourLimits::three_d_match();
        let description = match &self.loaded {
            Loaded::Predator(network) => network.describe(from, to, &limits, selection),
            Loaded::CoFiNet(network) => network.describe(from, to, &limits, selection),
            Loaded::Fcgf(network) => network.describe(from, to, selection),
        }?;
        Ok(description.into_world(source, target))
    }
}
