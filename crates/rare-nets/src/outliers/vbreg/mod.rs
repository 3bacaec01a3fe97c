//! VBReg: a network whose attention comes from beliefs that are inferred layer by layer (Jiang, Dang, Wei, Xie, Yang and
//! Salzmann, CVPR 2023).
//!
//! Confident, well spread correspondences are seeds, as with PointDSC; which others belong to a seed is decided by the
//! votes of all layers.

mod beliefs;
mod network;
mod voting;

use rare::pose::{Mode, PoseEstimate, PoseEstimator, validate_pairs};
use rare::{Correspondence, Error, PointCloud, Result, RigidTransform};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

pub use network::layout;

use super::compatibility::Compatibilities;
use super::seed_consensus::SeedConsensus;
use crate::Matrix;
use crate::checkpoint::Parameters;
use crate::engine::{CpuBackend, Precision};
use crate::layers::unit_rows;
use network::{Encoded, Network, Record};
use voting::Votes;

/// Seeds whose votes are counted together.
const SEEDS: usize = 32;

/// The settings of VBReg. The widths of the compatibilities are parameters of the network.
///
/// What [`Mode::Faithful`] keeps of the released code, besides what [`rare::pose::PoseChoice`] and
/// [`rare::pose::spread_seeds`] say:
/// * where fewer correspondences than get a vote have to do with a seed, unrelated ones get the rest of the votes (those
///   with the lowest indices, where the released code takes any),
/// * in [`VbregConfig::kitti`], seeds 0.1 m apart, which on clouds thinned to 0.3 m suppresses none.
///
/// [`Mode::Fixed`]: only those related to the seed get votes and belong to it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct VbregConfig {
    /// How a pose is made of confidences and features.
    pub consensus: SeedConsensus,
    /// Seed of the random numbers by which states are sampled, as the released code does at every run; `None` for the
    /// means of the states, so that the result is always the same.
    pub noise: Option<u64>,
}

impl VbregConfig {
    /// The released settings for 3DMatch and 3DLoMatch.
    #[must_use]
    pub fn three_d_match(mode: Mode) -> VbregConfig {
        let consensus = SeedConsensus { least_seeds: 1000, ..SeedConsensus::three_d_match(mode) };
        VbregConfig { consensus, noise: None }
    }

    /// The released settings for KITTI: an inlier threshold of 1.2 m. [`Mode::Fixed`] keeps seeds 0.6 m apart.
    #[must_use]
    pub fn kitti(mode: Mode) -> VbregConfig {
        let mut config = VbregConfig::three_d_match(mode);
        config.consensus.choice.inlier_threshold = 1.2;
        config.consensus.choice.polish_threshold = 1.2;
        if mode == Mode::Fixed {
            config.consensus.suppression_radius = 0.6;
        }
        config
    }
}

/// VBReg with its weights.
pub struct Vbreg {
    network: Network,
    config: VbregConfig,
}

/// What VBReg says of correspondences.
#[derive(Debug, Clone, PartialEq)]
pub struct VbregEncoding {
    /// A row of 128 numbers for each correspondence.
    pub features: Matrix,
    /// How sure the network is that each is right (a logit: above 0 for rather right).
    pub confidences: Vec<f32>,
    /// Indices of the correspondences around which poses are formed, the most confident first.
    pub seeds: Vec<usize>,
    /// For each seed the correspondences from which its pose is made, the seed first.
    pub consensus: Vec<Vec<usize>>,
    /// For each seed its pose, and the mean over all pairs of `1 - d^2 / threshold^2` (0 beyond the threshold), where `d` is
    /// the residual; `None` where they determine none.
    pub poses: Vec<Option<(RigidTransform, f64)>>,
}

impl Vbreg {
    /// Takes the weights of a checkpoint, which have the names and shapes of [`layout`].
    ///
    /// # Errors
    /// `InvalidInput` if a tensor is missing, unknown, of another shape or not finite, if a width is 0 or if a setting
    /// makes no sense; `Unsupported` if the environment variable `RARE_CPU` asks for what this machine does not have.
    pub fn load(parameters: &Parameters, config: VbregConfig) -> Result<Vbreg> {
        config.consensus.validate()?;
        let network = Network::load(parameters, CpuBackend::new(Precision::F32)?)?;
        Ok(Vbreg { network, config })
    }

    /// What the network says of the pairs (metres), and what the votes make of it.
    ///
    /// # Errors
    /// `NoPose` if there are fewer than three pairs; `InvalidInput` if one is not finite.
    pub fn encode(&self, pairs: &[Correspondence]) -> Result<VbregEncoding> {
        let (Encoded { features, confidences, records }, compatibilities) = self.encoded(pairs)?;
        let consensus_of = &self.config.consensus;
        let seeds = consensus_of.seeds(pairs, &confidences);
        let votes = self.votes(pairs, &records, &compatibilities);
        let count = consensus_of.around(pairs.len());
        let consensus: Vec<Vec<Vec<usize>>> = (seeds.par_chunks(SEEDS))
            .map(|seeds| votes.consensus(seeds, count))
            .collect::<Result<_>>()?;
        let consensus = consensus.concat();
        let mut unit = features.clone();
        unit_rows(&mut unit);
        let sigma = self.network.sigma;
        let poses = (consensus.par_iter())
            .map(|members| {
                let pose = consensus_of.pose(pairs, members, &compatibilities, &unit, sigma)?;
                Some((pose, self.fitness(&pose, pairs)))
            })
            .collect();
        Ok(VbregEncoding { features, confidences, seeds, consensus, poses })
    }

    /// The attention of some correspondences to all others in a layer (0 to 11): a row of its softmax for each, 0 for
    /// itself.
    ///
    /// # Errors
    /// Those of [`Vbreg::encode`]; `InvalidInput` if there is no such layer or correspondence.
    pub fn attention(
        &self,
        pairs: &[Correspondence],
        layer: usize,
        rows: &[usize],
    ) -> Result<Vec<Vec<f32>>> {
        let (Encoded { records, .. }, compatibilities) = self.encoded(pairs)?;
        let record = records
            .get(layer)
            .filter(|_| rows.iter().all(|&row| row < pairs.len()))
            .ok_or_else(|| Error::invalid(format!("no layer {layer} or no rows {rows:?}")))?;
        let votes = self.votes(pairs, &records, &compatibilities);
        Ok(rows.iter().map(|&row| votes.attention(record, row)).collect())
    }

    fn encoded(&self, pairs: &[Correspondence]) -> Result<(Encoded, Compatibilities)> {
        validate_pairs(pairs)?;
        let compatibilities = Compatibilities::new(pairs, self.network.spatial_sigma);
        let encoded = self.network.encode(pairs, &compatibilities, self.config.noise)?;
        Ok((encoded, compatibilities))
    }

    fn votes<'a>(
        &'a self,
        pairs: &[Correspondence],
        records: &'a [Record],
        compatibilities: &'a Compatibilities,
    ) -> Votes<'a> {
        let (cpu, mode) = (&self.network.cpu, self.config.consensus.choice.mode);
        Votes { cpu, compatibilities, records, pairs: pairs.len(), mode }
    }

    fn fitness(&self, pose: &RigidTransform, pairs: &[Correspondence]) -> f64 {
        self.config.consensus.mean(pose, pairs, |residual| self.agreement(residual))
    }

    /// How much a pair with this residual (metres) agrees, 0 to 1.
    fn agreement(&self, residual: f64) -> f64 {
        let ratio = residual / self.config.consensus.choice.inlier_threshold;
        (1.0 - ratio * ratio).max(0.0)
    }
}

impl PoseEstimator for Vbreg {
    /// Uses the pairs alone, and not their scores; `NoPose` also if no more of them agree than random ones would. The
    /// score is the mean agreement of all pairs (see [`VbregEncoding::poses`]).
    fn estimate(
        &self,
        _source: &PointCloud,
        _target: &PointCloud,
        pairs: &[Correspondence],
    ) -> Result<PoseEstimate> {
        let poses = self.encode(pairs)?.poses;
        let poses: Vec<RigidTransform> = poses.iter().flatten().map(|(pose, _)| *pose).collect();
        self.config.consensus.choose(&poses, pairs, |residual| self.agreement(residual))
    }
}
