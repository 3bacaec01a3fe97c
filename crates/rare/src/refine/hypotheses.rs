//! Candidate transforms: where they come from, and which one wins.

use nalgebra::Point3;
use rayon::prelude::*;

use crate::aggregate::{Aggregation, aggregate, aggregate_candidates};
use crate::data::{
    Correspondence, CorrespondenceSets, RigidTransform, SetName, first_of_every_voxel,
};
use crate::error::Result;
use crate::pose::{AnchoredIcp, Icp, IcpStage, IcpTarget, RobustKernel, Sc2Pcr, fit_weighted};
use crate::refine::Recipe;
use crate::refine::working_pair::WorkingPair;
use crate::scale::{Scale, SceneKind};
use crate::verify::{Evidence, Model, Support, Verifier};

/// A transform between the working frames and what is known of it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Candidate {
    pub(super) target_from_source: RigidTransform,
    pub(super) evidence: Evidence,
    /// Whether it descends from the initial transform, not from a search of its own.
    pub(super) from_initial: bool,
}

/// Candidates of a search from which a round begins.
pub(super) const SCREENED: usize = 3;
/// Hypotheses taken from each set.
const HYPOTHESES_PER_SET: usize = 2;
/// Most pairs of a set in which consensus is sought; the best-scored ones.
const MOST_PAIRS: usize = 1000;
/// Points that are moved onto the surface when many candidates are polished.
const ROUGH_POINTS: usize = 700;
/// Where points are spread evenly for the final alignment, one is taken from every voxel of these sizes (in voxels): of
/// the first size that leaves enough, ...
const FINE_SPACINGS: [f64; 2] = [2.0, 1.0];
/// ... which are so many, ...
const ENOUGH_FINE_POINTS: usize = 1000;
/// ... and nowhere more than these.
const MOST_FINE_POINTS: usize = 5000;
/// Weight of all matches in the final alignment, relative to that of all surface pairs, where everything overlaps; it
/// grows with the inverse square of the overlap, because the less overlaps, the less of the surfaces' disagreement is
/// noise that averages out, ...
const ANCHOR_WEIGHT: f64 = 0.007;
/// ... up to this.
const MOST_ANCHOR_WEIGHT: f64 = 0.4;
/// Log-odds that the final alignment may cost. Matches favour the pose under which their maps were rendered, so that a
/// better pose loses a tenth of its support.
const TOLERATED: f64 = 0.6;
/// What descends from the initial transform is believed more by these log-odds: whoever brings a transform has reasons
/// for it.
const PRIOR_OF_INITIAL: f64 = 0.4;
/// Log-odds beyond which nobody looks for anything better.
const CERTAIN: f64 = 2.8;

impl Candidate {
    /// A transform with the evidence of surfaces and sensors.
    pub(super) fn judged(
        target_from_source: RigidTransform,
        from_initial: bool,
        verifier: &Verifier<'_>,
    ) -> Candidate {
        let evidence = verifier.judge(&target_from_source);
        Candidate { target_from_source, evidence, from_initial }
    }

    /// The same with what the depth maps say in addition.
    pub(super) fn supported(mut self, sets: &CorrespondenceSets, voxel: f64) -> Candidate {
        let matches = depth_map_matches(sets);
        self.evidence.support = Some(Support::new(matches, &self.target_from_source, voxel));
        self
    }

    /// The rank among candidates of which as much is known: log-odds.
    pub(super) fn score(&self) -> f64 {
        let prior = if self.from_initial { PRIOR_OF_INITIAL } else { 0.0 };
        Model::ranking(&self.evidence).log_odds(&self.evidence) + prior
    }

    /// Whether nothing better needs to be sought.
    pub(super) fn is_certain(&self) -> bool {
        self.evidence.support.is_some() && Model::RANKING.log_odds(&self.evidence) > CERTAIN
    }

    /// Whether the pose hardly moved: less than a tenth of a voxel and 0.1 degrees.
    pub(super) fn settled(&self, before: &Candidate, voxel: f64) -> bool {
        let moved = self.target_from_source.error_to(&before.target_from_source);
        moved.rotation_degrees < 0.1 && moved.translation < 0.1 * voxel
    }
}

/// The matches of depth maps alone, of the reference's and of the source's views.
fn depth_map_matches(sets: &CorrespondenceSets) -> [&[Correspondence]; 2] {
    let of = |name| sets.of(name).map_or(&[][..], |set| &set.pairs);
    [of(SetName::DiffusionReference), of(SetName::DiffusionSource)]
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
    if !recipe.inlier_aggregation {
        let all = sets.union();
        let weighted = all.iter().map(|pair| (pair.source, pair.target, pair.score));
        return Ok(vec![fit_weighted(weighted)?]);
    }
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

/// At most `count` pairs, those with the highest scores first; of equals the earlier.
pub(super) fn keep_best_scored(pairs: &mut Vec<Correspondence>, count: usize) {
    pairs.sort_by(|a, b| b.score.total_cmp(&a.score));
    pairs.truncate(count);
}

/// Step 9: different candidates, the most believable first; of equals, and of those that are almost the same, the
/// earlier.
pub(super) fn rank(candidates: Vec<Candidate>, voxel: f64) -> Vec<Candidate> {
    let mut ranked = candidates;
    ranked.sort_by(|a, b| b.score().total_cmp(&a.score()));
    let mut different: Vec<Candidate> = Vec::with_capacity(ranked.len());
    for candidate in ranked {
        let pose = &candidate.target_from_source;
        if !different.iter().any(|other| alike(pose, &other.target_from_source, voxel)) {
            different.push(candidate);
        }
    }
    different
}

/// The poses that differ, in their order.
pub(super) fn distinct(poses: &[RigidTransform], voxel: f64) -> Vec<RigidTransform> {
    let mut different: Vec<RigidTransform> = Vec::new();
    for pose in poses {
        if !different.iter().any(|other| alike(pose, other, voxel)) {
            different.push(*pose);
        }
    }
    different
}

/// Whether two poses would be polished into the same one: less than 1 degree and half a voxel apart.
fn alike(a: &RigidTransform, b: &RigidTransform, voxel: f64) -> bool {
    let difference = a.error_to(b);
    difference.rotation_degrees < 1.0 && difference.translation < 0.5 * voxel
}

/// The current candidate and the proposed poses, the most believable first; all judged by the surfaces, the sensors and
/// the sets.
pub(super) fn ranked(
    pair: &WorkingPair<'_>,
    current: &Candidate,
    proposed: &[RigidTransform],
    sets: &CorrespondenceSets,
    verifier: &Verifier<'_>,
) -> Vec<Candidate> {
    let voxel = pair.scale.voxel;
    let judge = |pose: RigidTransform| {
        Candidate::judged(pose, current.from_initial, verifier).supported(sets, voxel)
    };
    let mut candidates = vec![current.supported(sets, voxel)];
    candidates.extend(distinct(proposed, voxel).into_iter().map(judge));
    rank(candidates, voxel)
}

/// The most believable of many poses, after a rough alignment, that differ from the current one: those found by features
/// and those around the initial transform.
pub(super) fn screened(
    pair: &WorkingPair<'_>,
    by_features: &[RigidTransform],
    around: &[RigidTransform],
    current: &Candidate,
    verifier: &Verifier<'_>,
) -> Vec<Candidate> {
    let voxel = pair.scale.voxel;
    let mut judged = Vec::new();
    for (poses, from_initial) in [(by_features, false), (around, true)] {
        let moved = moved_onto_surface(pair, &distinct(poses, voxel));
        let moved = distinct(&moved, voxel);
        judged
            .extend(moved.into_iter().map(|pose| Candidate::judged(pose, from_initial, verifier)));
    }
    judged.retain(|other| !alike(&other.target_from_source, &current.target_from_source, voxel));
    rank(judged, voxel)
}

/// The poses after a rough alignment of the surfaces; those that find no surface are left out.
pub(super) fn moved_onto_surface(
    pair: &WorkingPair<'_>,
    starts: &[RigidTransform],
) -> Vec<RigidTransform> {
    let icp = schedule(pair.scale.voxel, &[3.0, 1.5], 0.05);
    let points = &pair.source.coarse;
    let step = points.len().div_ceil(ROUGH_POINTS).max(1);
    let sample: Vec<Point3<f64>> = points.iter().step_by(step).copied().collect();
    let align = |start: &RigidTransform| {
        icp.align(&sample, &pair.target.surface, start).ok().map(|found| found.target_from_source)
    };
    starts.par_iter().filter_map(align).collect()
}

/// The winner moved onto the surfaces, held by the matches of the depth maps where the surfaces slide; kept unless it
/// verifies worse.
pub(super) fn finish(
    pair: &WorkingPair<'_>,
    best: &Candidate,
    sets: &CorrespondenceSets,
    verifier: &Verifier<'_>,
) -> Candidate {
    let contact = &best.evidence.contact;
    let overlap = contact.source_share.min(contact.reference_share).max(f64::EPSILON);
    let icp = AnchoredIcp {
        anchor_weight: (ANCHOR_WEIGHT / (overlap * overlap)).min(MOST_ANCHOR_WEIGHT),
        ..match pair.scale.kind {
            SceneKind::Lidar => AnchoredIcp::for_rotating_scanner(pair.scale.voxel),
            SceneKind::Indoor | SceneKind::Object => AnchoredIcp::for_voxel(pair.scale.voxel),
        }
    };
    let anchors = depth_map_matches(sets).concat();
    let (source, target) = (&pair.source.surface, &pair.target.surface);
    let start = &best.target_from_source;
    let chosen = |surface| chosen_points(surface, &pair.scale);
    let Ok(aligned) = icp.align(source, target, &chosen(source), &chosen(target), &anchors, start)
    else {
        return *best;
    };
    let finished = Candidate::judged(aligned.target_from_source, best.from_initial, verifier)
        .supported(sets, pair.scale.voxel);
    if finished.score() >= best.score() - TOLERATED { finished } else { *best }
}

/// The points of a surface by which it is aligned. A rotating scanner sees what is near in many more points than what is
/// far, which would drown what only far points know, the rotation: there they are spread evenly. Rooms are sampled
/// evenly as they are.
fn chosen_points(surface: &IcpTarget, scale: &Scale) -> Vec<usize> {
    let points = surface.points();
    let all = || (0..points.len()).collect();
    let chosen: Vec<usize> = match scale.kind {
        SceneKind::Lidar => evenly_spread(points, scale.voxel).unwrap_or_else(all),
        SceneKind::Indoor | SceneKind::Object => all(),
    };
    let step = chosen.len().div_ceil(MOST_FINE_POINTS).max(1);
    chosen.into_iter().step_by(step).collect()
}

/// One point of every voxel, of the largest voxels that leave enough; `None` if none do.
fn evenly_spread(points: &[Point3<f64>], voxel: f64) -> Option<Vec<usize>> {
    let spaced = |size: &f64| first_of_every_voxel(points, size * voxel).ok();
    FINE_SPACINGS.iter().filter_map(spaced).find(|chosen| chosen.len() >= ENOUGH_FINE_POINTS)
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
        ..Icp::for_voxel(voxel)
    }
}

#[cfg(test)]
mod tests;
