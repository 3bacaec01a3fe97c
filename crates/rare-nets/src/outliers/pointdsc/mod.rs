//! PointDSC: a network whose attention knows which correspondences keep their distance (Bai, Luo, Zhou, Chen, Li, Hu, Fu
//! and Tai, CVPR 2021).
//!
//! Every correspondence gets a feature that gathers, layer by layer, what those consistent with it say (section 3.2 of
//! the paper), and a confidence. Confident, well spread ones are seeds; around each one the nearest in feature space make
//! a pose, weighted by the leading eigenvector of their compatibility (section 3.3); the pose that most pairs agree with
//! is polished.

mod network;

use rare::pose::{Mode, PoseEstimate, PoseEstimator, validate_pairs};
use rare::{Correspondence, PointCloud, Result, RigidTransform};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

pub use network::layout;

use super::compatibility::Compatibilities;
use super::seed_consensus::SeedConsensus;
use crate::Matrix;
use crate::checkpoint::Parameters;
use crate::engine::{CpuBackend, Precision};
use crate::layers::{Linear, unit_rows};
use network::Network;

/// Seeds whose neighbours are searched for at once.
const SEEDS: usize = 64;

/// The settings of PointDSC. The widths of the compatibilities are parameters of the network: the configured one of the
/// released code has no effect once weights are loaded.
///
/// What [`Mode::Faithful`] keeps of the released code, besides what [`rare::pose::PoseChoice`] and
/// [`rare::pose::spread_seeds`] say:
/// * the nearest in feature space of all correspondences is taken for the seed itself and left out, even if it is another
///   one with the same feature,
/// * in [`PointDscConfig::kitti`], the demo's inlier threshold.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PointDscConfig {
    /// How a pose is made of confidences and features.
    pub consensus: SeedConsensus,
}

impl PointDscConfig {
    /// The released settings for 3DMatch and 3DLoMatch.
    #[must_use]
    pub fn three_d_match(mode: Mode) -> PointDscConfig {
        PointDscConfig { consensus: SeedConsensus::three_d_match(mode) }
    }

    /// The released settings for KITTI: seeds 0.6 m apart, an inlier threshold of 0.6 m, polishing with 1.2 m.
    ///
    /// [`Mode::Faithful`] takes the 0.10 m that the released demo runs with on KITTI, too, where the inlier threshold was
    /// forgotten; the released evaluation passes 0.6 m.
    #[must_use]
    pub fn kitti(mode: Mode) -> PointDscConfig {
        let mut consensus = SeedConsensus::three_d_match(mode);
        consensus.suppression_radius = 0.6;
        if mode == Mode::Fixed {
            consensus.choice.inlier_threshold = 0.6;
            consensus.choice.polish_threshold = 1.2;
        }
        PointDscConfig { consensus }
    }
}

/// PointDSC with its weights.
pub struct PointDsc {
    network: Network,
    config: PointDscConfig,
}

/// What PointDSC says of correspondences.
#[derive(Debug, Clone, PartialEq)]
pub struct PointDscEncoding {
    /// A row of 128 numbers for each correspondence.
    pub features: Matrix,
    /// How sure the network is that each is right (a logit: above 0 for rather right).
    pub confidences: Vec<f32>,
    /// Indices of the correspondences around which poses are formed, the most confident first.
    pub seeds: Vec<usize>,
}

impl PointDsc {
    /// Takes the weights of a checkpoint, which have the names and shapes of [`layout`].
    ///
    /// # Errors
    /// `InvalidInput` if a tensor is missing, unknown, of another shape or not finite, if a width is 0 or if a setting
    /// makes no sense; `Unsupported` if the environment variable `RARE_CPU` asks for what this machine does not have.
    pub fn load(parameters: &Parameters, config: PointDscConfig) -> Result<PointDsc> {
        config.consensus.validate()?;
        let network = Network::load(parameters, CpuBackend::new(Precision::F32)?)?;
        Ok(PointDsc { network, config })
    }

    /// What the network says of the pairs (metres). `watch` is called with 0 and the first features, then with the
    /// number of each layer (1 to 12) and those after it.
    ///
    /// # Errors
    /// `NoPose` if there are fewer than three pairs; `InvalidInput` if one is not finite.
    pub fn encode(
        &self,
        pairs: &[Correspondence],
        watch: impl FnMut(usize, &Matrix),
    ) -> Result<PointDscEncoding> {
        validate_pairs(pairs)?;
        self.encode_with(pairs, &self.compatibilities(pairs), watch)
    }

    fn compatibilities(&self, pairs: &[Correspondence]) -> Compatibilities {
        Compatibilities::new(pairs, self.network.spatial_sigma)
    }

    fn encode_with(
        &self,
        pairs: &[Correspondence],
        compatibilities: &Compatibilities,
        watch: impl FnMut(usize, &Matrix),
    ) -> Result<PointDscEncoding> {
        let (features, confidences) = self.network.encode(pairs, compatibilities, watch)?;
        let seeds = self.config.consensus.seeds(pairs, &confidences);
        Ok(PointDscEncoding { features, confidences, seeds })
    }

    /// A pose around each seed; seeds that determine none are passed over. `features` have unit length.
    fn poses(
        &self,
        pairs: &[Correspondence],
        seeds: &[usize],
        features: &Matrix,
        compatibilities: &Compatibilities,
    ) -> Result<Vec<RigidTransform>> {
        let consensus = &self.config.consensus;
        let count = consensus.around(pairs.len());
        let likeness = Linear::new(&self.network.cpu, features.clone(), None)?;
        let mut poses = Vec::with_capacity(seeds.len());
        for seeds in seeds.chunks(SEEDS) {
            let rows = features.gather(seeds.iter().copied());
            let likeness = likeness.apply(&self.network.cpu, &rows)?;
            let around = seeds.par_iter().enumerate().filter_map(|(row, &seed)| {
                let members = self.neighbours(likeness.row(row), seed, count);
                let sigma = self.network.sigma;
                consensus.pose(pairs, &members, compatibilities, features, sigma)
            });
            poses.par_extend(around);
        }
        Ok(poses)
    }

    /// The correspondences most like the seed, most like it first, ties by the lowest index.
    fn neighbours(&self, likeness: &[f32], seed: usize, count: usize) -> Vec<usize> {
        let mut order: Vec<usize> = (0..likeness.len()).collect();
        let before = |&a: &usize, &b: &usize| likeness[b].total_cmp(&likeness[a]).then(a.cmp(&b));
        if count + 1 < order.len() {
            order.select_nth_unstable_by(count, before);
            order.truncate(count + 1);
        }
        order.sort_unstable_by(before);
        let itself = match self.config.consensus.choice.mode {
            Mode::Faithful => 0,
            Mode::Fixed => order.iter().position(|&other| other == seed).unwrap_or(count),
        };
        if itself < order.len() {
            order.remove(itself);
        }
        order
    }
}

impl PoseEstimator for PointDsc {
    /// Uses the pairs alone, and not their scores; `NoPose` also if no more of them agree than random ones would. The
    /// score is the share of the pairs that agree.
    fn estimate(
        &self,
        _source: &PointCloud,
        _target: &PointCloud,
        pairs: &[Correspondence],
    ) -> Result<PoseEstimate> {
        validate_pairs(pairs)?;
        let compatibilities = self.compatibilities(pairs);
        let encoding = self.encode_with(pairs, &compatibilities, |_, _| ())?;
        let PointDscEncoding { mut features, seeds, .. } = encoding;
        unit_rows(&mut features);
        let poses = self.poses(pairs, &seeds, &features, &compatibilities)?;
        let threshold = self.config.consensus.choice.inlier_threshold;
        self.config.consensus.choose(&poses, pairs, |residual| f64::from(residual < threshold))
    }
}
