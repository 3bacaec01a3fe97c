//! Random sample consensus over correspondences (Fischler and Bolles 1981) with local optimisation (Chum, Matas and
//! Kittler 2003).
//!
//! Iteration `i` draws from stream `i` of the seed, and the best poses are compared in blocks of fixed size, so that
//! the result is the same for any number of threads. Poses are scored by the correspondences that agree, not by a
//! search over the clouds.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::data::{Correspondence, PointCloud};
use crate::error::{Error, Result};
use crate::pose::consensus::{self, Difference, Hypothesis, Keep, Polish};
use crate::pose::{PoseEstimate, PoseEstimator, fit_weighted, significance};
use crate::random::Random;

/// Iterations between two looks at the stopping rule; independent of the number of threads.
const BLOCK: usize = 1024;

/// The settings of RANSAC; lengths in metres.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Ransac {
    /// A correspondence agrees with a pose if its residual is smaller.
    pub inlier_threshold: f64,
    /// Correspondences per sample, at least 3.
    pub sample_size: usize,
    /// Samples drawn at most.
    pub max_iterations: usize,
    /// The search ends when an all-inlier sample has been drawn with this probability (0 to 1; at 1 it never ends early).
    pub confidence: f64,
    /// A sample is dropped before it is fitted if the shorter of two corresponding edges is below this share of the longer one; 0
    /// to keep all.
    pub edge_ratio: f64,
    /// Rounds of re-weighted fits on the inliers of a new best pose, at most.
    pub polish_rounds: usize,
    /// Whether the scores of the correspondences weigh in scores and fits.
    pub use_scores: bool,
    /// Seed of all draws.
    pub seed: u64,
}

impl Ransac {
    /// Indoor fragments sampled at 5 cm: agreement within 10 cm.
    #[must_use]
    pub fn three_d_match() -> Ransac {
        Ransac {
            inlier_threshold: 0.10,
            sample_size: 3,
            max_iterations: 50_000,
            confidence: 0.999,
            edge_ratio: 0.9,
            polish_rounds: 20,
            use_scores: false,
            seed: 0,
        }
    }

    /// Outdoor scans sampled at 30 cm: agreement within 60 cm.
    #[must_use]
    pub fn kitti() -> Ransac {
        Ransac { inlier_threshold: 0.6, ..Ransac::three_d_match() }
    }

    /// Clouds sampled at `voxel` metres: agreement within two voxels.
    #[must_use]
    pub fn for_voxel(voxel: f64) -> Ransac {
        Ransac { inlier_threshold: 2.0 * voxel, ..Ransac::three_d_match() }
    }

    fn validate(&self) -> Result<()> {
        let positive = self.inlier_threshold.is_finite() && self.inlier_threshold > 0.0;
        if !positive || self.sample_size < 3 || self.max_iterations == 0 {
            return Err(Error::invalid(format!(
                "ransac needs a positive inlier threshold, samples of at least 3 and at least 1 iteration, got {} m, {} and {}",
                self.inlier_threshold, self.sample_size, self.max_iterations
            )));
        }
        Ok(())
    }

    /// The pose of the sample that iteration `iteration` draws, unless its edges disagree or it is degenerate.
    fn draw(
        &self,
        iteration: usize,
        pairs: &[Correspondence],
        sample: &mut Vec<usize>,
    ) -> Option<Hypothesis> {
        let mut random = Random::new(self.seed, iteration as u64);
        // Floyd's algorithm: different indices in as many draws.
        sample.clear();
        for last in pairs.len() - self.sample_size..pairs.len() {
            let index = random.below(last + 1);
            sample.push(if sample.contains(&index) { last } else { index });
        }
        if !self.edges_agree(sample, pairs) {
            return None;
        }
        let members = sample.iter().map(|&i| (pairs[i].source, pairs[i].target, 1.0));
        let pose = fit_weighted(members).ok()?;
        Some(Hypothesis::new(pose, pairs, self.inlier_threshold))
    }

    fn edges_agree(&self, sample: &[usize], pairs: &[Correspondence]) -> bool {
        sample.iter().enumerate().all(|(at, &i)| {
            sample[..at].iter().all(|&j| {
                let source = (pairs[i].source - pairs[j].source).norm();
                let target = (pairs[i].target - pairs[j].target).norm();
                source.min(target) >= self.edge_ratio * source.max(target)
            })
        })
    }

    /// How many samples it takes to draw one of inliers alone with the wanted confidence.
    fn enough(&self, inliers: usize, count: usize) -> f64 {
        let hit = (inliers as f64 / count as f64).powi(self.sample_size as i32);
        (1.0 - self.confidence).ln() / (1.0 - hit).ln()
    }

    /// Draws until the stopping rule or the budget ends it; returns the two best different poses and the iterations.
    fn search(&self, pairs: &[Correspondence]) -> (Vec<Hypothesis>, usize, bool) {
        let difference = Difference::new(pairs, 2.0 * self.inlier_threshold);
        let polish = Polish {
            threshold: self.inlier_threshold,
            rounds: self.polish_rounds,
            keep: Keep::Best,
        };
        let mut leaders: Vec<Hypothesis> = Vec::new();
        let mut iterations = 0;
        while iterations < self.max_iterations {
            let end = self.max_iterations.min(iterations + BLOCK);
            let drawn: Vec<Hypothesis> = (iterations..end)
                .into_par_iter()
                .map_init(Vec::new, |sample, iteration| self.draw(iteration, pairs, sample))
                .flatten_iter()
                .collect();
            iterations = end;
            let before = leaders.first().map_or(0.0, |best| best.score);
            leaders.extend(drawn);
            leaders = difference.best(leaders, 2);
            let Some(best) = leaders.first().copied() else { continue };
            if best.score > before {
                let polished = polish.run(best.target_from_source, pairs);
                leaders.push(Hypothesis::new(polished, pairs, self.inlier_threshold));
                leaders = difference.best(leaders, 2);
            }
            let best = &leaders[0].target_from_source;
            let inliers = consensus::inliers(best, pairs, self.inlier_threshold).len();
            if iterations as f64 >= self.enough(inliers, pairs.len()) {
                return (leaders, iterations, false);
            }
        }
        (leaders, iterations, true)
    }
}

impl PoseEstimator for Ransac {
    /// Uses the pairs alone; `NoPose` also if no more of them agree than random ones would.
    fn estimate(
        &self,
        _source: &PointCloud,
        _target: &PointCloud,
        pairs: &[Correspondence],
    ) -> Result<PoseEstimate> {
        self.validate()?;
        consensus::validate(pairs)?;
        if pairs.len() < self.sample_size {
            return Err(Error::no_pose(format!(
                "a sample needs {} correspondences, there are {}",
                self.sample_size,
                pairs.len()
            )));
        }
        let weighed = consensus::weighed(pairs, self.use_scores);
        let (leaders, iterations, budget_exhausted) = self.search(&weighed);
        let Some(best) = leaders.first() else {
            return Err(Error::no_pose(format!(
                "none of {iterations} samples of {} correspondences had matching edges",
                pairs.len()
            )));
        };
        significance::require(&best.target_from_source, pairs, self.inlier_threshold)?;
        Ok(PoseEstimate {
            target_from_source: best.target_from_source,
            inliers: consensus::inliers(&best.target_from_source, pairs, self.inlier_threshold),
            score: best.score,
            runner_up: leaders.get(1).map(|other| other.score),
            iterations,
            budget_exhausted,
        })
    }
}
