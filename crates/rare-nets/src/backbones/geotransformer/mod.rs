//! `GeoTransformer` (Qin et al., "Geometric Transformer for Fast and Robust Point Cloud Registration", CVPR 2022).
//!
//! | module | section | what it holds |
//! |---|---|---|
//! | `config`, `layout` | | the sizes of the released networks, the names of their tensors |
//! | `backbone` | 3.1 | features of superpoints and points |
//! | `partition` | 3.1 | which points belong to which superpoint |
//! | `embedding`, `attention`, `transformer` | 3.2 | superpoints that know of each other |
//! | `superpoint_matching` | 3.2 | which superpoints belong together |
//! | `point_matching` | 3.3 | which of their points |
//! | `describe` | 3.4 | from clouds to keypoints, correspondences and a pose |
//! | `memory` | | what a run will take |
//!
//! The paper's reference is our target, and comes first in all pairs.

mod attention;
mod backbone;
mod config;
mod describe;
mod embedding;
mod layout;
mod memory;
mod partition;
mod point_matching;
mod superpoint_matching;
mod transformer;

pub use backbone::Watch;
pub use config::{FineMatchingConfig, GeoTransformerConfig, TransformerConfig};
pub use layout::layout;
pub use partition::Partition;
pub use point_matching::{PointMatch, match_points};
pub use superpoint_matching::SuperpointMatch;

use rare::nalgebra::Point3;
use rare::{Correspondence, Error, Result};

use self::backbone::Backbone;
use self::point_matching::transport;
use self::superpoint_matching::match_superpoints;
use self::transformer::Transformer;
use super::kpconv::{Point, Pyramid, Stage};
use crate::Matrix;
use crate::checkpoint::Parameters;
use crate::engine::{CpuBackend, Precision};
use crate::layers::Weights;

/// The network, ready to run.
pub struct GeoTransformer {
    config: GeoTransformerConfig,
    cpu: CpuBackend,
    backbone: Backbone,
    transformer: Transformer,
    /// The score of finding no partner.
    dustbin: f32,
}

/// What the network says of two clouds, step by step. Of each pair the first is the target's.
#[derive(Debug, Clone)]
pub struct Registration {
    /// Which points belong to which superpoint.
    pub partitions: [Partition; 2],
    /// Features of the superpoints that know of each other, of unit length.
    pub superpoint_features: [Matrix; 2],
    /// Features of the points of the second finest stage.
    pub point_features: [Matrix; 2],
    /// Which superpoints belong together, the best first.
    pub superpoint_matches: Vec<SuperpointMatch>,
    /// For each of them the logarithms of the transport plan between their points.
    pub plans: Vec<Matrix>,
    /// Which points belong together.
    pub point_matches: Vec<PointMatch>,
}

impl GeoTransformer {
    /// Takes the weights of a network of these sizes, named as in the released checkpoints.
    ///
    /// # Errors
    /// `InvalidInput` if they are those of another network or damaged; `Io` if a file cannot be read.
    pub fn load(parameters: &Parameters, config: GeoTransformerConfig) -> Result<GeoTransformer> {
        if config.pyramid.stages < 3 {
            return Err(Error::invalid("a GeoTransformer has at least three stages"));
        }
        let layout = layout(&config);
        let network = format!("GeoTransformer for {}", config.name);
        let weights = Weights::new(parameters, &layout, &network)?;
        let cpu = CpuBackend::new(Precision::F32)?;
        Ok(GeoTransformer {
            backbone: Backbone::load(&cpu, &weights, &config)?,
            transformer: Transformer::load(&cpu, &weights, &config.transformer)?,
            dustbin: weights.scalar("optimal_transport.alpha")?,
            config,
            cpu,
        })
    }

    /// Its sizes.
    #[must_use]
    pub fn config(&self) -> &GeoTransformerConfig {
        &self.config
    }

    /// Matches the clouds of a pyramid, of which the first is the target. `watch` receives what the parts of the
    /// backbone and the transformer compute.
    ///
    /// # Errors
    /// `InvalidInput` if a cloud has too few superpoints or spans too much.
    pub fn register(&self, pyramid: &Pyramid, watch: &mut Watch<'_>) -> Result<Registration> {
        let (cpu, config) = (&self.cpu, &self.config);
        let [fine, coarse] = [1, config.pyramid.stages - 1].map(|level| pyramid.stages.get(level));
        let (Some(fine), Some(coarse)) = (fine, coarse) else {
            return Err(Error::Internal("a pyramid of too few stages".to_owned()));
        };
        let (points, superpoints) = (fine.clouds(), coarse.clouds());
        let partition =
            |cloud: usize| Partition::new(points[cloud], superpoints[cloud], config.patch_points);

        let features = self.backbone.apply(cpu, pyramid, watch)?;
        let point_features = of_clouds(fine, &features.points);
        let superpoint_features = of_clouds(coarse, &features.superpoints);
        let superpoint_features =
            self.transformer.apply(cpu, superpoints, &superpoint_features, watch)?;
        let partitions = [partition(0), partition(1)];
        let superpoint_matches =
            match_superpoints(cpu, &superpoint_features, &partitions, config.superpoint_matches)?;
        let plans = transport(
            cpu,
            &point_features,
            &partitions,
            &superpoint_matches,
            self.dustbin,
            config.sinkhorn_iterations,
        )?;
        let point_matches = match_points(&plans, &partitions, &superpoint_matches, &config.fine);
        Ok(Registration {
            partitions,
            superpoint_features,
            point_features,
            superpoint_matches,
            plans,
            point_matches,
        })
    }

    /// The embedding of all pairs of superpoints (metres), row by row: what the network sees of their arrangement. The
    /// network itself never forms it.
    ///
    /// # Errors
    /// `InvalidInput` if there are too few superpoints or they span too much.
    pub fn geometric_structure(&self, superpoints: &[Point]) -> Result<Matrix> {
        self.transformer.embedding.of_cloud(&self.cpu, superpoints)
    }
}

impl Registration {
    /// The matches as pairs of points of a pyramid, which is the one that was registered, and the places of those of each
    /// pair of patches.
    #[must_use]
    pub fn correspondences(&self, pyramid: &Pyramid) -> (Vec<Correspondence>, Vec<Vec<usize>>) {
        let Some(stage) = pyramid.stages.get(1) else { return (Vec::new(), Vec::new()) };
        let [target, source] = stage.clouds();
        let point = |cloud: &[Point], index: usize| {
            let point = cloud.get(index).copied().unwrap_or_default();
            Point3::from(point.map(f64::from))
        };
        let mut groups = vec![Vec::new(); self.plans.len()];
        let pair = |(place, found): (usize, &PointMatch)| {
            if let Some(group) = groups.get_mut(found.patch) {
                group.push(place);
            }
            Correspondence {
                source: point(source, found.source),
                target: point(target, found.target),
                score: f64::from(found.score),
            }
        };
        let pairs = self.point_matches.iter().enumerate().map(pair).collect();
        (pairs, groups)
    }
}

/// The rows of each cloud of a stage.
fn of_clouds(stage: &Stage, features: &Matrix) -> [Matrix; 2] {
    let [first, second] = stage.lengths;
    [features.part(0, first), features.part(first, second)]
}
