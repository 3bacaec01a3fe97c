//! Transforms to begin with, beyond the given one: where 3D features agree, and around the given one.

use nalgebra::{Point3, Rotation3, Vector3};

use crate::data::{Correspondence, PointFeatures, RigidTransform};
use crate::error::Result;
use crate::matching::{correspondences, nearest};
use crate::pose::Sc2Pcr;
use crate::random::Random;
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
    pairs.sort_by(|a, b| b.score.total_cmp(&a.score));
    pairs.truncate(MATCHES);
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
