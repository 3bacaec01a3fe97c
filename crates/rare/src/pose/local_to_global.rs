//! Local-to-global registration: each small group of correspondences proposes a pose, all of them vote (Qin et al.,
//! "Geometric Transformer for Fast and Robust Point Cloud Registration", CVPR 2022).
//!
//! A coarse matcher that pairs patches knows which correspondences belong together. One right patch pair is enough
//! for a pose, so that no sampling is needed: as many hypotheses as groups.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::data::{Correspondence, RigidTransform};
use crate::error::{Error, Result};
use crate::pose::consensus::{self, Difference, Hypothesis, residual, weighted};
use crate::pose::{Mode, PoseEstimate, fit_weighted, significance};

/// The settings of local-to-global registration; lengths in metres.
///
/// The scores of the correspondences weigh in all fits, but not in votes; of groups with equally many votes the first
/// wins. [`Mode::Faithful`] keeps one quirk of the released code: the last fit is the result, even if more
/// correspondences agreed with an earlier pose. [`Mode::Fixed`] returns the last of those with the most votes. Not kept in either mode, below a millimetre: weights are divided by their sum plus `1e-5`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LocalToGlobal {
    /// A correspondence agrees with a pose if its residual is smaller.
    pub acceptance_radius: f64,
    /// Fits to the correspondences that agree, after the election.
    pub refinement_steps: usize,
    /// Groups of fewer correspondences propose nothing; at least 3.
    pub smallest_group: usize,
    /// Whether the quirks of the released code (above) are kept.
    pub mode: Mode,
}

impl LocalToGlobal {
    /// The released settings for 3DMatch.
    #[must_use]
    pub fn three_d_match() -> LocalToGlobal {
        LocalToGlobal {
            acceptance_radius: 0.1,
            refinement_steps: 5,
            smallest_group: 3,
            mode: Mode::Fixed,
        }
    }

    /// The released settings for 3DLoMatch: those for 3DMatch.
    #[must_use]
    pub fn three_d_lo_match() -> LocalToGlobal {
        LocalToGlobal::three_d_match()
    }

    /// The released settings for KITTI.
    #[must_use]
    pub fn kitti() -> LocalToGlobal {
        LocalToGlobal { acceptance_radius: 0.6, ..LocalToGlobal::three_d_match() }
    }

    /// Clouds sampled at `voxel` metres: agreement within two voxels.
    #[must_use]
    pub fn for_voxel(voxel: f64) -> LocalToGlobal {
        LocalToGlobal { acceptance_radius: 2.0 * voxel, ..LocalToGlobal::three_d_match() }
    }

    /// The transform that moves the source of `pairs` onto their target. Each of `groups` holds indices of pairs that
    /// are right or wrong together, such as the matches of one pair of patches. Where no group is large enough, all
    /// pairs make the first fit.
    ///
    /// # Errors
    /// `InvalidInput` if a setting makes no sense, a pair is not finite or an index is out of range; `NoPose` if the
    /// pairs do not determine a pose or agree no better than random ones would.
    ///
    /// ```
    /// use rare::nalgebra::{Point3, Rotation3, Vector3};
    /// use rare::{Correspondence, RigidTransform, pose::LocalToGlobal};
    /// let truth = RigidTransform::new(Rotation3::new(Vector3::new(0.0, 0.2, 0.0)), Vector3::x());
    /// let point = |i: i32| Point3::new(f64::from(i % 3), f64::from(i % 4), f64::from(i));
    /// let target = |i, source| if i < 6 { truth.apply(&source) } else { point(7 * i % 12) };
    /// let pairs: Vec<_> = (0..12)
    ///     .map(|i| Correspondence { source: point(i), target: target(i, point(i)), score: 0.9 })
    ///     .collect();
    /// let groups = [vec![6, 7, 8], vec![0, 1, 2, 3], vec![9, 10, 11]];
    /// let found = LocalToGlobal::three_d_match().estimate(&pairs, &groups)?;
    /// assert_eq!(found.inliers, [0, 1, 2, 3, 4, 5]);
    /// assert!(found.target_from_source.error_to(&truth).translation < 1e-9);
    /// # Ok::<(), rare::Error>(())
    /// ```
    pub fn estimate(
        &self,
        pairs: &[Correspondence],
        groups: &[Vec<usize>],
    ) -> Result<PoseEstimate> {
        let found = self.most_agreed(pairs, groups)?;
        significance::require(&found.target_from_source, pairs, self.acceptance_radius)?;
        Ok(found)
    }

    /// The same, however few correspondences agree: whether they mean anything is for the caller to judge.
    ///
    /// # Errors
    /// As [`LocalToGlobal::estimate`], `NoPose` only if the pairs do not determine a pose.
    pub fn most_agreed(
        &self,
        pairs: &[Correspondence],
        groups: &[Vec<usize>],
    ) -> Result<PoseEstimate> {
        self.validate(pairs, groups)?;
        let proposals = self.proposals(pairs, groups)?;
        let iterations = proposals.len();
        let difference = Difference::new(pairs, 2.0 * self.acceptance_radius);
        let leaders = difference.best(proposals, 2);
        let Some(elected) = leaders.first() else {
            return Err(Error::no_pose(format!(
                "none of {} groups of correspondences determines a pose",
                groups.len()
            )));
        };
        let best = self.refined(*elected, pairs);
        Ok(PoseEstimate {
            target_from_source: best.target_from_source,
            inliers: consensus::inliers(&best.target_from_source, pairs, self.acceptance_radius),
            score: best.score,
            runner_up: leaders.get(1).map(|other| other.score),
            iterations,
            budget_exhausted: false,
        })
    }

    fn validate(&self, pairs: &[Correspondence], groups: &[Vec<usize>]) -> Result<()> {
        let positive = self.acceptance_radius.is_finite() && self.acceptance_radius > 0.0;
        if !positive || self.smallest_group < 3 {
            return Err(Error::invalid(format!(
                "local-to-global registration needs a positive acceptance radius and groups of at least 3, got {} m and {}",
                self.acceptance_radius, self.smallest_group
            )));
        }
        consensus::validate(pairs)?;
        match groups.iter().flatten().find(|&&index| index >= pairs.len()) {
            Some(index) => Err(Error::invalid(format!(
                "a group names correspondence {index}, there are {}",
                pairs.len()
            ))),
            None => Ok(()),
        }
    }

    /// One pose for each group that determines one, or a single one for all pairs.
    fn proposals(
        &self,
        pairs: &[Correspondence],
        groups: &[Vec<usize>],
    ) -> Result<Vec<Hypothesis>> {
        if groups.iter().all(|group| group.len() < self.smallest_group) {
            let all = fit_weighted(weighted(pairs, &scores(pairs)))?;
            return Ok(vec![self.hypothesis(all, pairs)]);
        }
        let propose = |group: &Vec<usize>| {
            let members = group.iter().map(|&index| {
                let pair = &pairs[index];
                (pair.source, pair.target, pair.score)
            });
            let pose = fit_weighted(members).ok()?;
            Some(self.hypothesis(pose, pairs))
        };
        let large = groups.par_iter().filter(|group| group.len() >= self.smallest_group);
        Ok(large.filter_map(propose).collect())
    }

    /// Every pair has one vote, whatever its score.
    fn hypothesis(&self, pose: RigidTransform, pairs: &[Correspondence]) -> Hypothesis {
        let agrees = |pair: &&Correspondence| residual(&pose, pair) < self.acceptance_radius;
        let votes = pairs.iter().filter(agrees).count();
        Hypothesis { target_from_source: pose, score: votes as f64 }
    }

    fn refined(&self, elected: Hypothesis, pairs: &[Correspondence]) -> Hypothesis {
        let scores = scores(pairs);
        let (mut last, mut best) = (elected, elected);
        for _ in 0..self.refinement_steps {
            let weight = |(pair, score): (&Correspondence, &f64)| {
                let agrees = residual(&last.target_from_source, pair) < self.acceptance_radius;
                if agrees { *score } else { 0.0 }
            };
            let weights: Vec<f64> = pairs.iter().zip(&scores).map(weight).collect();
            let Ok(pose) = fit_weighted(weighted(pairs, &weights)) else { break };
            last = self.hypothesis(pose, pairs);
            if self.mode == Mode::Faithful || last.score >= best.score {
                best = last;
            }
        }
        best
    }
}

fn scores(pairs: &[Correspondence]) -> Vec<f64> {
    pairs.iter().map(|pair| pair.score).collect()
}
