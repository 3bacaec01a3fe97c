//! Transforms to begin with, beyond the given one: where 3D features agree, and around the given one.

use nalgebra::{Point3, Rotation3, Vector3};

use crate::data::{Correspondence, PointFeatures, RigidTransform};
use crate::error::Result;
use crate::matching::{correspondences, nearest};
use crate::pose::Sc2Pcr;
use crate::random::Random;
use crate::refine::hypotheses::keep_best_scored;
use crate::refine::working_pair::{WorkingCloud, WorkingPair};

/// Matches in which consensus is sought.
const MATCHES: usize = 3000;
/// Matches in which consensus is sought over all kinds of descriptors.
const MATCHES_OF_ALL: usize = 5000;
/// Distinct hypotheses taken from each set of matches.
const HYPOTHESES: usize = 20;
/// Restarts around a transform, ...
const RESTARTS: usize = 32;
/// ... which turn (radians about each axis) and shift (voxels along each axis) by at most this: what coarse alignments
/// are usually off by.
const RESTART_TURN: f64 = 0.25;
const RESTART_SHIFT: f64 = 8.0;

/// How much is spent on a search.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Effort {
    /// Descriptors of two reaches.
    Usual,
    /// Descriptors of other reaches and of finer sampling, for what the usual ones do not find.
    Thorough,
}

/// Descriptors of one kind: sampling distance and reach, both voxels.
#[derive(Debug, Clone, Copy)]
struct Kind {
    sampling: f64,
    reach: f64,
    /// Neighbours that are described, at most.
    neighbours: usize,
}

const WIDE: Kind = Kind { sampling: 1.6, reach: 14.0, neighbours: 300 };
const THOROUGH: [Kind; 3] = [
    Kind { sampling: 1.0, reach: 7.0, neighbours: 200 },
    Kind { sampling: 0.6, reach: 2.5, neighbours: 100 },
    Kind { sampling: 0.6, reach: 4.0, neighbours: 150 },
];

/// What consensus among matches of 3D features proposes. Where little is shared, descriptors of different reaches find
/// what the others miss, and all together what none finds alone. Working frames; may be empty.
///
/// # Errors
/// `InvalidInput` if a cloud cannot be sampled as the descriptors need it.
pub(super) fn by_features(
    pair: &WorkingPair<'_>,
    given: Option<&[Correspondence]>,
    effort: Effort,
) -> Result<Vec<RigidTransform>> {
    let sets = match effort {
        Effort::Usual => {
            let mut sets = vec![putative(pair)?, putative_of(pair, WIDE)?];
            sets.push(joined(&sets));
            sets.extend(given.map(<[Correspondence]>::to_vec));
            sets
        }
        Effort::Thorough => {
            let of_kind = |&kind: &Kind| putative_of(pair, kind);
            let mut sets = THOROUGH.iter().map(of_kind).collect::<Result<Vec<_>>>()?;
            sets.push(joined(&sets));
            sets
        }
    };
    let estimator = Sc2Pcr::for_voxel(pair.scale.voxel);
    // Matches without consensus have nothing to say.
    let hypotheses =
        |pairs: &Vec<Correspondence>| estimator.hypotheses(pairs, HYPOTHESES).unwrap_or_default();
    let found = sets.iter().flat_map(hypotheses);
    Ok(found.map(|estimate| estimate.target_from_source).collect())
}

/// The best-scored matches of all sets, as many of each.
fn joined(sets: &[Vec<Correspondence>]) -> Vec<Correspondence> {
    let share = MATCHES_OF_ALL / sets.len().max(1);
    sets.iter().flat_map(|pairs| pairs.iter().take(share)).copied().collect()
}

/// For every source landmark its nearest target landmark in feature space; the best-scored ones. Matches are not
/// required to be mutual: at low overlap that costs more right ones than it removes wrong ones.
///
/// # Errors
/// As [`nearest`].
pub(super) fn putative(pair: &WorkingPair<'_>) -> Result<Vec<Correspondence>> {
    best_matches(pair.source.landmarks.features(), pair.target.landmarks.features())
}

/// The same for descriptors of another kind.
fn putative_of(pair: &WorkingPair<'_>, kind: Kind) -> Result<Vec<Correspondence>> {
    let describe = |cloud: &WorkingCloud<'_>| {
        cloud.described(&pair.scale, kind.sampling, kind.reach, kind.neighbours)
    };
    best_matches(&describe(&pair.source)?, &describe(&pair.target)?)
}

fn best_matches(source: &PointFeatures, target: &PointFeatures) -> Result<Vec<Correspondence>> {
    let mut pairs = correspondences(source, target, &nearest(source, target, None)?, 1);
    keep_best_scored(&mut pairs, MATCHES);
    Ok(pairs)
}

/// Restarts around a transform: turned about random axes through the middle of the source, and shifted in random
/// directions. Working frames.
pub(super) fn around(
    pair: &WorkingPair<'_>,
    pose: &RigidTransform,
    seed: u64,
) -> Vec<RigidTransform> {
    let points = &pair.source.coarse;
    let sum: Vector3<f64> = points.iter().map(|point| point.coords).sum();
    let middle = pose.apply(&Point3::from(sum / points.len().max(1) as f64)).coords;
    let mut random = Random::new(seed, 4);
    let mut inside_unit_cube = || Vector3::from_fn(|_, _| 2.0 * random.uniform() - 1.0);
    let mut restart = |_| {
        let turn = Rotation3::new(RESTART_TURN * inside_unit_cube());
        let shift = RESTART_SHIFT * pair.scale.voxel * inside_unit_cube();
        RigidTransform::new(turn, middle + shift - turn * middle) * *pose
    };
    (0..RESTARTS).map(&mut restart).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::{PointCloud, Scan};
    use crate::refine::RefinerConfig;
    use crate::synthetic::room_pair;

    /// Two scans of a room, thinned, and the true pose.
    fn room() -> (Scan, Scan, RigidTransform) {
        let pair = room_pair(2, 0.65..=0.8).unwrap();
        let thin = |cloud: &PointCloud| -> Scan {
            PointCloud::new(cloud.points().iter().step_by(5).copied().collect()).unwrap().into()
        };
        (thin(&pair.source), thin(&pair.target), pair.target_from_source)
    }

    /// A pose that has nothing to do with the room.
    fn elsewhere() -> RigidTransform {
        let turn = Rotation3::new(Vector3::new(1.0, -2.0, 0.5));
        RigidTransform::new(turn, Vector3::new(7.0, -3.0, 2.0))
    }

    #[test]
    fn features_find_the_pose() {
        let (source, target, truth) = room();
        let pair = WorkingPair::new(&source, &target, &RefinerConfig::default()).unwrap();
        let near = |found: &[RigidTransform], pose: &RigidTransform| {
            let errors = found.iter().map(|found| found.error_to(pose));
            errors.filter(|e| e.rotation_degrees < 5.0 && e.translation < 0.2).count()
        };
        let truth = pair.to_working(&truth);
        for effort in [Effort::Usual, Effort::Thorough] {
            let found = by_features(&pair, None, effort).unwrap();
            assert!(near(&found, &truth) > 0, "{effort:?}: {} poses", found.len());
            assert_eq!(near(&found, &elsewhere()), 0);
        }
        // Matches of another method are asked as well.
        let given = |source: &Point3<f64>| Correspondence {
            source: *source,
            target: elsewhere().apply(source),
            score: 1.0,
        };
        let given: Vec<Correspondence> = pair.source.coarse.iter().step_by(40).map(given).collect();
        let found = by_features(&pair, Some(&given), Effort::Usual).unwrap();
        assert!(near(&found, &elsewhere()) > 0 && near(&found, &truth) > 0);
    }

    #[test]
    fn restarts_are_seeded_and_stay_around_the_middle() {
        let (source, target, _) = room();
        let pair = WorkingPair::new(&source, &target, &RefinerConfig::default()).unwrap();
        let (pose, voxel) = (elsewhere(), pair.scale.voxel);
        let restarts = around(&pair, &pose, 1);
        assert_eq!(restarts.len(), RESTARTS);
        assert_eq!(restarts, around(&pair, &pose, 1));
        assert_ne!(restarts, around(&pair, &pose, 2));
        let points = &pair.source.coarse;
        let sum: Vector3<f64> = points.iter().map(|point| point.coords).sum();
        let middle = Point3::from(sum / points.len() as f64);
        let mut farthest = (0.0_f64, 0.0_f64);
        for restart in &restarts {
            let turn = (restart.rotation() * pose.rotation().inverse()).scaled_axis().amax();
            let shift = (restart.apply(&middle) - pose.apply(&middle)).amax();
            farthest = (farthest.0.max(turn), farthest.1.max(shift));
        }
        let most = (RESTART_TURN, RESTART_SHIFT * voxel);
        assert!(farthest.0 <= most.0 && farthest.1 <= most.1 + 1e-9, "{farthest:?}");
        assert!(farthest.0 > 0.9 * most.0 && farthest.1 > 0.9 * most.1, "{farthest:?}");
    }

    #[test]
    fn the_best_scored_matches_are_kept_and_shared_alike() {
        let (source, target, _) = room();
        let pair = WorkingPair::new(&source, &target, &RefinerConfig::default()).unwrap();
        let pairs = putative(&pair).unwrap();
        assert!(pairs.len() > 500 && pairs.len() <= MATCHES, "{}", pairs.len());
        assert!(pairs.is_sorted_by(|a, b| a.score >= b.score));
        let many: Vec<Correspondence> = pairs.iter().cycle().take(MATCHES).copied().collect();
        let both = joined(&[many.clone(), pairs[..9].to_vec()]);
        assert_eq!(both, [&many[..MATCHES_OF_ALL / 2], &pairs[..9]].concat());
    }
}
