//! Transforms to begin with, beyond the given one: where 3D features agree, and around the given one.

use nalgebra::{Point3, Rotation3, Vector3};

use crate::data::{Correspondence, PointFeatures, RigidTransform};
use crate::error::Result;
use crate::matching::{correspondences, nearest};
use crate::pose::Sc2Pcr;
use crate::random::Random;
use crate::refine::working_pair::WorkingPair;

/// Matches in which consensus is sought.
const MATCHES: usize = 3000;
/// Matches of either scale in the search over both.
const MATCHES_OF_EACH_SCALE: usize = 2500;
/// Distinct hypotheses taken from each set of matches.
const HYPOTHESES: usize = 20;
/// Turn and shift (voxels) of the restarts around a transform: about half of what local refinement recovers from.
const RESTART_TURN: f64 = 0.21;
const RESTART_SHIFT: f64 = 6.0;

/// What consensus among matches of 3D features proposes: descriptors of two reaches, and both together, because where
/// little is shared each finds what the other misses. Working frames; may be empty.
pub(super) fn by_features(
    pair: &WorkingPair<'_>,
    given: Option<&[Correspondence]>,
    seed: u64,
) -> Result<Vec<RigidTransform>> {
    let near = putative(pair)?;
    let wide = wide_putative(pair, seed)?;
    let of_each = |pairs: &[Correspondence]| pairs[..pairs.len().min(MATCHES_OF_EACH_SCALE)].to_vec();
    let both = [of_each(&near), of_each(&wide)].concat();
    let given = given.unwrap_or_default().to_vec();
    let estimator = Sc2Pcr::for_voxel(pair.scale.voxel);
    let hypotheses = |pairs: &Vec<Correspondence>| {
        // Matches without consensus have nothing to say.
        estimator.hypotheses(pairs, HYPOTHESES).unwrap_or_default()
    };
    let found = [near, wide, both, given].iter().flat_map(hypotheses).collect::<Vec<_>>();
    Ok(found.into_iter().map(|estimate| estimate.target_from_source).collect())
}

/// For every source landmark its nearest target landmark in feature space; the best-scored ones. Matches are not
/// required to be mutual: at low overlap that costs more right ones than it removes wrong ones.
pub(super) fn putative(pair: &WorkingPair<'_>) -> Result<Vec<Correspondence>> {
    best_matches(pair.source.landmarks.features(), pair.target.landmarks.features())
}

/// The same for descriptors that see twice as far.
fn wide_putative(pair: &WorkingPair<'_>, seed: u64) -> Result<Vec<Correspondence>> {
    let source = pair.source.wide_landmarks(&pair.scale, &mut Random::new(seed, 2))?;
    let target = pair.target.wide_landmarks(&pair.scale, &mut Random::new(seed, 3))?;
    best_matches(source.features(), target.features())
}

fn best_matches(source: &PointFeatures, target: &PointFeatures) -> Result<Vec<Correspondence>> {
    let mut pairs = correspondences(source, target, &nearest(source, target, None)?, 1);
    pairs.sort_by(|a, b| b.score.total_cmp(&a.score));
    pairs.truncate(MATCHES);
    Ok(pairs)
}

/// Restarts around a transform: turned either way about each axis through the middle of the source, and shifted along
/// it. Working frames.
pub(super) fn around(pair: &WorkingPair<'_>, pose: &RigidTransform) -> Vec<RigidTransform> {
    let points = &pair.source.coarse;
    let sum: Vector3<f64> = points.iter().map(|point| point.coords).sum();
    let middle = pose.apply(&Point3::from(sum / points.len().max(1) as f64)).coords;
    let shift = RESTART_SHIFT * pair.scale.voxel;
    let mut restarts = Vec::with_capacity(12);
    for axis in [Vector3::x_axis(), Vector3::y_axis(), Vector3::z_axis()] {
        for sign in [1.0, -1.0] {
            let turn = Rotation3::from_axis_angle(&axis, sign * RESTART_TURN);
            let about_middle = RigidTransform::new(turn, middle - turn * middle);
            restarts.push(about_middle * *pose);
            restarts.push(RigidTransform::from_translation(*axis * (sign * shift)) * *pose);
        }
    }
    restarts
}
