//! What the estimators share: counting agreement, polishing a pose on what agrees, telling poses apart.

use nalgebra::{Point3, Vector3};

use crate::data::{Correspondence, RigidTransform};
use crate::error::{Error, Result};
use crate::pose::fit_weighted;

/// Poses whose rotations differ by more than this are different, degrees.
const DIFFERENT_DEGREES: f64 = 5.0;

/// A pose and its [`score`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Hypothesis {
    pub(super) target_from_source: RigidTransform,
    pub(super) score: f64,
}

impl Hypothesis {
    pub(super) fn new(
        target_from_source: RigidTransform,
        pairs: &[Correspondence],
        threshold: f64,
    ) -> Hypothesis {
        let score = score(&target_from_source, pairs, threshold);
        Hypothesis { target_from_source, score }
    }
}

/// Fails unless there are three pairs or more, all finite.
///
/// # Errors
/// `NoPose` if there are fewer; `InvalidInput` if a coordinate or a score is not finite.
pub fn validate(pairs: &[Correspondence]) -> Result<()> {
    if pairs.len() < 3 {
        return Err(Error::no_pose(format!(
            "a pose needs at least 3 correspondences, there are {}",
            pairs.len()
        )));
    }
    let finite = |pair: &Correspondence| {
        pair.source.iter().chain(pair.target.iter()).chain([&pair.score]).all(|x| x.is_finite())
    };
    match pairs.iter().position(|pair| !finite(pair)) {
        Some(index) => Err(Error::invalid(format!(
            "correspondence {index} has a coordinate or a score that is not finite"
        ))),
        None => Ok(()),
    }
}

/// The pairs as the estimators weigh them: with scores whose mean is 1 (negative ones count as 0), or all 1.
pub(super) fn weighed(pairs: &[Correspondence], use_scores: bool) -> Vec<Correspondence> {
    let sum: f64 = pairs.iter().map(|pair| pair.score.max(0.0)).sum();
    let scale = if sum > 0.0 { pairs.len() as f64 / sum } else { 0.0 };
    let weight = |score: f64| if use_scores { score.max(0.0) * scale } else { 1.0 };
    pairs.iter().map(|pair| Correspondence { score: weight(pair.score), ..*pair }).collect()
}

/// The distance of a moved source point to its target, metres.
pub(super) fn residual(pose: &RigidTransform, pair: &Correspondence) -> f64 {
    (pose.apply(&pair.source) - pair.target).norm()
}

/// The scores of the pairs with a residual below `threshold` (metres), summed up, plus a fraction (0 to 1) that is the
/// larger, the smaller their mean residual: with equal scores more pairs always win, and equally many are told apart.
pub(super) fn score(pose: &RigidTransform, pairs: &[Correspondence], threshold: f64) -> f64 {
    let (mut sum, mut weighted) = (0.0, 0.0);
    for pair in pairs {
        let residual = residual(pose, pair);
        if residual < threshold {
            sum += pair.score;
            weighted += pair.score * residual;
        }
    }
    if sum > 0.0 { sum + (1.0 - weighted / (sum * threshold)) } else { 0.0 }
}

/// The indices of the pairs with a residual below `threshold` (metres), ascending.
pub(super) fn inliers(
    pose: &RigidTransform,
    pairs: &[Correspondence],
    threshold: f64,
) -> Vec<usize> {
    (0..pairs.len()).filter(|&i| residual(pose, &pairs[i]) < threshold).collect()
}

/// When [`Polish::run`] ends and what it gives back.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Keep {
    /// The last pose, as the official code: it may walk away from a better one.
    Last,
    /// The pose on the way with the smallest loss.
    Best,
}

/// Iteratively re-weighted fits on the pairs that agree (the "post-refinement" of SC2-PCR and its relatives).
#[derive(Debug, Clone, Copy)]
pub(super) struct Polish {
    /// Pairs with a residual `d` below it take part with the weight `score / (1 + (d / threshold)^2)`, metres.
    pub(super) threshold: f64,
    pub(super) rounds: usize,
    pub(super) keep: Keep,
}

impl Polish {
    /// Stops as soon as the number of pairs that take part repeats.
    pub(super) fn run(&self, start: RigidTransform, pairs: &[Correspondence]) -> RigidTransform {
        let mut pose = start;
        let mut best = start;
        let mut least = self.loss(&start, pairs);
        let mut previous = 0;
        for _ in 0..self.rounds {
            let weights: Vec<f64> = pairs.iter().map(|pair| self.weight(&pose, pair)).collect();
            let count = weights.iter().filter(|&&weight| weight > 0.0).count();
            if count == previous {
                break;
            }
            previous = count;
            let Ok(next) = fit_weighted(weighted(pairs, &weights)) else { break };
            pose = next;
            let loss = self.loss(&pose, pairs);
            if self.keep == Keep::Last || loss <= least {
                (best, least) = (pose, loss);
            }
        }
        best
    }

    /// What the weights minimise: `score * ln(1 + (d / threshold)^2)`, constant from the threshold on. The number of
    /// pairs that agree would be the wrong judge here: it favours poses that stretch to reach a few more of them.
    fn loss(&self, pose: &RigidTransform, pairs: &[Correspondence]) -> f64 {
        let ratio = |pair: &Correspondence| (residual(pose, pair) / self.threshold).min(1.0);
        pairs.iter().map(|pair| pair.score * ratio(pair).powi(2).ln_1p()).sum()
    }

    fn weight(&self, pose: &RigidTransform, pair: &Correspondence) -> f64 {
        let ratio = residual(pose, pair) / self.threshold;
        if ratio < 1.0 { pair.score / (1.0 + ratio * ratio) } else { 0.0 }
    }
}

/// Pairs with weights as [`fit_weighted`] takes them.
pub(super) fn weighted<'a>(
    pairs: &'a [Correspondence],
    weights: &'a [f64],
) -> impl Iterator<Item = (Point3<f64>, Point3<f64>, f64)> + Clone + 'a {
    (pairs.iter().zip(weights))
        .filter(|(_, weight)| **weight > 0.0)
        .map(|(pair, &weight)| (pair.source, pair.target, weight))
}

/// Tells poses apart: by more than 5 degrees, or by more than a distance at the middle of the source pairs.
#[derive(Debug, Clone, Copy)]
pub(super) struct Difference {
    centroid: Point3<f64>,
    distance: f64,
}

impl Difference {
    /// `distance` in metres.
    pub(super) fn new(pairs: &[Correspondence], distance: f64) -> Difference {
        let sum: Vector3<f64> = pairs.iter().map(|pair| pair.source.coords).sum();
        Difference { centroid: Point3::from(sum / pairs.len().max(1) as f64), distance }
    }

    pub(super) fn between(&self, a: &RigidTransform, b: &RigidTransform) -> bool {
        a.error_to(b).rotation_degrees > DIFFERENT_DEGREES
            || (a.apply(&self.centroid) - b.apply(&self.centroid)).norm() > self.distance
    }

    /// The best `top` hypotheses of which no two are alike, best first; the earlier one wins a tie.
    pub(super) fn best(&self, mut hypotheses: Vec<Hypothesis>, top: usize) -> Vec<Hypothesis> {
        hypotheses.sort_by(|a, b| b.score.total_cmp(&a.score));
        let mut kept: Vec<Hypothesis> = Vec::new();
        for candidate in hypotheses {
            if kept.len() == top {
                break;
            }
            let pose = &candidate.target_from_source;
            if kept.iter().all(|other| self.between(&other.target_from_source, pose)) {
                kept.push(candidate);
            }
        }
        kept
    }
}
