//! Whether more correspondences agree with a pose than would by chance (an a-contrario test, after Moisan and Stival
//! 2004).
//!
//! Take the pairs as random: points drawn from either cloud and joined blindly. One fixed pose then brings a source
//! point to its target with the probability that a point of the moved source cloud is near one of the target cloud.
//! Over all poses that is largest where dense meets dense, and by the inequality of Cauchy and Schwarz never above
//! (about) `p = sqrt(a b)`, where `a` and `b` are the probabilities that two points of the same cloud are near each
//! other. So the number of agreeing pairs is at most binomial (Hoeffding 1956), and Chernoff bounds its tail.
//!
//! An estimator chooses among many poses. Two pairs leave a turn about the line through their points: the edges agree
//! with a probability of about `4 threshold / extent`, and turns differ in about `pi extent / threshold` steps, which
//! makes `4 pi` poses for each two pairs that agree, or `4 pi / p^2` in all. That number times the tail is the
//! expected number of poses of random pairs with as much agreement; where it is small, the agreement is no chance.
//!
//! The test is made with the threshold and with smaller ones, because a few pairs that agree exactly prove as much as
//! many that agree roughly; the number of tests multiplies the expectation, too.

use nalgebra::{Matrix3, Point3, Vector3};

use crate::data::{Correspondence, RigidTransform};
use crate::error::{Error, Result};
use crate::pose::consensus::residual;

/// The threshold and its halves.
const SCALES: usize = 8;

/// A pose is significant if random pairs are expected to give fewer poses than this with as much agreement.
const EXPECTED_BY_CHANCE: f64 = 1e-3;

/// Points whose distances to all others are looked at, at most.
const SAMPLED: usize = 128;

/// Fails with `NoPose` unless [`is_significant`].
pub(super) fn require(
    target_from_source: &RigidTransform,
    pairs: &[Correspondence],
    threshold: f64,
) -> Result<()> {
    if is_significant(target_from_source, pairs, threshold) {
        return Ok(());
    }
    let agree = pairs.iter().filter(|pair| residual(target_from_source, pair) < threshold).count();
    Err(Error::no_pose(format!(
        "on the best one {agree} of {} correspondences agree within {threshold} m, which random ones would, too: \
         give more or better correspondences",
        pairs.len()
    )))
}

/// Whether more of the pairs agree with the pose, with residuals below `threshold` (metres) or less, than chance
/// explains. Repeated pairs count once; scores do not count.
pub(super) fn is_significant(
    target_from_source: &RigidTransform,
    pairs: &[Correspondence],
    threshold: f64,
) -> bool {
    log_expected(target_from_source, pairs, threshold) < EXPECTED_BY_CHANCE.ln()
}

/// The logarithm of the expected number of poses of random pairs with as much agreement, at the most telling scale.
fn log_expected(
    target_from_source: &RigidTransform,
    pairs: &[Correspondence],
    threshold: f64,
) -> f64 {
    let pairs = distinct(pairs);
    let residuals = pairs.iter().map(|pair| residual(target_from_source, pair).powi(2));
    let agreeing = below_halves(residuals, threshold);
    let source = chances(&pairs.iter().map(|pair| pair.source).collect::<Vec<_>>(), threshold);
    let target = chances(&pairs.iter().map(|pair| pair.target).collect::<Vec<_>>(), threshold);
    let tests = (SCALES as f64).ln();
    (source.iter().zip(target).zip(agreeing))
        .map(|((a, b), agreeing)| {
            let chance = (a * b).sqrt();
            let poses = (4.0 * std::f64::consts::PI).ln() - 2.0 * chance.ln();
            tests + poses + log_tail(agreeing, pairs.len(), chance)
        })
        .fold(f64::INFINITY, f64::min)
}

/// The pairs without repetitions, in the order of their coordinates.
fn distinct(pairs: &[Correspondence]) -> Vec<Correspondence> {
    let order = |a: &Correspondence, b: &Correspondence| {
        let coordinates = (a.source.iter().chain(a.target.iter()))
            .zip(b.source.iter().chain(b.target.iter()))
            .map(|(a, b)| a.total_cmp(b));
        coordinates.fold(std::cmp::Ordering::Equal, std::cmp::Ordering::then)
    };
    let mut sorted = pairs.to_vec();
    sorted.sort_unstable_by(order);
    sorted.dedup_by(|a, b| order(a, b).is_eq());
    sorted
}

/// How many of the distances, given squared, are below `threshold`, half of it, and so on.
fn below_halves(squares: impl Iterator<Item = f64>, threshold: f64) -> [usize; SCALES] {
    let mut counts = [0; SCALES];
    for square in squares.filter(|&square| square < threshold * threshold) {
        let mut scale = threshold;
        for count in &mut counts {
            *count += usize::from(square < scale * scale);
            scale /= 2.0;
        }
    }
    counts
}

/// The probabilities that two of the points are closer than `threshold`, half of it, and so on: as counted, but not
/// less than for a normal distribution of the same extent, because few points have no near neighbours to count.
fn chances(points: &[Point3<f64>], threshold: f64) -> [f64; SCALES] {
    let step = points.len().div_ceil(SAMPLED).max(1);
    let mut looked_at = 0;
    let mut near = [0; SCALES];
    for (i, point) in points.iter().enumerate().step_by(step) {
        let others = points.iter().enumerate().filter(|&(j, _)| j != i);
        let counts =
            below_halves(others.map(|(_, other)| (other - point).norm_squared()), threshold);
        near.iter_mut().zip(counts).for_each(|(near, count)| *near += count);
        looked_at += points.len() - 1;
    }
    let deviations = deviations(points);
    let mut scale = threshold;
    near.map(|near| {
        let counted = near as f64 / looked_at.max(1) as f64;
        // The difference of two normal numbers has the deviation sqrt(2) sigma and the density 1 / (2 sqrt(pi) sigma)
        // at 0.
        let axis = |sigma: f64| (scale / (std::f64::consts::PI.sqrt() * sigma)).min(1.0);
        let normal = deviations.map(axis).iter().product::<f64>();
        scale /= 2.0;
        counted.max(normal).min(1.0)
    })
}

/// Standard deviations along the principal axes.
fn deviations(points: &[Point3<f64>]) -> [f64; 3] {
    let count = points.len().max(1) as f64;
    let sum: Vector3<f64> = points.iter().map(|point| point.coords).sum();
    let mean = sum / count;
    let outer = |point: &Point3<f64>| {
        let offset = point.coords - mean;
        offset * offset.transpose()
    };
    let covariance = points.iter().map(outer).sum::<Matrix3<f64>>() / count;
    covariance.symmetric_eigenvalues().map(|variance| variance.max(0.0).sqrt()).into()
}

/// Chernoff's bound on the logarithm of the probability that of `count` events of the probability `chance` at least
/// `hits` come true.
fn log_tail(hits: usize, count: usize, chance: f64) -> f64 {
    let share = hits as f64 / count.max(1) as f64;
    if share <= chance {
        return 0.0;
    }
    let term = |a: f64, b: f64| if a > 0.0 { a * (a / b).ln() } else { 0.0 };
    -(count as f64) * (term(share, chance) + term(1.0 - share, 1.0 - chance))
}

#[cfg(test)]
mod tests {
    use nalgebra::Rotation3;

    use super::*;
    use crate::random::Random;

    /// Random pairs of points on a floor and two walls, of which the first `agreeing` follow the motion up to `noise`.
    fn pairs(count: usize, agreeing: usize, noise: f64, seed: u64) -> Vec<Correspondence> {
        let mut random = Random::new(seed, 0);
        let mut pair = |i: usize| {
            let [source, elsewhere] = [(); 2].map(|()| {
                let mut point = Vector3::from_fn(|_, _| 3.0 * random.uniform());
                point[random.below(3)] = 0.0;
                Point3::from(point)
            });
            let target = motion().apply(if i < agreeing { &source } else { &elsewhere });
            let noise = Vector3::from_fn(|_, _| noise * (random.uniform() - 0.5));
            Correspondence { source, target: target + noise, score: 1.0 }
        };
        (0..count).map(&mut pair).collect()
    }

    fn motion() -> RigidTransform {
        RigidTransform::new(Rotation3::new(Vector3::new(0.7, 0.2, -0.4)), Vector3::x())
    }

    #[test]
    fn a_little_agreement_among_many_pairs_counts_and_less_does_not() {
        for (count, agreeing, expected) in [
            (1000, 27, true),
            (1000, 50, true),
            (5000, 80, true),
            (100, 8, true),
            (10, 6, true),
            (1000, 8, false),
            (5000, 12, false),
            (100, 3, false),
        ] {
            for seed in 0..10 {
                let pairs = pairs(count, agreeing, 0.1, seed);
                let significant = is_significant(&motion(), &pairs, 0.1);
                assert_eq!(significant, expected, "{agreeing} of {count}");
            }
        }
    }

    #[test]
    fn three_pairs_prove_a_pose_only_if_they_agree_well() {
        let (exact, rough) = (pairs(3, 3, 1e-6, 1), pairs(3, 3, 0.1, 1));
        assert!(is_significant(&motion(), &exact, 0.1));
        assert!(!is_significant(&motion(), &rough, 0.1));
        let message = require(&motion(), &rough, 0.1).unwrap_err().to_string();
        assert!(message.contains("3 of 3 correspondences agree within 0.1 m"), "{message}");
    }

    #[test]
    fn repetitions_prove_nothing() {
        let mut pairs = pairs(50, 3, 0.1, 2);
        for _ in 0..20 {
            pairs.extend_from_within(..3);
        }
        assert!(!is_significant(&motion(), &pairs, 0.1));
    }

    #[test]
    fn what_fits_anywhere_proves_nothing() {
        let still = RigidTransform::identity();
        let at = |source, target| Correspondence { source, target, score: 1.0 };
        let clump = |i: i32| Point3::new(0.0, 0.05 * f64::from(i % 2), 1e-3 * f64::from(i));
        let shuffled = (0..50).map(|i| at(clump(i), clump(7 * i % 50)));
        assert!(!is_significant(&still, &[], 0.1));
        assert!(!is_significant(&still, &[at(Point3::origin(), Point3::origin())], 0.1));
        assert!(!is_significant(&still, &shuffled.collect::<Vec<_>>(), 0.1));
    }
}
