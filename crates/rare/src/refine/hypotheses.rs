//! Candidate transforms: where they come from, and which one wins.

use nalgebra::Point3;
use rayon::prelude::*;

use crate::aggregate::{Aggregation, aggregate, aggregate_candidates};
use crate::data::{Correspondence, CorrespondenceSets, RigidTransform};
use crate::error::Result;
use crate::pose::{Icp, IcpStage, RobustKernel, Sc2Pcr, fit_weighted};
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
        ..Icp::for_voxel(voxel)
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Point3, Rotation3, Vector3};

    use super::*;
    use crate::data::{Camera, CorrespondenceSet, Intrinsics, SetName};
    use crate::random::Random;
    use crate::scale::SceneKind;
    use crate::viewpoints::{Frame, Viewpoint};

    const VOXEL: f64 = 0.05;

    fn along_z(by: f64) -> RigidTransform {
        RigidTransform::from_translation(Vector3::new(0.0, 0.0, by))
    }

    /// A plane 2 m before a camera.
    fn plane() -> Vec<Point3<f64>> {
        let at = |i: i32| f64::from(i) * 0.05;
        (-8..8).flat_map(|x| (-8..8).map(move |y| Point3::new(at(x), at(y), 2.0))).collect()
    }

    fn with_verifier<T>(judge: impl FnOnce(&Verifier<'_>) -> T) -> T {
        let intrinsics =
            Intrinsics { width: 64, height: 64, fx: 80.0, fy: 80.0, cx: 32.0, cy: 32.0 };
        let camera = Camera { intrinsics, camera_from_world: RigidTransform::identity() };
        let viewpoint = Viewpoint { frame: Frame::Reference, camera };
        let points = plane();
        judge(&Verifier::new(&points, &points, &[viewpoint], VOXEL))
    }

    fn poses(ranked: &[Candidate]) -> Vec<f64> {
        ranked.iter().map(|candidate| candidate.target_from_source.translation().z).collect()
    }

    #[test]
    fn the_most_consistent_comes_first() {
        with_verifier(|verifier| {
            let current = Candidate::judged(along_z(-0.5), verifier);
            let ranked = rank(&[along_z(0.6), along_z(0.0)], &current, verifier, VOXEL);
            // Behind the plane nothing is violated, before it everything.
            assert_eq!(poses(&ranked), [0.0, 0.6, -0.5]);
            assert_eq!(ranked[0], Candidate::judged(along_z(0.0), verifier));
        });
    }

    #[test]
    fn of_equals_the_current_one_wins_then_the_earlier() {
        with_verifier(|verifier| {
            let current = Candidate::judged(along_z(0.7), verifier);
            let ranked = rank(&[along_z(0.9), along_z(0.5)], &current, verifier, VOXEL);
            let scores: Vec<f64> = ranked.iter().map(|c| c.consistency.score()).collect();
            assert_eq!(scores, [0.0; 3]);
            assert_eq!(poses(&ranked), [0.7, 0.9, 0.5]);
        });
    }

    #[test]
    fn of_almost_equal_hypotheses_the_first_is_kept() {
        with_verifier(|verifier| {
            let turned = |degrees: f64| {
                let turn = Rotation3::from_axis_angle(&Vector3::z_axis(), degrees.to_radians());
                RigidTransform::new(turn, Vector3::new(0.0, 0.0, 0.5))
            };
            let proposed = [turned(0.0), along_z(0.524), turned(0.9), along_z(0.526), turned(1.1)];
            let current = Candidate::judged(along_z(0.0), verifier);
            let ranked = rank(&proposed, &current, verifier, VOXEL);
            let kept: Vec<RigidTransform> =
                ranked[1..].iter().map(|candidate| candidate.target_from_source).collect();
            assert_eq!(kept, [proposed[0], proposed[3], proposed[4]]);
        });
    }

    #[test]
    fn a_pose_has_settled_when_it_hardly_moves() {
        with_verifier(|verifier| {
            let at = |pose| Candidate::judged(pose, verifier);
            let start = at(along_z(0.0));
            let turned = |degrees: f64| {
                let turn = Rotation3::from_axis_angle(&Vector3::y_axis(), degrees.to_radians());
                at(RigidTransform::new(turn, Vector3::zeros()))
            };
            assert!(at(along_z(0.0049)).settled(&start, VOXEL));
            assert!(!at(along_z(0.0051)).settled(&start, VOXEL));
            assert!(turned(0.09).settled(&start, VOXEL) && !turned(0.11).settled(&start, VOXEL));
        });
    }

    /// 12 right pairs and 88 random ones in one set.
    fn sets(truth: &RigidTransform) -> CorrespondenceSets {
        let mut random = Random::new(7, 0);
        let mut pair = |index: usize| {
            let mut somewhere = || Point3::from(Vector3::from_fn(|_, _| 3.0 * random.uniform()));
            let (source, elsewhere) = (somewhere(), somewhere());
            let target = truth.apply(if index < 12 { &source } else { &elsewhere });
            Correspondence { source, target, score: 1.0 }
        };
        let pairs = (0..100).map(&mut pair).collect();
        CorrespondenceSets { sets: vec![CorrespondenceSet { name: SetName::Features3d, pairs }] }
    }

    #[test]
    fn consensus_finds_what_one_fit_over_all_pairs_misses() {
        let truth = RigidTransform::new(Rotation3::new(Vector3::new(0.4, 0.2, -0.1)), Vector3::x());
        let scale = Scale::with_voxel(SceneKind::Indoor, VOXEL);
        let paper = propose(&Recipe::paper(), &scale, &sets(&truth)).unwrap();
        assert_eq!(paper.len(), 1);
        assert!(paper[0].error_to(&truth).translation > 0.05, "{paper:?}");
        let ours = propose(&Recipe::default(), &scale, &sets(&truth)).unwrap();
        assert!(ours.len() > 1);
        assert!(ours[0].error_to(&truth).translation < 1e-6, "{:?}", ours[0]);
        let nothing = CorrespondenceSets::default();
        assert!(propose(&Recipe::default(), &scale, &nothing).is_err());
    }

    #[test]
    fn the_best_scored_pairs_are_kept_in_order() {
        let at = Point3::origin();
        let mut pairs: Vec<Correspondence> = [0.1, 0.9, 0.5, 0.9]
            .iter()
            .zip(0..)
            .map(|(&score, x)| Correspondence {
                source: Point3::new(f64::from(x), 0.0, 0.0),
                target: at,
                score,
            })
            .collect();
        keep_best_scored(&mut pairs, 3);
        let kept: Vec<f64> = pairs.iter().map(|pair| pair.source.x).collect();
        assert_eq!(kept, [1.0, 3.0, 2.0]);
    }
}
