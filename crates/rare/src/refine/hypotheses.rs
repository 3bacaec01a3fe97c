//! Candidate transforms: where they come from, and which one wins.

use nalgebra::Point3;
use rayon::prelude::*;

use crate::aggregate::{Aggregation, aggregate, aggregate_candidates};
use crate::data::{Correspondence, CorrespondenceSets, RigidTransform};
use crate::error::Result;
use crate::pose::{Icp, IcpStage, RobustKernel, Sc2Pcr};
use crate::refine::Recipe;
use crate::refine::working_pair::WorkingPair;
use crate::scale::Scale;
use crate::verify::{DepthConsistency, Verifier};

/// A transform between the working frames and what depth consistency says of it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Candidate {
    pub(super) target_from_source: RigidTransform,
    pub(super) consistency: DepthConsistency,
}

/// Candidates that are polished, besides the current one.
const POLISHED: usize = 2;
/// Hypotheses taken from each set.
const HYPOTHESES_PER_SET: usize = 2;
/// Most pairs of a set in which consensus is sought; the best-scored ones.
const MOST_PAIRS: usize = 1000;

impl Candidate {
    pub(super) fn judged(target_from_source: RigidTransform, verifier: &Verifier<'_>) -> Candidate {
        Candidate { target_from_source, consistency: verifier.consistency(&target_from_source) }
    }

    /// Whether the pose hardly moved: less than a tenth of a voxel and 0.1 degrees.
    pub(super) fn settled(&self, before: &Candidate, voxel: f64) -> bool {
        let moved = self.target_from_source.error_to(&before.target_from_source);
        moved.rotation_degrees < 0.1 && moved.translation < 0.1 * voxel
    }
}

/// Step 8: transforms proposed by the sets, the paper's aggregate first.
pub(super) fn propose(
    recipe: &Recipe,
    scale: &Scale,
    sets: &CorrespondenceSets,
) -> Result<Vec<RigidTransform>> {
    let config = Aggregation {
        acceptance_radius: scale.acceptance_radius,
        reweighting_rounds: recipe.reweighting_rounds,
        top: recipe.top,
    };
    if !recipe.consensus {
        return Ok(vec![aggregate(sets, &config, None)?.consensus.target_from_source]);
    }
    let mut candidates = by_consensus(scale, sets);
    let consensus = aggregate_candidates(&sets.union(), &candidates, &config)?;
    candidates.insert(0, consensus.target_from_source);
    Ok(candidates)
}

/// Consensus inside each set: a set with many wrong pairs still has right ones, which one fit over all would drown.
fn by_consensus(scale: &Scale, sets: &CorrespondenceSets) -> Vec<RigidTransform> {
    let estimator = Sc2Pcr::for_voxel(scale.voxel);
    let hypotheses = |pairs: &[Correspondence]| {
        let mut pairs = pairs.to_vec();
        keep_best_scored(&mut pairs, MOST_PAIRS);
        // A set without consensus has nothing to say.
        estimator.hypotheses(&pairs, HYPOTHESES_PER_SET).unwrap_or_default()
    };
    sets.sets
        .par_iter()
        .flat_map_iter(|set| hypotheses(&set.pairs))
        .map(|estimate| estimate.target_from_source)
        .collect()
}

fn keep_best_scored(pairs: &mut Vec<Correspondence>, count: usize) {
    pairs.sort_by(|a, b| b.score.total_cmp(&a.score));
    pairs.truncate(count);
}

/// Step 9: all different hypotheses and the current pose, the most consistent first; of equals the current one, then
/// the earlier. Of hypotheses that are almost the same the first is kept.
pub(super) fn rank(
    proposed: &[RigidTransform],
    current: &Candidate,
    verifier: &Verifier<'_>,
    voxel: f64,
) -> Vec<Candidate> {
    let mut different: Vec<RigidTransform> = Vec::new();
    for pose in proposed {
        if !different.iter().any(|other| alike(pose, other, voxel)) {
            different.push(*pose);
        }
    }
    let judged = different.iter().map(|pose| Candidate::judged(*pose, verifier));
    let mut ranked: Vec<Candidate> = std::iter::once(*current).chain(judged).collect();
    ranked.sort_by(|a, b| b.consistency.score().total_cmp(&a.consistency.score()));
    ranked
}

/// Whether two poses would be polished into the same one: less than 1 degree and half a voxel apart.
fn alike(a: &RigidTransform, b: &RigidTransform, voxel: f64) -> bool {
    let difference = a.error_to(b);
    difference.rotation_degrees < 1.0 && difference.translation < 0.5 * voxel
}

/// The best candidates moved onto the surface; of those and the unpolished ones, the most consistent.
pub(super) fn polish(
    pair: &WorkingPair<'_>,
    ranked: &[Candidate],
    verifier: &Verifier<'_>,
) -> Candidate {
    let icp = schedule(pair.scale.voxel, &[3.0, 1.5], 0.05);
    let polished = ranked.par_iter().take(POLISHED).filter_map(|candidate| {
        let start = &candidate.target_from_source;
        let aligned = icp.align(&pair.source.coarse, &pair.target_surface, start).ok()?;
        Some(Candidate::judged(aligned.target_from_source, verifier))
    });
    let mut all: Vec<Candidate> = polished.collect();
    all.extend(ranked.first());
    all.sort_by(|a, b| b.consistency.score().total_cmp(&a.consistency.score()));
    all[0]
}

/// The winner moved onto the surface with half-voxel points, every second of them; kept unless it verifies worse.
pub(super) fn finish(
    pair: &WorkingPair<'_>,
    best: &Candidate,
    verifier: &Verifier<'_>,
) -> Candidate {
    let icp = schedule(pair.scale.voxel, &[1.0], 0.01);
    let source: Vec<Point3<f64>> = pair.source.fine.iter().step_by(2).copied().collect();
    let Ok(aligned) = icp.align(&source, &pair.target_surface, &best.target_from_source) else {
        return *best;
    };
    let finished = Candidate::judged(aligned.target_from_source, verifier);
    if finished.consistency.score() >= best.consistency.score() { finished } else { *best }
}

/// Tukey point-to-plane within a few voxels, coarse to fine, until steps are shorter than `tolerance` voxels.
fn schedule(voxel: f64, reaches: &[f64], tolerance: f64) -> Icp {
    let stage = |reach: &f64| IcpStage { max_distance: reach * voxel, kernel_width: reach * voxel };
    Icp {
        kernel: RobustKernel::Tukey,
        stages: reaches.iter().map(stage).collect(),
        max_iterations: 10,
        // At the edge of a scan 30 voxels from its middle both count alike.
        rotation_tolerance: tolerance / 30.0,
        translation_tolerance: tolerance * voxel,
    }
}
