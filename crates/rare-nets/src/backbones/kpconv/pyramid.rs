//! The stages of a pair of clouds and the neighbours in and between them.

use rare::{Error, Result};

use super::neighbours::neighbours;
use super::{NeighbourLimits, Neighbours, Point, subsample};

/// The sizes of a pyramid; lengths of stage `l` are `2^l` times those of stage 0.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PyramidConfig {
    /// How far apart the points of stage 0 are, metres.
    pub voxel: f64,
    /// Number of stages.
    pub stages: usize,
    /// How far a convolution reaches, in voxels.
    pub radius: f64,
    /// How far a kernel point reaches, in voxels.
    pub sigma: f64,
}

impl PyramidConfig {
    /// The voxel of a stage, metres.
    #[must_use]
    pub fn voxel(&self, stage: usize) -> f64 {
        self.voxel * 2_f64.powi(stage.min(64) as i32)
    }

    /// The radius of the neighbourhoods of a stage, metres.
    #[must_use]
    pub fn radius(&self, stage: usize) -> f64 {
        self.radius * self.voxel(stage)
    }

    /// The reach of a kernel point at a stage, metres.
    #[must_use]
    pub fn sigma(&self, stage: usize) -> f64 {
        self.sigma * self.voxel(stage)
    }

    /// One for each voxel within the radius and one voxel more: as many neighbours as a point can have.
    #[must_use]
    pub fn most_neighbours(&self) -> usize {
        (4.0 / 3.0 * std::f64::consts::PI * (self.radius + 1.0).powi(3)).ceil() as usize
    }
}

/// The points of a stage.
#[derive(Debug, Clone, PartialEq)]
pub struct StagePoints {
    /// Those of the first cloud, then those of the second, metres.
    pub points: Vec<Point>,
    /// How many each has.
    pub lengths: [usize; 2],
}

impl StagePoints {
    /// The points of all stages: `clouds`, then one point for each voxel of the stage before.
    ///
    /// # Errors
    /// `InvalidInput` if a cloud has no points or is no input of [`subsample`].
    pub fn new(clouds: [&[Point]; 2], config: &PyramidConfig) -> Result<Vec<StagePoints>> {
        if let [0, _] | [_, 0] = clouds.map(<[Point]>::len) {
            let [first, second] = clouds.map(<[Point]>::len);
            return Err(Error::invalid(format!(
                "the clouds have {first} and {second} points: a network needs points in both"
            )));
        }
        let mut stages = vec![StagePoints::stacked(clouds[0].to_vec(), clouds[1])];
        for level in 1..config.stages {
            let voxel = config.voxel(level) as f32;
            let Some(finer) = stages.last() else { break };
            let (first, second) = finer.points.split_at(finer.lengths[0]);
            stages.push(StagePoints::stacked(subsample(first, voxel)?, &subsample(second, voxel)?));
        }
        Ok(stages)
    }

    fn stacked(mut points: Vec<Point>, second: &[Point]) -> StagePoints {
        let lengths = [points.len(), second.len()];
        points.extend_from_slice(second);
        StagePoints { points, lengths }
    }

    /// The points of either cloud.
    #[must_use]
    pub fn clouds(&self) -> [&[Point]; 2] {
        let (first, second) = self.points.split_at(self.lengths[0].min(self.points.len()));
        [first, second]
    }
}

/// A stage: its points and their neighbours.
#[derive(Debug, Clone)]
pub struct Stage {
    /// The points.
    pub points: Vec<Point>,
    /// How many each cloud has.
    pub lengths: [usize; 2],
    /// For each point those near it.
    pub neighbours: Neighbours,
    /// For each point of the next coarser stage the points of this one near it; `None` at the coarsest.
    pub subsampling: Option<Neighbours>,
    /// For each point the nearest one of the next coarser stage, or the number of points there if none is near; empty
    /// at the coarsest.
    pub upsampling: Vec<u32>,
}

impl Stage {
    /// The points of either cloud.
    #[must_use]
    pub fn clouds(&self) -> [&[Point]; 2] {
        let (first, second) = self.points.split_at(self.lengths[0].min(self.points.len()));
        [first, second]
    }
}

/// Two clouds at several resolutions, the finest first.
#[derive(Debug, Clone)]
pub struct Pyramid {
    /// The stages.
    pub stages: Vec<Stage>,
}

impl Pyramid {
    /// Thins the clouds from stage to stage and finds all neighbours.
    ///
    /// # Errors
    /// `InvalidInput` if a cloud is empty, not finite or too large for the voxels, or the limits are not one for each
    /// stage.
    pub fn new(
        clouds: [&[Point]; 2],
        config: &PyramidConfig,
        limits: &NeighbourLimits,
    ) -> Result<Pyramid> {
        limits.validate(config.stages)?;
        Pyramid::over(StagePoints::new(clouds, config)?, config, limits)
    }

    /// Finds the neighbours in and between stages whose points are known.
    ///
    /// # Errors
    /// As [`Pyramid::new`].
    pub fn over(
        points: Vec<StagePoints>,
        config: &PyramidConfig,
        limits: &NeighbourLimits,
    ) -> Result<Pyramid> {
        limits.validate(points.len())?;
        for StagePoints { points, lengths: [first, second] } in &points {
            if first.checked_add(*second) != Some(points.len()) {
                return Err(Error::invalid(format!(
                    "clouds of {first} and {second} points are not {} points together",
                    points.len()
                )));
            }
        }
        let near = |queries: &StagePoints, support: &StagePoints, level: usize, limit: usize| {
            let radius = config.radius(level) as f32;
            let lengths = [queries.lengths, support.lengths];
            neighbours([&queries.points, &support.points], lengths, radius, limit)
        };
        let mut found = Vec::with_capacity(points.len());
        for (level, (stage, &limit)) in points.iter().zip(&limits.0).enumerate() {
            let inside = near(stage, stage, level, limit)?;
            let (subsampling, upsampling) = match points.get(level + 1) {
                Some(coarser) => {
                    let nearest = near(stage, coarser, level + 1, 1)?;
                    (Some(near(coarser, stage, level, limit)?), nearest.indices().to_vec())
                }
                None => (None, Vec::new()),
            };
            found.push((inside, subsampling, upsampling));
        }
        let stage = |(stage, found): (StagePoints, (Neighbours, Option<Neighbours>, Vec<u32>))| {
            let StagePoints { points, lengths } = stage;
            let (neighbours, subsampling, upsampling) = found;
            Stage { points, lengths, neighbours, subsampling, upsampling }
        };
        Ok(Pyramid { stages: points.into_iter().zip(found).map(stage).collect() })
    }

    /// Where a convolution at `level` looks, or one from `level` to the next coarser stage.
    ///
    /// # Errors
    /// `Internal` if there is no such stage.
    pub(crate) fn neighbourhood(&self, level: usize, strided: bool) -> Result<Neighbourhood<'_>> {
        let missing = || Error::Internal(format!("a pyramid without stage {level} or the next"));
        let stage = self.stages.get(level).ok_or_else(missing)?;
        if !strided {
            let (points, neighbours) = (&stage.points, &stage.neighbours);
            return Ok(Neighbourhood { queries: points, support: points, neighbours });
        }
        let coarser = self.stages.get(level + 1).ok_or_else(missing)?;
        let neighbours = stage.subsampling.as_ref().ok_or_else(missing)?;
        Ok(Neighbourhood { queries: &coarser.points, support: &stage.points, neighbours })
    }
}

/// The points of a convolution.
#[derive(Clone, Copy)]
pub(crate) struct Neighbourhood<'a> {
    /// Where results are wanted.
    pub(crate) queries: &'a [Point],
    /// Where features are.
    pub(crate) support: &'a [Point],
    /// Which of the support are near each query.
    pub(crate) neighbours: &'a Neighbours,
}
