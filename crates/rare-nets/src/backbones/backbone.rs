//! Any of the networks.

use rare::{Error, PointCloud, Result};

use super::fcgf::{self, Fcgf};
use super::{Description, Request};
use crate::checkpoint::Parameters;
use crate::networks::{Network, TrainedOn};

/// A network with its weights.
pub struct Backbone {
    loaded: Loaded,
    trained_on: TrainedOn,
}

enum Loaded {
    Fcgf(Box<Fcgf>),
}

impl Backbone {
    /// Loads a network, with the sizes and lengths that its weights have.
    ///
    /// # Errors
    /// `InvalidInput` if the weights are of another network, or damaged; `Internal` if the network is none that
    /// describes clouds.
    pub fn load(network: Network, parameters: &Parameters) -> Result<Backbone> {
        let (loaded, trained_on) = match network {
            Network::Fcgf => {
                let config = fcgf::FcgfConfig::of(parameters);
                let trained_on = TrainedOn::from_voxel(config.voxel);
                (Loaded::Fcgf(Box::new(Fcgf::load(parameters, config)?)), trained_on)
            }
            network => return Err(Error::Internal(format!("{network} describes no clouds"))),
        };
        Ok(Backbone { loaded, trained_on })
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
        let points = [source.points(), target.points()];
        let description = match &self.loaded {
            Loaded::Fcgf(network) => network.describe(points[0], points[1], &request.selection),
        }?;
        Ok(description.into_world(source, target))
    }
}
