//! Any of the networks.

use rare::nalgebra::Point3;
use rare::{Error, PointCloud, Result};

use super::cofinet::CoFiNet;
use super::fcgf::{Fcgf, FcgfConfig};
use super::geotransformer::GeoTransformer;
use super::kpconv::{NeighbourLimits, PyramidConfig, calibrate};
use super::predator::Predator;
use super::sampling::sampled;
use super::{Description, Request, fitted};
use crate::checkpoint::Parameters;
use crate::networks::{Network, TrainedOn};

/// A network with its weights.
pub struct Backbone {
    network: Network,
    loaded: Loaded,
    trained_on: TrainedOn,
}

enum Loaded {
    GeoTransformer(Box<GeoTransformer>, PyramidConfig),
    Predator(Box<Predator>, PyramidConfig),
    CoFiNet(Box<CoFiNet>, PyramidConfig),
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
            Network::GeoTransformer => {
                let config = fitted::geotransformer(parameters)?;
                let pyramid = config.pyramid;
                let loaded = Box::new(GeoTransformer::load(parameters, config)?);
                (Loaded::GeoTransformer(loaded, pyramid), pyramid.voxel)
            }
            Network::Predator => {
                let config = fitted::predator(parameters)?;
                let pyramid = config.pyramid;
                let loaded = Box::new(Predator::load(parameters, config)?);
                (Loaded::Predator(loaded, pyramid), pyramid.voxel)
            }
            Network::CoFiNet => {
                let config = fitted::cofinet(parameters)?;
                let pyramid = config.pyramid;
                let loaded = Box::new(CoFiNet::load(parameters, config)?);
                (Loaded::CoFiNet(loaded, pyramid), pyramid.voxel)
            }
            Network::Fcgf => {
                let config = FcgfConfig::of(parameters);
                let voxel = config.voxel;
                (Loaded::Fcgf(Box::new(Fcgf::load(parameters, config)?)), voxel)
            }
            network => return Err(Error::Internal(format!("{network} describes no clouds"))),
        };
        Ok(Backbone { network, loaded, trained_on: TrainedOn::from_voxel(voxel) })
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
        let clouds = [source.points(), target.points()];
        let limits = self.neighbour_limits(clouds, request)?;
        self.check_memory(clouds, limits.as_ref(), request)?;
        let ([from, to], selection) = (clouds, &request.selection);
        let description = match (&self.loaded, &limits) {
            (Loaded::GeoTransformer(network, _), Some(limits)) => {
                network.describe(from, to, limits, selection)
            }
            (Loaded::Predator(network, _), Some(limits)) => {
                network.describe(from, to, limits, selection)
            }
            (Loaded::CoFiNet(network, _), Some(limits)) => {
                network.describe(from, to, limits, selection)
            }
            (Loaded::Fcgf(network), _) => network.describe(from, to, selection),
            (_, None) => Err(Error::Internal("a pyramid without neighbour limits".to_owned())),
        }?;
        Ok(Description { neighbour_limits: limits, ..description.into_world(source, target) })
    }

    /// The limits that were asked for, those of the authors, or, where they published none, those that their rule finds
    /// from the clouds. `None` for a network that has no use for them.
    fn neighbour_limits(
        &self,
        clouds: [&[Point3<f64>]; 2],
        request: &Request,
    ) -> Result<Option<NeighbourLimits>> {
        let config = match &self.loaded {
            Loaded::GeoTransformer(_, config)
            | Loaded::Predator(_, config)
            | Loaded::CoFiNet(_, config) => config,
            Loaded::Fcgf(_) => return Ok(None),
        };
        let published = NeighbourLimits::three_d_match();
        Ok(Some(match (&request.neighbour_limits, self.trained_on) {
            (Some(limits), _) => {
                limits.validate(config.stages)?;
                limits.clone()
            }
            (None, TrainedOn::ThreeDMatch) if published.0.len() == config.stages => published,
            (None, _) => {
                let pair =
                    [sampled(clouds[0], "source", config)?, sampled(clouds[1], "target", config)?];
                calibrate([pair.each_ref().map(|cloud| cloud.points.as_slice())], config)?
            }
        }))
    }

    /// Refuses clouds that would take more memory than there is.
    fn check_memory(
        &self,
        [from, to]: [&[Point3<f64>]; 2],
        limits: Option<&NeighbourLimits>,
        request: &Request,
    ) -> Result<()> {
        let Some(memory) = request.memory else { return Ok(()) };
        let needed = match (&self.loaded, limits) {
            (Loaded::GeoTransformer(network, _), Some(limits)) => {
                network.expected_bytes(from, to, limits)?
            }
            (Loaded::Predator(network, _), Some(limits)) => {
                network.expected_bytes(from, to, limits)?
            }
            (Loaded::CoFiNet(network, _), Some(limits)) => {
                network.expected_bytes(from, to, limits)?
            }
            (Loaded::Fcgf(network), _) => network.expected_bytes(from, to)?,
            (_, None) => 0,
        };
        if needed <= memory {
            return Ok(());
        }
        Err(Error::invalid(format!(
            "{} would take {:.1} GB of memory for clouds of {} and {} points, and {:.1} GB are free: cut out the part that both clouds show",
            self.network,
            needed as f64 / 1e9,
            from.len(),
            to.len(),
            memory as f64 / 1e9
        )))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn filters_describe_nothing() {
        let error = Backbone::load(Network::Vbreg, &Parameters::default()).err().unwrap();
        assert!(error.to_string().contains("VBReg"), "{error}");
    }
}
