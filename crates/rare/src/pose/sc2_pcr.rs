//! SC2-PCR: a second-order spatial compatibility measure finds consistent seeds (Chen, Sun, Yang and Tao, CVPR 2022).
//!
//! Two correspondences are compatible if they keep their distance; the number of correspondences compatible with both
//! tells inliers from coincidences far better than compatibility alone. Reliable, well spread correspondences become
//! seeds; around each one the most compatible others give a pose; the pose that most pairs agree with is polished.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::data::{Correspondence, PointCloud};
use crate::error::{Error, Result};
use crate::pose::consensus::{self, Difference, Hypothesis, Keep, Polish};
use crate::pose::consistency::SoftMatrix;
use crate::pose::significance;
use crate::pose::{
    CompatibilityGraph, Consistency, Mode, PoseEstimate, PoseEstimator, fit_weighted,
    leading_eigenvector, spread_seeds,
};

/// The settings of SC2-PCR; lengths in metres.
///
/// What [`Mode::Faithful`] keeps of the released code:
/// * seeds are filled up to their exact number with correspondences that are no local maxima,
/// * a longer set is cut to its first `max_points` in input order,
/// * the polishing returns its last pose, even if an earlier one was better,
/// * with fewer than `first_stage` correspondences, both stages keep 4.
///
/// [`Mode::Fixed`]: local maxima alone are seeds, a longer set keeps its best-scored correspondences, the polishing
/// returns its best pose, small sets use all they have.
///
/// In both modes the polishing threshold is a setting; the released code takes 0.10 m if the inlier threshold is exactly
/// that and 1.2 m otherwise. Not kept in either mode, below a millionth: weights are divided by their sum plus `1e-6`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Sc2Pcr {
    /// A correspondence agrees with a pose if its residual is smaller (tau).
    pub inlier_threshold: f64,
    /// Two correspondences are compatible if their lengths differ by less (`d_thre`).
    pub compatibility_threshold: f64,
    /// No two seeds are closer in the source than this, unless their confidences are equal.
    pub suppression_radius: f64,
    /// Seeds per correspondence.
    pub seed_ratio: f64,
    /// Products of each power iteration, at most.
    pub power_iterations: usize,
    /// Correspondences kept around a seed by the second-order measure over all (k1).
    pub first_stage: usize,
    /// Correspondences kept of those by the measure among themselves (k2).
    pub second_stage: usize,
    /// At most so many correspondences are used for seeds and scores.
    pub max_points: usize,
    /// The final polishing uses correspondences with a smaller residual.
    pub polish_threshold: f64,
    /// Rounds of the final polishing, at most.
    pub polish_rounds: usize,
    /// Whether the scores of the correspondences weigh in confidences and fits; the paper ignores them.
    pub use_scores: bool,
    /// Whether the quirks of the released code (above) are kept.
    pub mode: Mode,
}

impl Sc2Pcr {
    /// The released settings for 3DMatch.
    #[must_use]
    pub fn three_d_match() -> Sc2Pcr {
        Sc2Pcr {
            inlier_threshold: 0.10,
            compatibility_threshold: 0.10,
            suppression_radius: 0.10,
            seed_ratio: 0.2,
            power_iterations: 10,
            first_stage: 30,
            second_stage: 20,
            max_points: 8000,
            polish_threshold: 0.10,
            polish_rounds: 20,
            use_scores: false,
            mode: Mode::Fixed,
        }
    }

    /// The released settings for 3DLoMatch: those for 3DMatch.
    #[must_use]
    pub fn three_d_lo_match() -> Sc2Pcr {
        Sc2Pcr::three_d_match()
    }

    /// The released settings for KITTI. The compatibility threshold is the 0.1 m of the released configuration, though
    /// the inlier threshold is 0.6 m; the polishing threshold is its 1.2 m.
    #[must_use]
    pub fn kitti() -> Sc2Pcr {
        Sc2Pcr {
            inlier_threshold: 0.6,
            suppression_radius: 0.6,
            power_iterations: 20,
            polish_threshold: 1.2,
            ..Sc2Pcr::three_d_match()
        }
    }

    /// The settings of 3DMatch (where clouds are sampled at 0.05 m) scaled to clouds sampled at `voxel` metres: all
    /// thresholds are two voxels.
    #[must_use]
    pub fn for_voxel(voxel: f64) -> Sc2Pcr {
        Sc2Pcr {
            inlier_threshold: 2.0 * voxel,
            compatibility_threshold: 2.0 * voxel,
            suppression_radius: 2.0 * voxel,
            polish_threshold: 2.0 * voxel,
            ..Sc2Pcr::three_d_match()
        }
    }

    /// The best `top` poses of which no two are alike (5 degrees, or twice the inlier threshold at the middle of the
    /// pairs), each polished, best first. Fewer, if there are no more.
    ///
    /// # Errors
    /// `InvalidInput` if a threshold is not positive or a pair is not finite; `NoPose` if there are fewer than three
    /// pairs or no three of them are consistent.
    pub fn hypotheses(&self, pairs: &[Correspondence], top: usize) -> Result<Vec<PoseEstimate>> {
        let SeedPoses { poses, seeds, pairs: pairs_used } = self.seed_poses(pairs)?;
        let pairs_used = &pairs_used;
        let difference = Difference::new(pairs_used, 2.0 * self.inlier_threshold);
        let polished = (difference.best(poses, top).into_iter())
            .map(|candidate| self.polish().run(candidate.target_from_source, pairs_used))
            .map(|pose| Hypothesis::new(pose, pairs_used, self.inlier_threshold))
            .collect();
        let best = difference.best(polished, top);
        if best.is_empty() && top > 0 {
            return Err(self.nothing_consistent(pairs));
        }
        Ok((best.iter().enumerate())
            .map(|(rank, hypothesis)| PoseEstimate {
                target_from_source: hypothesis.target_from_source,
                inliers: consensus::inliers(
                    &hypothesis.target_from_source,
                    pairs,
                    self.inlier_threshold,
                ),
                score: hypothesis.score,
                runner_up: best.get(rank + 1).map(|next| next.score),
                iterations: seeds,
                budget_exhausted: pairs_used.len() < pairs.len(),
            })
            .collect())
    }

    /// The confidences of `pairs` and the seeds: the most confident correspondences, thinned to local maxima in the
    /// source. Of more than `max_points` pairs, those that are used.
    ///
    /// # Errors
    /// As [`Sc2Pcr::hypotheses`].
    pub fn seeds(&self, pairs: &[Correspondence]) -> Result<Sc2PcrSeeds> {
        Ok(self.search(pairs)?.seeds())
    }

    /// The poses around all seeds, best seed first, unpolished and scored by the pairs that agree.
    pub(super) fn seed_poses(&self, pairs: &[Correspondence]) -> Result<SeedPoses> {
        let search = self.search(pairs)?;
        let seeds = search.seeds().indices;
        let poses = seeds.par_iter().filter_map(|&seed| search.pose_around(seed)).collect();
        Ok(SeedPoses { poses, seeds: seeds.len(), pairs: search.pairs })
    }

    pub(super) fn nothing_consistent(&self, pairs: &[Correspondence]) -> Error {
        Error::no_pose(format!(
            "no three of {} correspondences are consistent within {} m",
            pairs.len(),
            self.compatibility_threshold
        ))
    }

    fn search<'a>(&'a self, pairs: &'a [Correspondence]) -> Result<Search<'a>> {
        self.validate()?;
        consensus::validate(pairs)?;
        Ok(Search::new(self, pairs))
    }

    fn validate(&self) -> Result<()> {
        for (name, value) in [
            ("inlier threshold", self.inlier_threshold),
            ("compatibility threshold", self.compatibility_threshold),
            ("suppression radius", self.suppression_radius),
            ("seed ratio", self.seed_ratio),
            ("polish threshold", self.polish_threshold),
        ] {
            if !(value.is_finite() && value > 0.0) {
                return Err(Error::invalid(format!(
                    "the {name} of sc2-pcr is {value}, it must be positive"
                )));
            }
        }
        Ok(())
    }

    pub(super) fn polish(&self) -> Polish {
        Polish {
            threshold: self.polish_threshold,
            rounds: self.polish_rounds,
            keep: match self.mode {
                Mode::Faithful => Keep::Last,
                Mode::Fixed => Keep::Best,
            },
        }
    }
}

impl PoseEstimator for Sc2Pcr {
    /// Uses the pairs alone; `NoPose` also if no more of them agree than random ones would.
    fn estimate(
        &self,
        _source: &PointCloud,
        _target: &PointCloud,
        pairs: &[Correspondence],
    ) -> Result<PoseEstimate> {
        let best = self.hypotheses(pairs, 2)?.into_iter().next();
        let best = best.ok_or_else(|| {
            Error::Internal("sc2-pcr gave neither a pose nor an error".to_owned())
        })?;
        significance::require(&best.target_from_source, pairs, self.inlier_threshold)?;
        Ok(best)
    }
}

/// Where SC2-PCR begins: see [`Sc2Pcr::seeds`].
#[derive(Debug, Clone, PartialEq)]
pub struct Sc2PcrSeeds {
    /// How much each correspondence belongs to the largest consistent cluster, at least 0.
    pub confidences: Vec<f64>,
    /// Indices of the correspondences around which poses are formed, most confident first.
    pub indices: Vec<usize>,
}

/// What comes of the seeds.
pub(super) struct SeedPoses {
    pub(super) poses: Vec<Hypothesis>,
    /// The number of seeds; not each one gives a pose.
    pub(super) seeds: usize,
    /// The pairs that were used, with scores as they weigh.
    pub(super) pairs: Vec<Correspondence>,
}

/// The compatibilities of one set of pairs.
struct Search<'a> {
    settings: &'a Sc2Pcr,
    pairs: Vec<Correspondence>,
    consistency: Consistency,
    /// Compatible within the threshold.
    loose: CompatibilityGraph,
    /// Compatible within half of it.
    tight: CompatibilityGraph,
}

impl<'a> Search<'a> {
    fn new(settings: &'a Sc2Pcr, pairs: &'a [Correspondence]) -> Search<'a> {
        let pairs = limited(pairs, settings);
        let consistency = Consistency::new(&pairs);
        let threshold = settings.compatibility_threshold;
        let [loose, tight] = consistency.graphs([threshold, threshold / 2.0]);
        Search { settings, pairs, consistency, loose, tight }
    }

    /// The leading eigenvector of the soft compatibilities.
    fn confidences(&self) -> Vec<f64> {
        let threshold = self.settings.compatibility_threshold;
        let soft = SoftMatrix::new(&self.consistency, &self.loose, threshold);
        let rounds = self.settings.power_iterations;
        let mut confidences = leading_eigenvector(self.pairs.len(), rounds, |vector, product| {
            soft.multiply(vector, product);
        });
        for (confidence, pair) in confidences.iter_mut().zip(&self.pairs) {
            *confidence *= pair.score;
        }
        confidences
    }

    fn seeds(&self) -> Sc2PcrSeeds {
        let confidences = self.confidences();
        let points: Vec<_> = self.pairs.iter().map(|pair| pair.source).collect();
        let count = (self.settings.seed_ratio * self.pairs.len() as f64) as usize;
        let Sc2Pcr { suppression_radius, mode, .. } = *self.settings;
        let indices = spread_seeds(&points, &confidences, suppression_radius, count.max(1), mode);
        Sc2PcrSeeds { confidences, indices }
    }

    fn pose_around(&self, seed: usize) -> Option<Hypothesis> {
        let near = self.first_stage(seed);
        let kept = self.second_stage(&near);
        let weights = self.spectral_weights(&kept);
        let members = (kept.iter().zip(weights))
            .map(|(&i, weight)| (self.pairs[i].source, self.pairs[i].target, weight));
        let pose = fit_weighted(members).ok()?;
        Some(Hypothesis::new(pose, &self.pairs, self.settings.inlier_threshold))
    }

    /// The seed, then the correspondences compatible with it that share most (tight) neighbours with it.
    fn first_stage(&self, seed: usize) -> Vec<usize> {
        let (first, _) = self.stage_sizes();
        let others = (self.loose.neighbours(seed))
            .filter(|&i| i != seed)
            .map(|i| (self.tight.common(seed, i), i))
            .collect();
        let mut near = vec![seed];
        near.extend(most(others, first.saturating_sub(1)));
        near
    }

    /// Of those around a seed (which comes first), the ones that share most neighbours with it among themselves.
    fn second_stage(&self, near: &[usize]) -> Vec<usize> {
        let (_, second) = self.stage_sizes();
        let joined = |i: usize, j: usize| self.loose.contains(i, j);
        // All of them are compatible with the seed, so that every common neighbour is a neighbour.
        let degrees = (near.iter().enumerate())
            .map(|(at, &i)| (near.iter().filter(|&&j| joined(i, j)).count() as u32, at))
            .collect();
        most(degrees, second).map(|at| near[at]).collect()
    }

    /// The leading eigenvector of the soft compatibilities of a few correspondences, without their diagonal.
    fn spectral_weights(&self, kept: &[usize]) -> Vec<f64> {
        let threshold = self.settings.compatibility_threshold;
        let size = kept.len();
        let mut soft = vec![0.0; size * size];
        for i in 0..size {
            for j in 0..i {
                let value = f64::from(self.consistency.soft(kept[i], kept[j], threshold));
                soft[i * size + j] = value;
                soft[j * size + i] = value;
            }
        }
        let rounds = self.settings.power_iterations;
        let mut weights = leading_eigenvector(size, rounds, |vector, product| {
            for (product, row) in product.iter_mut().zip(soft.chunks_exact(size.max(1))) {
                *product = row.iter().zip(vector).map(|(a, b)| a * b).sum();
            }
        });
        for (weight, &i) in weights.iter_mut().zip(kept) {
            *weight *= self.pairs[i].score;
        }
        weights
    }

    fn stage_sizes(&self) -> (usize, usize) {
        let Sc2Pcr { first_stage, second_stage, mode, .. } = *self.settings;
        if mode == Mode::Faithful && first_stage > self.pairs.len() {
            (4, 4)
        } else {
            (first_stage, second_stage)
        }
    }
}

/// The items with the `count` highest numbers, highest first, ties by the lowest item.
fn most(mut numbered: Vec<(u32, usize)>, count: usize) -> impl Iterator<Item = usize> {
    let before = |a: &(u32, usize), b: &(u32, usize)| b.0.cmp(&a.0).then(a.1.cmp(&b.1));
    if count > 0 && count < numbered.len() {
        numbered.select_nth_unstable_by(count - 1, before);
    }
    numbered.truncate(count);
    numbered.sort_unstable_by(before);
    numbered.into_iter().map(|(_, item)| item)
}

/// At most `max_points` of the pairs, with scores as they weigh.
fn limited(pairs: &[Correspondence], settings: &Sc2Pcr) -> Vec<Correspondence> {
    let limit = settings.max_points;
    if settings.mode == Mode::Faithful || pairs.len() <= limit {
        return consensus::weighed(&pairs[..limit.min(pairs.len())], settings.use_scores);
    }
    let mut order: Vec<usize> = (0..pairs.len()).collect();
    order.sort_by(|&a, &b| pairs[b].score.total_cmp(&pairs[a].score));
    order.truncate(limit);
    order.sort_unstable();
    let best: Vec<Correspondence> = order.into_iter().map(|i| pairs[i]).collect();
    consensus::weighed(&best, settings.use_scores)
}
