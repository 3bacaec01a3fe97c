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

    /// Re-weighted fits on the pairs that agree, until the agreement falls.
    ///
    /// The pose after which it fell is given back, as released: near its maximum the agreement, a sum of distances, is
    /// the poorer guide, and to go a step back made the median errors on indoor pairs up to a tenth larger.
    /// [`Mode::Faithful`] fits about unweighted centroids.
    pub(super) fn polish(
        &self,
        start: RigidTransform,
        rounds: usize,
        mode: Mode,
    ) -> RigidTransform {
        let mut pose = start;
        let mut reached = 0.0;
        for _ in 0..rounds {
            let agreement = self.of(&pose);
            if agreement < reached {
                break;
            }
            reached = agreement;
            let Ok(next) = self.fit(&pose, mode) else { break };
            pose = next;
        }
        pose
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

#[cfg(test)]
mod tests {
    use nalgebra::Rotation3;

    use super::*;
    use crate::pose::mac::samples;

    #[test]
    fn plain_centroids_differ_from_weighted_ones_unless_all_weights_are_equal() {
        let truth = RigidTransform::new(Rotation3::new(Vector3::new(0.3, -2.0, 0.5)), Vector3::x());
        let pairs = |spread: f64, noise: f64| -> Vec<_> {
            (samples::scattered(30).iter().zip(1..))
                .map(|(pair, i)| {
                    let target = truth.apply(&pair.source) + pair.target.coords * noise;
                    (pair.source, target, 1.0 + spread * f64::from(i))
                })
                .collect()
        };
        let both = |pairs: Vec<_>| {
            let weighted = fit_weighted(pairs.iter().copied()).unwrap();
            let error = fit_about_plain_centroids(&pairs).unwrap().error_to(&weighted);
            error.rotation_degrees.max(error.translation)
        };
        assert!(both(pairs(0.0, 0.2)) < 1e-6 && both(pairs(1.0, 0.0)) < 1e-6);
        assert!(both(pairs(1.0, 0.2)) > 1e-3);
    }

    #[test]
    fn polishing_finds_the_motion_of_the_pairs_that_agree() {
        let start = RigidTransform::new(
            Rotation3::new(Vector3::new(0.01, -0.02, 0.0)),
            Vector3::z() * 0.03,
        );
        let mut pairs = samples::scattered(60);
        for pair in &mut pairs[..40] {
            pair.target = pair.source;
        }
        let agreement = Agreement { pairs: &pairs, threshold: 0.1 };
        assert!(agreement.of(&start) < 35.0);
        for mode in [Mode::Faithful, Mode::Fixed] {
            let pose = agreement.polish(start, 20, mode);
            assert!(pose.error_to(&RigidTransform::identity()).translation < 1e-3);
            assert!(agreement.of(&pose) > 39.9);
            assert_eq!(agreement.polish(start, 0, mode), start);
        }
    }
}
