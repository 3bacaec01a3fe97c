//! MAC: maximal cliques of the compatibility graph as hypotheses (Zhang, Yang, Zhang and Zhang, CVPR 2023).
//!
//! The design: the graph and its second-order weights are sparse ([`score_graph`]); crowded graphs are thinned
//! ([`clustering`]); maximal cliques are enumerated from each node on bit sets over its neighbours ([`cliques`]) and
//! streamed into the heaviest one per node ([`selection`]); each kept clique is fitted, judged by all pairs and the best
//! polished ([`agreement`]).

mod agreement;
mod cliques;
mod clustering;
mod degeneracy;
#[cfg(test)]
mod samples;
mod score_graph;
mod selection;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::data::{Correspondence, PointCloud};
use crate::error::{Error, Result};
use crate::pose::consensus::{self, Difference, Hypothesis};
use crate::pose::{
    CompatibilityGraph, Consistency, Mode, PoseEstimate, PoseEstimator, fit_weighted, significance,
};

pub(super) use agreement::Agreement;
use cliques::Budget;
pub(super) use score_graph::ScoreGraph;
use selection::{Clique, Selection};

/// Pairs of which most agree can make the graph too dense for any bound; then so many pairs, those with the most
/// neighbours, stand for all. Even complete, their graph takes less than half of the default work.
const CORE: usize = 400;

/// Poses looked at beyond those asked for, because the polished one may take the place of some.
const SPARE: usize = 8;

/// How compatible two correspondences are, given the difference `D` of their lengths.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum FirstOrderScore {
    /// `exp(-D^2 / (2 (10 resolution)^2))`.
    Gauss {
        /// The mean distance of neighbouring points of the raw clouds, metres (0.006 in 3DMatch); see
        /// [`crate::data::resolution`].
        resolution: f64,
    },
    /// `1 - D^2 / distance^2`.
    Quadratic {
        /// The inlier distance (tau), metres.
        distance: f64,
    },
}

impl FirstOrderScore {
    pub(super) fn of(self, difference: f32) -> f32 {
        let ratio = difference / self.scale() as f32;
        match self {
            FirstOrderScore::Gauss { .. } => (-0.5 * ratio * ratio).exp(),
            FirstOrderScore::Quadratic { .. } => (1.0 - ratio * ratio).max(0.0),
        }
    }

    /// The difference of lengths, metres, whose score is `bound`.
    pub(super) fn reach(self, bound: f64) -> f64 {
        match self {
            FirstOrderScore::Gauss { .. } => self.scale() * (-2.0 * bound.ln()).sqrt(),
            FirstOrderScore::Quadratic { .. } => self.scale() * (1.0 - bound).sqrt(),
        }
    }

    fn scale(self) -> f64 {
        match self {
            FirstOrderScore::Gauss { resolution } => 10.0 * resolution,
            FirstOrderScore::Quadratic { distance } => distance,
        }
    }
}

/// The settings of MAC (Zhang et al., "3D Registration with Maximal Cliques", CVPR 2023); lengths in metres.
///
/// What [`Mode::Faithful`] keeps of the released code:
/// * the final fits take weighted covariances about unweighted centroids,
/// * of more than `max_points` pairs the first are used.
///
/// [`Mode::Fixed`]: weighted centroids, and the pairs with the best scores. Both modes keep the step of the polishing
/// after which the agreement fell (to take it back made errors larger) and the bins of Otsu's threshold, which decides
/// on when a crowded graph is thinned. In neither mode does ground truth choose between poses, as it does in the released
/// evaluation, and the resolution is a setting instead of being measured for each pair of clouds.
///
/// The number of maximal cliques explodes where most pairs agree. The work is therefore limited, in counted steps and
/// not in seconds, so that the result is the same on every machine and for any number of threads. When the limit is
/// reached, the heaviest cliques found so far are kept and the search begins anew with half of `1 - bound`, then with a
/// tenth of it (0.99, 0.995, 0.999), which makes the graph sparser; if even the last graph is too dense to be formed,
/// the 400 pairs with the most neighbours stand for all. [`PoseEstimate::budget_exhausted`] tells of all of these.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Mac {
    /// A correspondence agrees with a pose if its residual is smaller (tau).
    pub inlier_threshold: f64,
    /// How compatible two correspondences are.
    pub score: FirstOrderScore,
    /// Two correspondences are joined if their score is higher; between 0 and 1, both excluded.
    pub bound: f64,
    /// Cliques with fewer members are passed over; at least 3.
    pub min_clique_size: usize,
    /// Rounds of the final polishing, at most.
    pub polish_rounds: usize,
    /// At most so many pairs are joined into a graph, of `max_points^2 / 8` bytes. All of them judge the poses.
    pub max_points: usize,
    /// At most so many maximal cliques are looked at for each bound.
    pub max_cliques: u64,
    /// At most so many steps (of two nanoseconds or so) are taken for each bound. The default, 1.5 * 10^8, suffices for a
    /// thousand pairs unless most of them agree; where it does not, the three bounds take a second or so of one core.
    /// Many thousands of pairs want more.
    pub max_work: u64,
    /// Whether the scores of the correspondences weigh in fits and judgements; the paper ignores them.
    pub use_scores: bool,
    /// Whether the quirks of the released code (above) are kept.
    pub mode: Mode,
}

impl Mac {
    /// The released settings for 3DMatch with FPFH.
    #[must_use]
    pub fn three_d_match() -> Mac {
        Mac {
            inlier_threshold: 0.10,
            score: FirstOrderScore::Gauss { resolution: 0.006 },
            bound: 0.995,
            min_clique_size: 3,
            polish_rounds: 20,
            max_points: 20_000,
            max_cliques: 2_000_000,
            max_work: 150_000_000,
            use_scores: false,
            mode: Mode::Fixed,
        }
    }

    /// The released settings for 3DLoMatch: a looser bound.
    #[must_use]
    pub fn three_d_lo_match() -> Mac {
        Mac { bound: 0.99, ..Mac::three_d_match() }
    }

    /// The released settings for KITTI with FPFH.
    #[must_use]
    pub fn kitti() -> Mac {
        Mac {
            inlier_threshold: 0.6,
            score: FirstOrderScore::Quadratic { distance: 0.6 },
            bound: 0.9,
            min_clique_size: 4,
            ..Mac::three_d_match()
        }
    }

    /// The settings of 3DMatch (where clouds are sampled at 0.05 m) scaled to clouds sampled at `voxel` metres.
    #[must_use]
    pub fn for_voxel(voxel: f64) -> Mac {
        Mac {
            inlier_threshold: 2.0 * voxel,
            score: FirstOrderScore::Gauss { resolution: 0.12 * voxel },
            ..Mac::three_d_match()
        }
    }

    /// The best `top` poses of which no two are alike (5 degrees, or twice the inlier threshold at the middle of the
    /// pairs), best first; the best one polished, the others as their cliques give them. Fewer, if there are no more.
    ///
    /// # Errors
    /// `InvalidInput` if a setting makes no sense or a pair is not finite; `NoPose` if there are fewer than three pairs
    /// or no three of them are consistent.
    pub fn hypotheses(&self, pairs: &[Correspondence], top: usize) -> Result<Vec<PoseEstimate>> {
        self.validate()?;
        consensus::validate(pairs)?;
        let weighed = consensus::weighed(pairs, self.use_scores);
        let members: Vec<Correspondence> =
            self.limited(pairs).into_iter().map(|i| weighed[i]).collect();
        let mut found = self.cliques(&members);
        found.budget_exhausted |= members.len() < pairs.len();
        self.conclude(&found, &members, &weighed, pairs, top)
    }

    pub(super) fn validate(&self) -> Result<()> {
        for (name, value, below) in [
            ("inlier threshold", self.inlier_threshold, f64::INFINITY),
            ("length of the score", self.score.scale(), f64::INFINITY),
            ("bound", self.bound, 1.0),
        ] {
            if !(value > 0.0 && value < below) {
                return Err(Error::invalid(format!(
                    "the {name} of mac is {value}, it must be above 0 and below {below}"
                )));
            }
        }
        if self.min_clique_size < 3 {
            return Err(Error::invalid(format!(
                "the smallest clique of mac has {} members, a pose needs at least 3",
                self.min_clique_size
            )));
        }
        Ok(())
    }

    /// The indices, ascending, of at most `max_points` of the pairs.
    pub(super) fn limited(&self, pairs: &[Correspondence]) -> Vec<usize> {
        let mut order: Vec<usize> = (0..pairs.len()).collect();
        if self.mode == Mode::Fixed {
            order.sort_by(|&a, &b| pairs[b].score.total_cmp(&pairs[a].score));
        }
        order.truncate(self.max_points);
        order.sort_unstable();
        order
    }

    /// The bounds that are tried one after the other.
    pub(super) fn bounds(&self) -> [f64; 3] {
        [1.0, 0.5, 0.1].map(|share| 1.0 - share * (1.0 - self.bound))
    }

    /// The graph at `bound` with its scores, unless that takes more than the allowed work.
    pub(super) fn score_graph(&self, consistency: &Consistency, bound: f64) -> Option<ScoreGraph> {
        let [graph] = consistency.graphs([self.score.reach(bound)]);
        (ScoreGraph::work(&graph) <= self.max_work)
            .then(|| ScoreGraph::new(consistency, &graph, self.score))
    }

    /// The heaviest maximal cliques, within the limits.
    pub(super) fn cliques(&self, pairs: &[Correspondence]) -> Cliques {
        let consistency = Consistency::new(pairs);
        let mut found = Vec::new();
        for (at, bound) in self.bounds().into_iter().enumerate() {
            if let Some(graph) = self.score_graph(&consistency, bound) {
                let Selection { cliques, complete } = self.select(&graph);
                found.extend(cliques);
                if complete {
                    return Cliques { found, budget_exhausted: at > 0 };
                }
            }
        }
        if found.is_empty() {
            found = self.cliques_of_core(pairs, &consistency);
        }
        Cliques { found, budget_exhausted: true }
    }

    fn select(&self, graph: &ScoreGraph) -> Selection {
        let reduced = clustering::reduced(graph);
        let budget = Budget { work: self.max_work, cliques: self.max_cliques };
        selection::select(reduced.as_ref().unwrap_or(graph), self.min_clique_size, budget)
    }

    /// The cliques among the pairs with the most neighbours at the highest bound.
    fn cliques_of_core(&self, pairs: &[Correspondence], consistency: &Consistency) -> Vec<Clique> {
        let [.., bound] = self.bounds();
        let [graph] = consistency.graphs([self.score.reach(bound)]);
        let core = most_joined(&graph, CORE);
        let members: Vec<Correspondence> = core.iter().map(|&i| pairs[i]).collect();
        let graph = self.score_graph(&Consistency::new(&members), bound);
        let cliques = graph.map_or(Vec::new(), |graph| self.select(&graph).cliques);
        let renumbered =
            |clique: &Clique| clique.iter().map(|&i| core[i as usize] as u32).collect();
        cliques.iter().map(renumbered).collect()
    }

    /// Fits each clique of `members`, judges the poses by `judges` and polishes the best; inliers are those of `pairs`.
    pub(super) fn conclude(
        &self,
        cliques: &Cliques,
        members: &[Correspondence],
        judges: &[Correspondence],
        pairs: &[Correspondence],
        top: usize,
    ) -> Result<Vec<PoseEstimate>> {
        let agreement = Agreement { pairs: judges, threshold: self.inlier_threshold };
        let judged = |pose| Hypothesis { target_from_source: pose, score: agreement.of(&pose) };
        let triple = |&i: &u32| {
            let pair = &members[i as usize];
            (pair.source, pair.target, pair.score)
        };
        let candidates = (cliques.found.par_iter())
            .filter_map(|clique| fit_weighted(clique.iter().map(triple)).ok())
            .map(judged)
            .collect();
        let difference = Difference::new(judges, 2.0 * self.inlier_threshold);
        let mut best = difference.best(candidates, top + SPARE);
        if let Some(first) = best.first_mut() {
            let start = first.target_from_source;
            *first = judged(agreement.polish(start, self.polish_rounds, self.mode));
        }
        // Polished, the first may have come close to others.
        let best = difference.best(best, top);
        self.estimates(&best, cliques, pairs, top)
    }

    fn estimates(
        &self,
        best: &[Hypothesis],
        cliques: &Cliques,
        pairs: &[Correspondence],
        top: usize,
    ) -> Result<Vec<PoseEstimate>> {
        if best.is_empty() && top > 0 {
            return Err(self.no_clique(pairs.len(), cliques));
        }
        let estimate = |(rank, hypothesis): (usize, &Hypothesis)| {
            let pose = hypothesis.target_from_source;
            PoseEstimate {
                target_from_source: pose,
                inliers: consensus::inliers(&pose, pairs, self.inlier_threshold),
                score: hypothesis.score,
                runner_up: best.get(rank + 1).map(|next| next.score),
                iterations: cliques.found.len(),
                budget_exhausted: cliques.budget_exhausted,
            }
        };
        Ok(best.iter().enumerate().map(estimate).collect())
    }

    fn no_clique(&self, count: usize, cliques: &Cliques) -> Error {
        let bound = self.bound;
        if cliques.budget_exhausted && cliques.found.is_empty() {
            return Error::no_pose(format!(
                "{} steps are too few to find a clique among {count} correspondences: allow more",
                self.max_work
            ));
        }
        Error::no_pose(format!(
            "no {} of {count} correspondences are consistent with a score above {bound} and determine a pose: give \
             more or better correspondences or a lower bound",
            self.min_clique_size
        ))
    }
}

/// The heaviest cliques of a set of correspondences.
#[derive(Debug, Clone)]
pub(super) struct Cliques {
    found: Vec<Clique>,
    /// Whether a limit kept others from being found.
    pub(super) budget_exhausted: bool,
}

/// The `count` nodes with the most neighbours, ascending; the first of equals.
fn most_joined(graph: &CompatibilityGraph, count: usize) -> Vec<usize> {
    let mut order: Vec<usize> = (0..graph.len()).collect();
    order.sort_by_key(|&i| std::cmp::Reverse(graph.degree(i)));
    order.truncate(count);
    order.sort_unstable();
    order
}

impl PoseEstimator for Mac {
    /// Uses the pairs alone; `NoPose` also if no more of them agree than random ones would.
    fn estimate(
        &self,
        _source: &PointCloud,
        _target: &PointCloud,
        pairs: &[Correspondence],
    ) -> Result<PoseEstimate> {
        let best = self.hypotheses(pairs, 2)?.into_iter().next();
        let best =
            best.ok_or_else(|| Error::Internal("mac gave neither a pose nor an error".to_owned()))?;
        significance::require(&best.target_from_source, pairs, self.inlier_threshold)?;
        Ok(best)
    }
}
