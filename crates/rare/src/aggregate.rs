//! Step 8: from the correspondence sets to one transform (section 3.3, "Inlier Aggregation Module").
//!
//! Every set proposes a transform, all correspondences vote on the proposals, the winner is refitted to its inliers a
//! few times and at last to the best of them. The stages are functions of their own, because proposals may come from
//! elsewhere too: [`aggregate`] proposes by weighted least squares per set, as the paper does;
//! [`aggregate_candidates`] takes any transforms.
//!
//! The paper prints `R p + t - q` with `p` of the reference cloud; transforms here move the source, as its overview
//! and its code base GeoTransformer have it. The paper squares the distance in equation (5); compared is the distance
//! itself, as in GeoTransformer, whose radius the paper names.

use serde::{Deserialize, Serialize};

use crate::data::{Correspondence, CorrespondenceSet, CorrespondenceSets, RigidTransform, SetName};
use crate::error::{Error, Result};
use crate::pose::fit_weighted;

/// The settings of the aggregation.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Aggregation {
    /// A correspondence is an inlier if the transform takes its source point closer than this to its target, metres
    /// (the paper's `tau_a`).
    pub acceptance_radius: f64,
    /// How often the winner is refitted to its inliers (the paper's `N_r`, which it does not give).
    pub reweighting_rounds: usize,
    /// How many of the highest-scoring inliers the last fit takes (the paper's `K`, which it does not give).
    pub top: usize,
}

impl Aggregation {
    /// Rooms: 10 cm, GeoTransformer's radius for 3DMatch.
    #[must_use]
    pub fn indoor() -> Aggregation {
        Aggregation { acceptance_radius: 0.1, reweighting_rounds: 5, top: 250 }
    }

    /// Streets: 60 cm, GeoTransformer's radius for KITTI.
    #[must_use]
    pub fn kitti() -> Aggregation {
        Aggregation { acceptance_radius: 0.6, ..Aggregation::indoor() }
    }
}

/// What one set proposed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SetProposal {
    /// The set.
    pub name: SetName,
    /// How many correspondences it has.
    pub pairs: usize,
    /// Its transform; `None` if it has fewer than three correspondences or they lie on a line.
    pub candidate: Option<Candidate>,
}

/// A proposed transform and the votes for it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Candidate {
    /// Moves points of the source into the target's frame.
    pub target_from_source: RigidTransform,
    /// How many correspondences of all sets agree.
    pub inliers: usize,
}

/// The transform that the sets agree on.
#[derive(Debug, Clone, PartialEq)]
pub struct Aggregated {
    /// What every set proposed, in the order of the sets.
    pub proposals: Vec<SetProposal>,
    /// The set whose proposal won; `None` if the initial transform did.
    pub best_set: Option<SetName>,
    /// What became of the winner.
    pub consensus: Consensus,
}

/// A transform refitted to the correspondences that agree with it.
#[derive(Debug, Clone, PartialEq)]
pub struct Consensus {
    /// Moves points of the source into the target's frame.
    pub target_from_source: RigidTransform,
    /// Index of the candidate that won the vote.
    pub best_candidate: usize,
    /// Votes for every candidate.
    pub votes: Vec<usize>,
    /// Inliers at the start of every round of re-weighting.
    pub inliers_per_round: Vec<usize>,
    /// Which correspondences (indices into the union of the sets) the last fit used, highest score first.
    pub selected: Vec<usize>,
}

/// Fits a transform to each set, lets all correspondences vote, re-weights the winner and refits it to the top.
///
/// `initial`, if given, stands for election after the sets: then the winner has at least as many inliers as it.
///
/// # Errors
/// `NoPose` if no set determines a transform and there is no `initial`; the message says how many pairs each set has.
///
/// ```
/// use rare::aggregate::{Aggregation, aggregate};
/// use rare::nalgebra::{Point3, Rotation3, Vector3};
/// use rare::{Correspondence, CorrespondenceSet, CorrespondenceSets, RigidTransform, SetName};
/// let truth = RigidTransform::new(Rotation3::new(Vector3::new(0.0, 0.2, 0.0)), Vector3::x());
/// let points = (0..10).map(|i| Point3::new(f64::from(i % 3), f64::from(i % 4), f64::from(i)));
/// let pairs = points.map(|source| Correspondence { source, target: truth.apply(&source), score: 0.9 });
/// let set = CorrespondenceSet { name: SetName::DiffusionReference, pairs: pairs.collect() };
/// let sets = CorrespondenceSets { sets: vec![set] };
/// let found = aggregate(&sets, &Aggregation::indoor(), None)?;
/// assert_eq!(found.best_set, Some(SetName::DiffusionReference));
/// assert!(found.consensus.target_from_source.error_to(&truth).translation < 1e-9);
/// # Ok::<(), rare::Error>(())
/// ```
pub fn aggregate(
    sets: &CorrespondenceSets,
    config: &Aggregation,
    initial: Option<&RigidTransform>,
) -> Result<Aggregated> {
    // Equation (4), for every set i.
    let fits: Vec<Option<RigidTransform>> = sets.sets.iter().map(fit_set).collect();
    let candidates: Vec<_> = fits.iter().flatten().chain(initial).copied().collect();
    if candidates.is_empty() {
        return Err(no_candidate(sets));
    }
    let consensus = aggregate_candidates(&sets.union(), &candidates, config)?;
    let mut votes = consensus.votes.iter().copied();
    let mut propose =
        |target_from_source| Some(Candidate { target_from_source, inliers: votes.next()? });
    let proposals: Vec<SetProposal> = sets
        .sets
        .iter()
        .zip(fits)
        .map(|(set, fit)| SetProposal {
            name: set.name,
            pairs: set.pairs.len(),
            candidate: fit.and_then(&mut propose),
        })
        .collect();
    let mut proposed = proposals.iter().filter(|proposal| proposal.candidate.is_some());
    let best_set = proposed.nth(consensus.best_candidate).map(|proposal| proposal.name);
    Ok(Aggregated { proposals, best_set, consensus })
}

/// The vote, re-weighting and final fit over all correspondences, for candidates from anywhere. The first of equally
/// supported candidates wins.
///
/// # Errors
/// `NoPose` if there is no candidate.
pub fn aggregate_candidates(
    pairs: &[Correspondence],
    candidates: &[RigidTransform],
    config: &Aggregation,
) -> Result<Consensus> {
    let votes = vote(pairs, candidates, config.acceptance_radius);
    // The last maximum of the reversed order is the first one.
    let best = votes.iter().enumerate().rev().max_by_key(|&(_, &count)| count);
    let Some((best_candidate, winner)) = best.and_then(|(i, _)| Some((i, candidates.get(i)?)))
    else {
        return Err(Error::no_pose("there is no candidate transform to vote on"));
    };
    let (reweighted, inliers_per_round) = reweight(pairs, winner, config);
    let selected = top_scoring(pairs, &reweighted, config);
    let best_pairs: Vec<Correspondence> = selected.iter().map(|&index| pairs[index]).collect();
    let target_from_source = fit(&best_pairs).unwrap_or(reweighted);
    Ok(Consensus { target_from_source, best_candidate, votes, inliers_per_round, selected })
}

/// How many of the pairs each candidate brings closer together than `radius` metres.
///
/// ```
/// use rare::nalgebra::{Point3, Vector3};
/// use rare::{Correspondence, RigidTransform, aggregate::vote};
/// let pair = |shift: f64| Correspondence {
///     source: Point3::origin(),
///     target: Point3::new(shift, 0.0, 0.0),
///     score: 1.0,
/// };
/// let pairs: Vec<_> = (0..10).map(|i| pair(if i < 7 { 1.0 } else { 3.0 })).collect();
/// let candidates =
///     [RigidTransform::identity(), RigidTransform::from_translation(Vector3::new(0.95, 0.0, 0.0))];
/// assert_eq!(vote(&pairs, &candidates, 0.1), [0, 7]);
/// ```
#[must_use]
pub fn vote(pairs: &[Correspondence], candidates: &[RigidTransform], radius: f64) -> Vec<usize> {
    // Equation (5).
    let votes = |candidate| pairs.iter().filter(|pair| agrees(pair, candidate, radius)).count();
    candidates.iter().map(votes).collect()
}

/// Refits the transform to its inliers, `reweighting_rounds` times; ends early, with the last transform, when the
/// inliers no longer determine one. Returns it and the number of inliers that each round began with.
#[must_use]
pub fn reweight(
    pairs: &[Correspondence],
    start: &RigidTransform,
    config: &Aggregation,
) -> (RigidTransform, Vec<usize>) {
    let mut target_from_source = *start;
    let mut inliers_per_round = Vec::with_capacity(config.reweighting_rounds.min(pairs.len()));
    for _ in 0..config.reweighting_rounds {
        let inliers: Vec<Correspondence> = pairs
            .iter()
            .filter(|pair| agrees(pair, &target_from_source, config.acceptance_radius))
            .copied()
            .collect();
        inliers_per_round.push(inliers.len());
        let Some(refitted) = fit(&inliers) else { break };
        target_from_source = refitted;
    }
    (target_from_source, inliers_per_round)
}

/// The indices of the `top` highest-scoring pairs that agree with the transform, highest score first, equal scores in
/// the order of the pairs.
#[must_use]
pub fn top_scoring(
    pairs: &[Correspondence],
    target_from_source: &RigidTransform,
    config: &Aggregation,
) -> Vec<usize> {
    let mut inliers: Vec<usize> = (0..pairs.len())
        .filter(|&index| agrees(&pairs[index], target_from_source, config.acceptance_radius))
        .collect();
    inliers.sort_by(|&a, &b| weight(&pairs[b]).total_cmp(&weight(&pairs[a])));
    inliers.truncate(config.top);
    inliers
}

fn agrees(pair: &Correspondence, target_from_source: &RigidTransform, radius: f64) -> bool {
    (target_from_source.apply(&pair.source) - pair.target).norm() < radius
}

/// The score as a weight: what is not a number says nothing.
fn weight(pair: &Correspondence) -> f64 {
    pair.score.max(0.0)
}

fn fit_set(set: &CorrespondenceSet) -> Option<RigidTransform> {
    fit(&set.pairs)
}

/// Equation (4): the weighted least-squares transform; `None` for fewer than three pairs or pairs on a line.
fn fit(pairs: &[Correspondence]) -> Option<RigidTransform> {
    fit_weighted(pairs.iter().map(|pair| (pair.source, pair.target, weight(pair)))).ok()
}

fn no_candidate(sets: &CorrespondenceSets) -> Error {
    let counts: Vec<String> =
        sets.sets.iter().map(|set| format!("{} has {}", set.name, set.pairs.len())).collect();
    Error::no_pose(format!(
        "no set of correspondences determines a transform, which takes three that are not on one line ({})",
        if counts.is_empty() { "there is no set".to_owned() } else { counts.join(", ") }
    ))
}
