//! Random sample consensus over correspondences (Fischler and Bolles 1981) with local optimisation (Chum, Matas and
//! Kittler 2003).
//!
//! Iteration `i` draws from stream `i` of the seed, and the best poses are compared in blocks of fixed size, so that
//! the result is the same for any number of threads. A pose is normally scored by the correspondences that agree with
//! it; scoring by a search over the clouds, as Open3D does, is an option.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::data::{Correspondence, KdTree, PointCloud, RigidTransform};
use crate::error::{Error, Result};
use crate::pose::consensus::{self, Difference, Hypothesis, Keep, Polish, residual};
use crate::pose::{Mode, PoseEstimate, PoseEstimator, fit_weighted, significance};
use crate::random::Random;

/// Iterations between two looks at the stopping rule; independent of the number of threads.
const BLOCK: usize = 1024;

/// What speaks for a pose of [`Ransac`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum RansacScore {
    /// The correspondences that agree; of equally many, their mean residual.
    #[default]
    Correspondences,
    /// The source points that have a target point within the inlier threshold; of equally many, the root mean square
    /// of the distances (the "fitness" of Open3D). Costs a search over the whole cloud for each pose, and at low
    /// overlap its best pose need not be the true one.
    CloudFitness,
}

/// The settings of RANSAC; lengths in metres.
///
/// [`Mode::Faithful`] keeps one quirk of Open3D: the correspondences of a sample are drawn with replacement, so that
/// samples can be degenerate and fewer of them are useful. [`Mode::Fixed`] draws different ones. To repeat
/// Open3D's `registration_ransac_based_on_correspondence` as closely as its own random numbers let one, also score by
/// [`RansacScore::CloudFitness`], check the sample's residuals and polish in 0 rounds.
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
    /// Whether a sample is dropped, too, if one of its own residuals is not below the inlier threshold.
    pub check_residuals: bool,
    /// What the best pose is chosen by.
    pub score: RansacScore,
    /// Rounds of re-weighted fits on the inliers of a new best pose, at most.
    pub polish_rounds: usize,
    /// Whether the scores of the correspondences weigh in scores and fits.
    pub use_scores: bool,
    /// Seed of all draws.
    pub seed: u64,
    /// Whether the quirk of Open3D (above) is kept.
    pub mode: Mode,
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
            check_residuals: false,
            score: RansacScore::Correspondences,
            polish_rounds: 20,
            use_scores: false,
            seed: 0,
            mode: Mode::Fixed,
        }
    }

    /// Indoor fragments of low overlap, sampled at 5 cm: as for 3DMatch, but up to a million samples, because one of
    /// inliers alone is rare (the papers' "RANSAC-1M").
    #[must_use]
    pub fn three_d_lo_match() -> Ransac {
        Ransac { max_iterations: 1_000_000, ..Ransac::three_d_match() }
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

    /// Different indices below `count`, or any in faithful mode.
    fn sample(&self, iteration: usize, count: usize, sample: &mut Vec<usize>) {
        let mut random = Random::new(self.seed, iteration as u64);
        sample.clear();
        match self.mode {
            Mode::Faithful => sample.extend((0..self.sample_size).map(|_| random.below(count))),
            // Floyd's algorithm: different indices in as many draws.
            Mode::Fixed => {
                for last in count - self.sample_size..count {
                    let index = random.below(last + 1);
                    sample.push(if sample.contains(&index) { last } else { index });
                }
            }
        }
    }

    /// The pose of the sample that iteration `iteration` draws, unless a check fails or it is degenerate.
    fn draw(
        &self,
        iteration: usize,
        pairs: &[Correspondence],
        sample: &mut Vec<usize>,
    ) -> Option<RigidTransform> {
        self.sample(iteration, pairs.len(), sample);
        if !self.edges_agree(sample, pairs) {
            return None;
        }
        let members = sample.iter().map(|&i| (pairs[i].source, pairs[i].target, 1.0));
        let pose = fit_weighted(members).ok()?;
        let agrees = |&i: &usize| residual(&pose, &pairs[i]) < self.inlier_threshold;
        (!self.check_residuals || sample.iter().all(agrees)).then_some(pose)
    }

    fn edges_agree(&self, sample: &[usize], pairs: &[Correspondence]) -> bool {
        sample.iter().enumerate().all(|(at, &i)| {
            sample[..at].iter().all(|&j| {
                let source = (pairs[i].source - pairs[j].source).norm_squared();
                let target = (pairs[i].target - pairs[j].target).norm_squared();
                source.min(target) >= self.edge_ratio * self.edge_ratio * source.max(target)
            })
        })
    }

    /// How many samples it takes to draw one of inliers alone with the wanted confidence.
    fn enough(&self, inliers: usize, count: usize) -> f64 {
        let hit = (inliers as f64 / count as f64).powi(self.sample_size as i32);
        (1.0 - self.confidence).ln() / (1.0 - hit).ln()
    }

    /// Draws until the stopping rule or the budget ends it.
    fn search(&self, judge: &Judge<'_>) -> Search {
        let pairs = judge.pairs;
        let difference = Difference::new(pairs, 2.0 * self.inlier_threshold);
        let mut leaders: Vec<Hypothesis> = Vec::new();
        let mut iterations = 0;
        while iterations < self.max_iterations {
            let end = self.max_iterations.min(iterations + BLOCK);
            let drawn: Vec<Hypothesis> = (iterations..end)
                .into_par_iter()
                .map_init(Vec::new, |sample, iteration| self.draw(iteration, pairs, sample))
                .flatten_iter()
                .map(|pose| judge.hypothesis(pose))
                .collect();
            iterations = end;
            let before = leaders.first().map_or(0.0, |best| best.score);
            leaders.extend(drawn);
            leaders = difference.best(leaders, 2);
            let Some(best) = leaders.first().copied() else { continue };
            if best.score > before {
                let polished = self.polish().run(best.target_from_source, pairs);
                leaders.push(judge.hypothesis(polished));
                leaders = difference.best(leaders, 2);
            }
            let best = &leaders[0].target_from_source;
            let inliers = consensus::inliers(best, pairs, self.inlier_threshold).len();
            if iterations as f64 >= self.enough(inliers, pairs.len()) {
                return Search { leaders, iterations, budget_exhausted: false };
            }
        }
        Search { leaders, iterations, budget_exhausted: true }
    }

    fn polish(&self) -> Polish {
        Polish { threshold: self.inlier_threshold, rounds: self.polish_rounds, keep: Keep::Best }
    }
}

/// What a search came to.
struct Search {
    /// The two best poses that differ.
    leaders: Vec<Hypothesis>,
    iterations: usize,
    budget_exhausted: bool,
}

/// Scores poses.
struct Judge<'a> {
    pairs: &'a [Correspondence],
    threshold: f64,
    /// The source points and the target's, if the clouds decide.
    clouds: Option<(&'a PointCloud, KdTree)>,
}

impl Judge<'_> {
    fn hypothesis(&self, pose: RigidTransform) -> Hypothesis {
        match &self.clouds {
            None => Hypothesis::new(pose, self.pairs, self.threshold),
            Some((source, target)) => {
                let score = fitness(&pose, source, target, self.threshold);
                Hypothesis { target_from_source: pose, score }
            }
        }
    }
}

/// The number of source points that have a target point within `threshold` (metres), plus a fraction (0 to 1) that is
/// the larger, the smaller the root mean square of their distances.
fn fitness(pose: &RigidTransform, source: &PointCloud, target: &KdTree, threshold: f64) -> f64 {
    let (mut count, mut sum) = (0.0, 0.0);
    for point in source.points() {
        if let Some(near) = target.nearest_within(&pose.apply(point), threshold) {
            count += 1.0;
            sum += near.squared_distance;
        }
    }
    if count > 0.0 { count + 1.0 - (sum / count).sqrt() / threshold } else { 0.0 }
}

impl PoseEstimator for Ransac {
    /// Uses the clouds only where they are what poses are scored by; `NoPose` also if no more of them agree than random ones would.
    fn estimate(
        &self,
        source: &PointCloud,
        target: &PointCloud,
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
        let clouds = match self.score {
            RansacScore::Correspondences => None,
            RansacScore::CloudFitness => Some((source, KdTree::new(target.points()))),
        };
        let weighed = consensus::weighed(pairs, self.use_scores);
        let judge = Judge { pairs: &weighed, threshold: self.inlier_threshold, clouds };
        let Search { leaders, iterations, budget_exhausted } = self.search(&judge);
        let Some(best) = leaders.first() else {
            return Err(Error::no_pose(format!(
                "none of {iterations} samples of {} correspondences had matching edges",
                pairs.len()
            )));
        };
        // The most agreed with of all poses on the way is seldom the most accurate one.
        let target_from_source = self.polish().run(best.target_from_source, &weighed);
        significance::require(&target_from_source, pairs, self.inlier_threshold)?;
        Ok(PoseEstimate {
            target_from_source,
            inliers: consensus::inliers(&target_from_source, pairs, self.inlier_threshold),
            score: judge.hypothesis(target_from_source).score,
            runner_up: leaders.get(1).map(|other| other.score),
            iterations,
            budget_exhausted,
        })
    }
}
