//! Clouds made ready for a network.

use rare::Result;
use rare::nalgebra::Point3;

use super::EncoderSizes;
use crate::backbones::kpconv::{
    NeighbourLimits, Point, Pyramid, PyramidConfig, StagePoints, pyramid_bytes,
};
use crate::backbones::sampling::{Sampled, sampled};

/// Two clouds at the density of a network, the source first.
pub(in crate::backbones) struct Prepared {
    clouds: [Sampled; 2],
    stages: Vec<StagePoints>,
}

impl Prepared {
    /// Thins clouds (metres, local frames) that are denser than the voxels of the first stage, and finds the points of all
    /// stages.
    ///
    /// # Errors
    /// `InvalidInput` if a cloud is empty, not finite or too large for the voxels.
    pub(in crate::backbones) fn new(
        source: &[Point3<f64>],
        target: &[Point3<f64>],
        config: &PyramidConfig,
    ) -> Result<Prepared> {
        let of = |points, name| sampled(points, name, config);
        let clouds = [of(source, "source")?, of(target, "target")?];
        let stages =
            StagePoints::new(clouds.each_ref().map(|cloud| cloud.points.as_slice()), config)?;
        Ok(Prepared { clouds, stages })
    }

    /// The stages with all neighbours, no more than `limits` of each point.
    ///
    /// # Errors
    /// `InvalidInput` if the limits are not one for each stage.
    pub(in crate::backbones) fn pyramid(
        &self,
        config: &PyramidConfig,
        limits: &NeighbourLimits,
    ) -> Result<Pyramid> {
        Pyramid::over(self.stages.clone(), config, limits)
    }

    /// The points of the first stage of either cloud, metres, local frames.
    pub(in crate::backbones) fn points(&self) -> [Vec<Point3<f64>>; 2] {
        self.clouds.each_ref().map(|cloud| {
            let place = |point: &Point| Point3::from(point.map(f64::from)) + cloud.shift;
            cloud.points.iter().map(place).collect()
        })
    }

    /// What to say if the clouds are unlike those of the training.
    pub(in crate::backbones) fn warnings(&self, config: &PyramidConfig) -> Vec<String> {
        let named = self.clouds.iter().zip(["source", "target"]);
        named.filter_map(|(cloud, name)| cloud.warning(name, config.voxel)).collect()
    }

    /// An estimate of the bytes that the pyramid takes with the features of the encoder and the decoder.
    pub(in crate::backbones) fn bytes(
        &self,
        sizes: &EncoderSizes,
        limits: &NeighbourLimits,
    ) -> u64 {
        let counts: Vec<usize> = self.stages.iter().map(|stage| stage.points.len()).collect();
        let channels: Vec<usize> = (0..counts.len()).map(|stage| sizes.width << stage).collect();
        pyramid_bytes(&counts, limits, &channels)
    }

    /// Coarse points of each cloud.
    pub(in crate::backbones) fn coarsest(&self) -> [usize; 2] {
        self.stages.last().map(|stage| stage.lengths).unwrap_or_default()
    }
}
