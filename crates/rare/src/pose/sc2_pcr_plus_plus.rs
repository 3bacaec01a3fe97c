//! SC2-PCR++: the poses of SC2-PCR, chosen among by features and space together (Chen, Sun, Yang, Guo and Tao, TPAMI
//! 2023).
//!
//! Where few matches are right, their number tells the true pose badly. Each source keypoint therefore has a list of
//! candidates, the target keypoints with the nearest features. Under a pose, a keypoint is verified if a candidate is
//! near where it comes to lie, and of those nearby the one with the nearest feature becomes its match. The pose whose
//! new matches have the largest set consistent with one of them wins.

use nalgebra::Point3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::data::{Correspondence, PointCloud, PointFeatures, RigidTransform};
use crate::error::{Error, Result};
use crate::matching::{Match, correspondences, nearest_ranked};
use crate::pose::consensus::{self, Difference, Hypothesis, Polish};
use crate::pose::sc2_pcr::SeedPoses;
use crate::pose::{Consistency, Mode, PoseEstimate, PoseEstimator, Sc2Pcr, significance};
use crate::random::Random;

/// In faithful mode candidates may lie this many times as far off as verification allows.
const FAITHFUL_REACH: f64 = 1.5;

/// The settings of SC2-PCR++; lengths in metres.
///
/// What [`Mode::Faithful`] (the mode of `sc2_pcr`) keeps of the released code, besides the quirks of [`Sc2Pcr`]:
/// 1. before it is judged, each pose is refitted to the new matches of the pose judged before it, and only the first
///    one to the correspondences, so that the result depends on the order of the poses,
/// 2. it fails where no keypoint is verified under any pose,
/// 3. a keypoint is verified within the inlier threshold, but its new match may be 1.5 times as far off,
/// 4. keypoints are drawn with replacement.
///
/// [`Mode::Fixed`]: each pose is refitted to the correspondences, the pose of SC2-PCR is the answer where nothing is
/// verified, one threshold serves for both, no keypoint is drawn twice.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Sc2PcrPlusPlus {
    /// The settings of the stages shared with SC2-PCR.
    pub sc2_pcr: Sc2Pcr,
    /// Poses that are judged, those on which most correspondences agree (`N'_s`).
    pub hypotheses: usize,
    /// Two new matches are consistent if their lengths differ by less.
    pub consistency_threshold: f64,
    /// Candidates of each keypoint (K), for [`Sc2PcrPlusPlus::correspond`].
    pub candidates: usize,
    /// Keypoints drawn from either cloud, for [`Sc2PcrPlusPlus::correspond`]; `None` for all.
    pub keypoints: Option<usize>,
    /// Seed of that draw.
    pub seed: u64,
}

/// For each source keypoint the target keypoints that it may be.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct FeatureCandidates {
    /// Keypoints of the source, source frame, metres.
    pub source: Vec<Point3<f64>>,
    /// For each of them its candidates in the target, target frame, metres; the nearest feature first. Their order is
    /// all that counts, not the distances of the features.
    pub targets: Vec<Vec<Point3<f64>>>,
}

impl Sc2PcrPlusPlus {
    /// The released settings for 3DMatch with FPFH features.
    #[must_use]
    pub fn three_d_match_fpfh() -> Sc2PcrPlusPlus {
        Sc2PcrPlusPlus {
            sc2_pcr: Sc2Pcr { first_stage: 20, second_stage: 10, ..Sc2Pcr::three_d_match() },
            hypotheses: 50,
            consistency_threshold: 0.05,
            candidates: 100,
            keypoints: None,
            seed: 0,
        }
    }

    /// The released settings for 3DMatch with learned features (FCGF).
    #[must_use]
    pub fn three_d_match() -> Sc2PcrPlusPlus {
        Sc2PcrPlusPlus { sc2_pcr: Sc2Pcr::three_d_match(), ..Sc2PcrPlusPlus::three_d_match_fpfh() }
    }

    /// The released settings for 3DLoMatch with FCGF features: 5000 keypoints of either cloud.
    #[must_use]
    pub fn three_d_lo_match() -> Sc2PcrPlusPlus {
        Sc2PcrPlusPlus { keypoints: Some(5000), ..Sc2PcrPlusPlus::three_d_match() }
    }

    /// The released settings for 3DLoMatch with Predator features.
    #[must_use]
    pub fn three_d_lo_match_predator() -> Sc2PcrPlusPlus {
        Sc2PcrPlusPlus {
            sc2_pcr: Sc2Pcr { first_stage: 60, second_stage: 50, ..Sc2Pcr::three_d_lo_match() },
            ..Sc2PcrPlusPlus::three_d_match()
        }
    }

    /// The released settings for KITTI: 8000 keypoints of either cloud.
    #[must_use]
    pub fn kitti() -> Sc2PcrPlusPlus {
        Sc2PcrPlusPlus {
            sc2_pcr: Sc2Pcr {
                suppression_radius: 0.3,
                power_iterations: 10,
                first_stage: 40,
                second_stage: 30,
                ..Sc2Pcr::kitti()
            },
            consistency_threshold: 0.1,
            keypoints: Some(8000),
            ..Sc2PcrPlusPlus::three_d_match()
        }
    }

    /// The settings of 3DMatch with FPFH features (where clouds are sampled at 0.05 m) scaled to clouds sampled at
    /// `voxel` metres.
    #[must_use]
    pub fn for_voxel(voxel: f64) -> Sc2PcrPlusPlus {
        Sc2PcrPlusPlus {
            sc2_pcr: Sc2Pcr { first_stage: 20, second_stage: 10, ..Sc2Pcr::for_voxel(voxel) },
            consistency_threshold: voxel,
            ..Sc2PcrPlusPlus::three_d_match_fpfh()
        }
    }

    /// Draws keypoints, finds the candidates of each in the target, and takes the nearest as correspondences. Features
    /// are compared as they are; the released code gives them unit length first ([`PointFeatures::normalised`]).
    ///
    /// # Errors
    /// `InvalidInput` if the features differ in dimension or the dimension is 0.
    pub fn correspond(
        &self,
        source: &PointFeatures,
        target: &PointFeatures,
    ) -> Result<(Vec<Correspondence>, FeatureCandidates)> {
        let (source, target) = (self.drawn(source, 0), self.drawn(target, 1));
        let ranked = nearest_ranked(&source, &target, self.candidates.max(1))?;
        let first: Vec<Match> = ranked.iter().filter_map(|row| row.first().copied()).collect();
        let pairs = correspondences(&source, &target, &first, 1);
        Ok((pairs, FeatureCandidates::new(&source, &target, &ranked)))
    }

    fn drawn(&self, features: &PointFeatures, stream: u64) -> PointFeatures {
        let (available, mut random) = (features.len(), Random::new(self.seed, stream));
        match (self.keypoints.filter(|&count| count < available), self.sc2_pcr.mode) {
            (None, _) => features.clone(),
            (Some(count), Mode::Fixed) => features.select(&random.sample(count, available)),
            (Some(count), Mode::Faithful) => {
                let indices: Vec<usize> = (0..count).map(|_| random.below(available)).collect();
                features.select(&indices)
            }
        }
    }

    /// The transform that moves the source of `pairs` onto their target. Its score is the largest number of new matches
    /// that are consistent with one of them.
    ///
    /// # Errors
    /// `InvalidInput` if a threshold is not positive or a pair is not finite; `NoPose` if the pairs do not determine a
    /// pose or agree no better than random ones would.
    pub fn estimate_with(
        &self,
        pairs: &[Correspondence],
        candidates: &FeatureCandidates,
    ) -> Result<PoseEstimate> {
        let threshold = self.consistency_threshold;
        if !(threshold.is_finite() && threshold > 0.0) {
            return Err(Error::invalid(format!(
                "the consistency threshold of sc2-pcr++ is {threshold}, it must be positive"
            )));
        }
        let SeedPoses { mut poses, seeds, pairs: used } = self.sc2_pcr.seed_poses(pairs)?;
        poses.sort_by(|a, b| b.score.total_cmp(&a.score));
        poses.truncate(self.hypotheses.max(1));
        let Some(most_agreed) = poses.first() else {
            return Err(self.sc2_pcr.nothing_consistent(pairs));
        };
        let weighed = consensus::weighed(pairs, self.sc2_pcr.use_scores);
        let leaders = self.judged(&poses, &weighed, candidates);
        let best = match (leaders.first(), self.sc2_pcr.mode) {
            (Some(best), _) => *best,
            (None, Mode::Fixed) => Hypothesis { score: 0.0, ..*most_agreed },
            (None, Mode::Faithful) => {
                return Err(Error::no_pose("under no pose is any keypoint near a candidate"));
            }
        };
        let target_from_source = self.sc2_pcr.polish().run(best.target_from_source, &weighed);
        let inlier_threshold = self.sc2_pcr.inlier_threshold;
        significance::require(&target_from_source, pairs, inlier_threshold)?;
        Ok(PoseEstimate {
            target_from_source,
            inliers: consensus::inliers(&target_from_source, pairs, inlier_threshold),
            score: best.score,
            runner_up: leaders.get(1).map(|other| other.score),
            iterations: seeds,
            budget_exhausted: used.len() < pairs.len(),
        })
    }

    /// The two best poses that differ, scored by the consistency of their new matches.
    fn judged(
        &self,
        poses: &[Hypothesis],
        pairs: &[Correspondence],
        candidates: &FeatureCandidates,
    ) -> Vec<Hypothesis> {
        let polish = Polish { rounds: 1, ..self.sc2_pcr.polish() };
        let threshold = self.sc2_pcr.inlier_threshold;
        let mut leaders = Leaders {
            difference: Difference::new(pairs, 2.0 * threshold),
            threshold: self.consistency_threshold,
            best: Vec::new(),
        };
        match self.sc2_pcr.mode {
            Mode::Fixed => {
                let rematch = |start: &Hypothesis| {
                    let pose = polish.run(start.target_from_source, pairs);
                    (pose, candidates.rematched(&pose, threshold, threshold))
                };
                let mut rematched: Vec<_> = poses.par_iter().map(rematch).collect();
                // With the most matches first, later ones can often be passed over.
                rematched.sort_by_key(|(_, matches)| std::cmp::Reverse(matches.len()));
                rematched.iter().for_each(|(pose, matches)| leaders.challenge(pose, matches));
            }
            Mode::Faithful => {
                let mut refit_to = pairs.to_vec();
                for start in poses {
                    let pose = polish.run(start.target_from_source, &refit_to);
                    let matches =
                        candidates.rematched(&pose, threshold, FAITHFUL_REACH * threshold);
                    leaders.challenge(&pose, &matches);
                    if !matches.is_empty() {
                        refit_to = matches;
                    }
                }
            }
        }
        leaders.best
    }
}

impl PoseEstimator for Sc2PcrPlusPlus {
    /// Uses the pairs alone: with no features, the match of each keypoint is its only candidate. With features, see
    /// [`Sc2PcrPlusPlus::estimate_with`].
    fn estimate(
        &self,
        _source: &PointCloud,
        _target: &PointCloud,
        pairs: &[Correspondence],
    ) -> Result<PoseEstimate> {
        self.estimate_with(pairs, &FeatureCandidates::of_pairs(pairs))
    }
}

impl FeatureCandidates {
    /// The candidates that [`nearest_ranked`] found; indices out of range are passed over.
    #[must_use]
    pub fn new(
        source: &PointFeatures,
        target: &PointFeatures,
        ranked: &[Vec<Match>],
    ) -> FeatureCandidates {
        let point = |found: &Match| target.points().get(found.target_index).copied();
        let targets = ranked.iter().map(|row| row.iter().filter_map(point).collect()).collect();
        FeatureCandidates { source: source.points().to_vec(), targets }
    }

    /// One candidate for each pair, its own target.
    #[must_use]
    pub fn of_pairs(pairs: &[Correspondence]) -> FeatureCandidates {
        FeatureCandidates {
            source: pairs.iter().map(|pair| pair.source).collect(),
            targets: pairs.iter().map(|pair| vec![pair.target]).collect(),
        }
    }

    /// The first candidate within `reach` (metres) of each keypoint that has one within `verified`, under the pose.
    fn rematched(&self, pose: &RigidTransform, verified: f64, reach: f64) -> Vec<Correspondence> {
        let (verified, reach) = (verified * verified, reach * reach);
        let rematch = |(source, targets): (&Point3<f64>, &Vec<Point3<f64>>)| {
            let moved = pose.apply(source);
            let distance = |target: &&Point3<f64>| (*target - moved).norm_squared();
            let near = targets.iter().position(|target| distance(&target) <= reach)?;
            let is_verified = targets[near..].iter().any(|target| distance(&target) <= verified);
            let target = targets[near];
            is_verified.then_some(Correspondence { source: *source, target, score: 1.0 })
        };
        self.source.iter().zip(&self.targets).filter_map(rematch).collect()
    }
}

/// The two best poses so far that differ.
struct Leaders {
    difference: Difference,
    threshold: f64,
    best: Vec<Hypothesis>,
}

impl Leaders {
    /// Takes in the pose if its matches are better than those of a leader. Earlier poses win ties.
    fn challenge(&mut self, pose: &RigidTransform, matches: &[Correspondence]) {
        if matches.is_empty() || !self.can_win(pose, matches.len() as f64) {
            return;
        }
        let [graph] = Consistency::new(matches).graphs([self.threshold]);
        let degree = |i| graph.row(i).iter().map(|word| word.count_ones()).sum::<u32>();
        let score = (0..graph.len()).map(degree).max().map_or(0.0, f64::from);
        self.best.push(Hypothesis { target_from_source: *pose, score });
        self.best = self.difference.best(std::mem::take(&mut self.best), 2);
    }

    /// Whether a pose with so many matches can still displace a leader: no match is consistent with more than all.
    fn can_win(&self, pose: &RigidTransform, matches: f64) -> bool {
        let differs =
            |leader: &Hypothesis| self.difference.between(&leader.target_from_source, pose);
        let beaten = |leader: &Hypothesis| !differs(leader) && leader.score >= matches;
        let is_behind = self.best.get(1).is_some_and(|second| second.score >= matches);
        !is_behind && !self.best.iter().any(beaten)
    }
}
