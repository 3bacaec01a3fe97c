//! How well a pose agrees with all correspondences, and its improvement on those that agree.

use nalgebra::{Point3, Vector3};

use crate::data::{Correspondence, RigidTransform};
use crate::error::Result;
use crate::pose::consensus::residual;
use crate::pose::{Mode, fit_weighted};

/// Correspondences that poses are judged by.
#[derive(Debug, Clone, Copy)]
pub(in crate::pose) struct Agreement<'a> {
    pub(in crate::pose) pairs: &'a [Correspondence],
    /// Pairs agree with a pose if their residual is smaller, metres.
    pub(in crate::pose) threshold: f64,
}

impl Agreement<'_> {
    /// `max(0, 1 - residual / threshold)` times the score of the pair, summed over all of them.
    pub(super) fn of(&self, pose: &RigidTransform) -> f64 {
        let share = |pair: &Correspondence| (1.0 - residual(pose, pair) / self.threshold).max(0.0);
        self.pairs.iter().map(|pair| pair.score * share(pair)).sum()
    }

    /// Re-weighted fits on the pairs that agree, until the agreement no longer rises.
    ///
    /// [`Mode::Faithful`] fits about unweighted centroids and gives back the last pose, also if it is worse than the
    /// one before; [`Mode::Fixed`] the best.
    pub(super) fn polish(
        &self,
        start: RigidTransform,
        rounds: usize,
        mode: Mode,
    ) -> RigidTransform {
        let (mut pose, mut best) = (start, start);
        let mut reached = 0.0;
        for _ in 0..rounds {
            let agreement = self.of(&pose);
            if agreement < reached {
                break;
            }
            reached = agreement;
            best = pose;
            let Ok(next) = self.fit(&pose, mode) else { break };
            pose = next;
        }
        match mode {
            Mode::Faithful => pose,
            Mode::Fixed if self.of(&pose) > reached => pose,
            Mode::Fixed => best,
        }
    }

    /// The fit on the pairs that agree with `pose`, weighted by `1 / (1 + (residual / threshold)^2)`.
    fn fit(&self, pose: &RigidTransform, mode: Mode) -> Result<RigidTransform> {
        let agreeing: Vec<(Point3<f64>, Point3<f64>, f64)> = (self.pairs.iter())
            .map(|pair| (pair, residual(pose, pair) / self.threshold))
            .filter(|(_, ratio)| *ratio < 1.0)
            .map(|(pair, ratio)| (pair.source, pair.target, pair.score / (1.0 + ratio * ratio)))
            .collect();
        match mode {
            Mode::Faithful => fit_about_plain_centroids(&agreeing),
            Mode::Fixed => fit_weighted(agreeing.into_iter()),
        }
    }
}

/// The fit of weighted pairs whose centroids ignore the weights.
fn fit_about_plain_centroids(pairs: &[(Point3<f64>, Point3<f64>, f64)]) -> Result<RigidTransform> {
    let count = pairs.len().max(1) as f64;
    let source: Vector3<f64> = pairs.iter().map(|pair| pair.0.coords).sum::<Vector3<f64>>() / count;
    let target: Vector3<f64> = pairs.iter().map(|pair| pair.1.coords).sum::<Vector3<f64>>() / count;
    // With its mirror image each pair has the weighted centroids at the origin, and the covariance only doubles.
    let mirrored = pairs.iter().flat_map(|&(p, q, weight)| {
        let (p, q) = (p - source, q - target);
        [(p, q, weight), (-p, -q, weight)]
    });
    let turn = *fit_weighted(mirrored)?.rotation();
    Ok(RigidTransform::new(turn, target - turn * source))
}
