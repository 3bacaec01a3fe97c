//! From confidences to a pose: seeds, a pose around each, the best of them.

use rare::pose::{Mode, PoseChoice, PoseEstimate, fit_weighted, leading_eigenvector, spread_seeds};
use rare::{Correspondence, Error, Result, RigidTransform};
use serde::{Deserialize, Serialize};

use super::compatibility::Compatibilities;
use crate::Matrix;

/// How a pose is made of confidences and features; lengths in metres.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct SeedConsensus {
    /// No two seeds are closer in the source than this, unless they are equally confident.
    pub suppression_radius: f64,
    /// Seeds per correspondence.
    pub seed_ratio: f64,
    /// At least so many seeds, if there are as many correspondences.
    pub least_seeds: usize,
    /// Correspondences around a seed from which its pose is made (k).
    pub neighbours: usize,
    /// Products of each power iteration, at most.
    pub power_iterations: usize,
    /// How the best pose is chosen and polished.
    pub choice: PoseChoice,
}

impl SeedConsensus {
    /// The released settings for 3DMatch, but for the least number of seeds, which is 1.
    pub(crate) fn three_d_match(mode: Mode) -> SeedConsensus {
        SeedConsensus {
            suppression_radius: 0.10,
            seed_ratio: 0.1,
            least_seeds: 1,
            neighbours: 40,
            power_iterations: 10,
            choice: PoseChoice {
                inlier_threshold: 0.10,
                polish_threshold: 0.10,
                polish_rounds: 20,
                mode,
            },
        }
    }

    /// Fails unless the settings make sense.
    pub(crate) fn validate(&self) -> Result<()> {
        for (name, value) in
            [("suppression radius", self.suppression_radius), ("seed ratio", self.seed_ratio)]
        {
            if !(value.is_finite() && value > 0.0) {
                return Err(Error::invalid(format!("the {name} is {value}, it must be positive")));
            }
        }
        Ok(())
    }

    /// How many correspondences are taken around each seed of so many.
    pub(crate) fn around(&self, pairs: usize) -> usize {
        self.neighbours.min(pairs.saturating_sub(1))
    }

    /// Indices of the seeds, the most confident first.
    pub(crate) fn seeds(&self, pairs: &[Correspondence], confidences: &[f32]) -> Vec<usize> {
        let points: Vec<_> = pairs.iter().map(|pair| pair.source).collect();
        let scores: Vec<f64> = confidences.iter().map(|&score| f64::from(score)).collect();
        let count = ((self.seed_ratio * pairs.len() as f64) as usize).max(self.least_seeds);
        spread_seeds(&points, &scores, self.suppression_radius, count, self.choice.mode)
    }

    /// The pose of some correspondences that should belong together, weighted by the leading eigenvector of how
    /// compatible they are in space and features (rows of unit length; `sigma` is their width). `None` if they determine
    /// none.
    pub(crate) fn pose(
        &self,
        pairs: &[Correspondence],
        members: &[usize],
        compatibilities: &Compatibilities,
        features: &Matrix,
        sigma: f32,
    ) -> Option<RigidTransform> {
        let size = members.len();
        let mut matrix = vec![0.0; size * size];
        for (a, &i) in members.iter().enumerate() {
            for (b, &j) in members[..a].iter().enumerate() {
                let likeness = similarity(dot(features.row(i), features.row(j)), sigma).max(0.0);
                let value = f64::from(likeness * compatibilities.between(i, j));
                matrix[a * size + b] = value;
                matrix[b * size + a] = value;
            }
        }
        let weights = leading_eigenvector(size, self.power_iterations, |vector, product| {
            for (product, row) in product.iter_mut().zip(matrix.chunks_exact(size.max(1))) {
                *product = row.iter().zip(vector).map(|(a, b)| a * b).sum();
            }
        });
        let weighted = (members.iter().zip(weights))
            .filter_map(|(&i, weight)| pairs.get(i).map(|pair| (pair.source, pair.target, weight)));
        fit_weighted(weighted).ok()
    }

    /// The best of the poses by `score`, polished.
    ///
    /// # Errors
    /// `NoPose` if there are no poses or the best agrees with no more pairs than random ones would.
    pub(crate) fn choose(
        &self,
        poses: &[RigidTransform],
        pairs: &[Correspondence],
        score: impl Fn(f64) -> f64,
    ) -> Result<PoseEstimate> {
        self.choice.choose(poses, pairs, |pose| self.mean(pose, pairs, &score))
    }

    /// The mean of `score` over the residuals (metres) of all pairs.
    pub(crate) fn mean(
        &self,
        pose: &RigidTransform,
        pairs: &[Correspondence],
        score: impl Fn(f64) -> f64,
    ) -> f64 {
        let residual = |pair: &Correspondence| (pose.apply(&pair.source) - pair.target).norm();
        let sum: f64 = pairs.iter().map(|pair| score(residual(pair))).sum();
        sum / pairs.len().max(1) as f64
    }
}

/// `1 - (1 - a . b) / sigma^2` of the inner product `a . b` of two features of unit length.
pub(crate) fn similarity(product: f32, sigma: f32) -> f32 {
    1.0 - (1.0 - product) / (sigma * sigma)
}

/// The inner product, summed up in sixteen parts.
pub(crate) fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut sums = [0.0; 16];
    let (a, a_tail) = a.as_chunks::<16>();
    let (b, b_tail) = b.as_chunks::<16>();
    for (a, b) in a.iter().zip(b) {
        sums.iter_mut().zip(a.iter().zip(b)).for_each(|(sum, (a, b))| *sum += a * b);
    }
    let tail: f32 = a_tail.iter().zip(b_tail).map(|(a, b)| a * b).sum();
    sums.iter().sum::<f32>() + tail
}
