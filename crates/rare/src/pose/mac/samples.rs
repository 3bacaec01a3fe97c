//! Correspondences and graphs for the tests.

use nalgebra::Point3;

use crate::data::Correspondence;
use crate::pose::mac::score_graph::ScoreGraph;
use crate::random::Random;

/// Pairs that follow no motion, a metre or so across.
pub(super) fn scattered(count: usize) -> Vec<Correspondence> {
    let mut random = Random::new(12, 0);
    let mut point = || Point3::from([0; 3].map(|_| random.normal()));
    (0..count).map(|_| Correspondence { source: point(), target: point(), score: 1.0 }).collect()
}

/// A graph in which every two nodes are joined with the probability `share`.
pub(super) fn random_graph(count: usize, share: f64, seed: u64) -> ScoreGraph {
    let joined = |i: usize, j: usize| {
        Random::new(seed, (i.min(j) * count + i.max(j)) as u64).uniform() < share
    };
    ScoreGraph::joined_by(count, joined)
}
