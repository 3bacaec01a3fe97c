//! The last step of estimators that form a pose around each of many seeds: the pose that scores best is polished on the
//! pairs that agree with it.

use serde::{Deserialize, Serialize};

use crate::data::{Correspondence, RigidTransform};
use crate::error::{Error, Result};
use crate::pose::consensus::{self, Difference, Hypothesis, Keep, Polish};
use crate::pose::{Mode, PoseEstimate, significance};

/// How the best of many poses is chosen and polished; lengths in metres.
///
/// What [`Mode::Faithful`] keeps of the released code of PointDSC and VBReg:
/// * only the best pose is polished, and keeps the score that it had before,
/// * the inliers are those of the pose before it was polished,
/// * the polishing returns its last pose, even if an earlier one was better.
///
/// [`Mode::Fixed`]: the best two poses that differ are polished and scored again, the inliers are those of the pose that
/// is returned, and the polishing returns its best pose.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PoseChoice {
    /// A correspondence agrees with a pose if its residual is smaller.
    pub inlier_threshold: f64,
    /// The polishing uses correspondences with a smaller residual `d`, weighted by `1 / (1 + (d / threshold)^2)`.
    pub polish_threshold: f64,
    /// Rounds of the polishing, at most. It ends when the number of correspondences in use repeats.
    pub polish_rounds: usize,
    /// Whether the quirks of the released code (above) are kept.
    pub mode: Mode,
}

impl PoseChoice {
    /// The best of `poses` (source to target) by `score` (higher is better, the earlier pose wins a tie), polished. The
    /// scores of the pairs do not count.
    ///
    /// # Errors
    /// `InvalidInput` if a threshold is not positive or a pair is not finite; `NoPose` if there are fewer than three
    /// pairs or no poses, or if the best pose agrees with no more pairs than random ones would.
    pub fn choose(
        &self,
        poses: &[RigidTransform],
        pairs: &[Correspondence],
        score: impl Fn(&RigidTransform) -> f64,
    ) -> Result<PoseEstimate> {
        self.validate()?;
        consensus::validate(pairs)?;
        let pairs = &consensus::weighed(pairs, false);
        let difference = Difference::new(pairs, 2.0 * self.inlier_threshold);
        let scored =
            |pose: RigidTransform| Hypothesis { target_from_source: pose, score: score(&pose) };
        let candidates = difference.best(poses.iter().map(|&pose| scored(pose)).collect(), 2);
        let Some(best) = candidates.first() else {
            return Err(Error::no_pose(format!(
                "no three of {} correspondences that belong together determine a pose",
                pairs.len()
            )));
        };
        let polished = |pose: &Hypothesis| self.polish().run(pose.target_from_source, pairs);
        let (best, labels, runner_up) = match self.mode {
            Mode::Faithful => {
                let last = Hypothesis { target_from_source: polished(best), ..*best };
                (last, best.target_from_source, candidates.get(1).copied())
            }
            Mode::Fixed => {
                let again = candidates.iter().map(|pose| scored(polished(pose))).collect();
                let again = difference.best(again, 2);
                // The best of at least one.
                let first = again.first().copied().unwrap_or(*best);
                (first, first.target_from_source, again.get(1).copied())
            }
        };
        significance::require(&best.target_from_source, pairs, self.inlier_threshold)?;
        Ok(PoseEstimate {
            target_from_source: best.target_from_source,
            inliers: consensus::inliers(&labels, pairs, self.inlier_threshold),
            score: best.score,
            runner_up: runner_up.map(|other| other.score),
            iterations: poses.len(),
            budget_exhausted: false,
        })
    }

    fn validate(&self) -> Result<()> {
        for (name, value) in [
            ("inlier threshold", self.inlier_threshold),
            ("polish threshold", self.polish_threshold),
        ] {
            if !(value.is_finite() && value > 0.0) {
                return Err(Error::invalid(format!("the {name} is {value}, it must be positive")));
            }
        }
        Ok(())
    }

    fn polish(&self) -> Polish {
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

#[cfg(test)]
mod tests {
    use nalgebra::{Point3, Rotation3, Vector3};

    use super::*;
    use crate::random::Random;

    const CHOICE: PoseChoice = PoseChoice {
        inlier_threshold: 0.1,
        polish_threshold: 0.1,
        polish_rounds: 20,
        mode: Mode::Fixed,
    };

    fn motion(shift: f64) -> RigidTransform {
        RigidTransform::new(
            Rotation3::new(Vector3::new(0.3, 0.1, 0.2)),
            Vector3::new(shift, 0.0, 1.0),
        )
    }

    /// Forty pairs follow the motion up to 1 cm, the others nothing.
    fn pairs() -> Vec<Correspondence> {
        let mut random = Random::new(4, 0);
        let mut point = |scale: f64| Vector3::from_fn(|_, _| scale * random.normal());
        (0..100)
            .map(|i| {
                let source = Point3::from(point(1.0));
                let target = motion(1.0).apply(&source) + point(if i < 40 { 0.01 } else { 1.0 });
                Correspondence { source, target, score: 1.0 }
            })
            .collect()
    }

    fn agreeing(pose: &RigidTransform) -> f64 {
        consensus::inliers(pose, &pairs(), 0.1).len() as f64
    }

    #[test]
    fn the_best_pose_is_polished() {
        let poses = [motion(5.0), motion(1.04), motion(0.7)];
        let fixed = CHOICE.choose(&poses, &pairs(), agreeing).unwrap();
        let error = fixed.target_from_source.error_to(&motion(1.0));
        assert!(error.translation < 0.01 && error.rotation_degrees < 1.0, "{error:?}");
        assert!(fixed.inliers.len() >= 40 && fixed.score == fixed.inliers.len() as f64);
        assert!(fixed.runner_up.is_some_and(|other| other < fixed.score));
        let faithful = PoseChoice { mode: Mode::Faithful, ..CHOICE };
        let faithful = faithful.choose(&poses, &pairs(), agreeing).unwrap();
        assert_eq!(faithful.score, agreeing(&motion(1.04)));
        assert_eq!(faithful.inliers.len() as f64, faithful.score);
    }

    #[test]
    fn nothing_to_choose_from_and_nonsense_are_errors() {
        let message = |poses: &[RigidTransform]| {
            CHOICE.choose(poses, &pairs(), agreeing).unwrap_err().to_string()
        };
        assert!(message(&[]).contains("determine a pose"), "{}", message(&[]));
        assert!(message(&[motion(-30.0)]).contains("random ones"), "{}", message(&[motion(-30.0)]));
        assert!(CHOICE.choose(&[motion(1.0)], &pairs()[..2], agreeing).is_err());
        let nonsense = PoseChoice { polish_threshold: f64::NAN, ..CHOICE };
        assert!(nonsense.choose(&[motion(1.0)], &pairs(), agreeing).is_err());
    }
}
