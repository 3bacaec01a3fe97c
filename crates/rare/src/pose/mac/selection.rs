//! Every node keeps the heaviest maximal clique it belongs to (the node-guided selection of MAC).
//!
//! Cliques are streamed: no more than one per node is held. Nodes are searched in parallel in blocks of fixed size and
//! their finds merged in order; the limits on the work are shared out in advance, so that neither the number of threads
//! nor the clock shows in the result.

use std::sync::Arc;

use rayon::prelude::*;

use crate::pose::mac::cliques::{Budget, CliqueSearch, Neighbourhood};
use crate::pose::mac::degeneracy::degeneracy_order;
use crate::pose::mac::score_graph::ScoreGraph;

/// Nodes searched between two merges; independent of the number of threads.
const BLOCK: usize = 256;

/// The members of a clique, nodes of the graph.
pub(in crate::pose) type Clique = Arc<[u32]>;

/// A clique and the sum of the weights over its pairs.
#[derive(Debug, Clone)]
struct Weighed {
    weight: f64,
    clique: Clique,
}

/// What is left of all maximal cliques.
#[derive(Debug, Clone)]
pub(super) struct Selection {
    /// The heaviest clique of each node, without repeats, in the order of the first node that keeps it.
    pub(super) cliques: Vec<Clique>,
    /// Whether all maximal cliques were seen.
    pub(super) complete: bool,
}

/// The heaviest maximal clique of `min_size` nodes or more for each node, as far as `budget` goes.
///
/// The budget is shared out evenly. What nodes leave over is shared among those it did not suffice, which begin anew,
/// as long as that at least doubles their share.
pub(super) fn select(graph: &ScoreGraph, min_size: usize, mut budget: Budget) -> Selection {
    let order = degeneracy_order(graph);
    let mut rank = vec![0; graph.len()];
    for (at, &node) in (0..).zip(&order) {
        rank[node as usize] = at;
    }
    let mut best: Vec<Option<Weighed>> = vec![None; graph.len()];
    let mut pending = order;
    let mut share = Budget::default();
    while let Some(next) = next_share(budget, share, pending.len()) {
        share = next;
        let mut unfinished = Vec::new();
        for block in pending.chunks(BLOCK) {
            for (&node, found) in block.iter().zip(search(graph, &rank, min_size, share, block)) {
                budget.work = budget.work.saturating_sub(found.used.work);
                budget.cliques = budget.cliques.saturating_sub(found.used.cliques);
                found
                    .heaviest
                    .into_iter()
                    .for_each(|(node, weighed)| keep(&mut best, node, weighed));
                if !found.complete {
                    unfinished.push(node);
                }
            }
        }
        pending = unfinished;
    }
    Selection { cliques: without_repeats(&best), complete: pending.is_empty() }
}

/// What each of `count` nodes may use, unless that is nothing or less than twice as much as `last` time.
fn next_share(left: Budget, last: Budget, count: usize) -> Option<Budget> {
    let count = count as u64;
    let next =
        Budget { work: left.work.checked_div(count)?, cliques: left.cliques.checked_div(count)? };
    let grown = next.work >= (2 * last.work).max(1) && next.cliques >= (2 * last.cliques).max(1);
    grown.then_some(next)
}

/// What the search from one node found.
struct Found {
    heaviest: Vec<(u32, Weighed)>,
    used: Budget,
    complete: bool,
}

fn search(
    graph: &ScoreGraph,
    rank: &[u32],
    min_size: usize,
    share: Budget,
    nodes: &[u32],
) -> Vec<Found> {
    let workspace = || (Neighbourhood::new(graph.len()), CliqueSearch::default());
    (nodes.par_iter())
        .map_init(workspace, |(hood, cliques), &node| {
            hood.fill(graph, rank, node);
            let mut best: Vec<Option<Weighed>> = vec![None; hood.members.len() + 1];
            let own = hood.members.len();
            let (used, complete) = cliques.run(hood, min_size, share, |members, weight| {
                let places = || members.iter().map(|&i| i as usize).chain([own]);
                let is_better = |place: usize| {
                    best[place].as_ref().is_none_or(|weighed: &Weighed| weight > weighed.weight)
                };
                if places().any(is_better) {
                    let members = members.iter().map(|&i| hood.members[i as usize]);
                    let clique: Clique = members.chain([node]).collect();
                    for place in places() {
                        keep(&mut best, place as u32, Weighed { weight, clique: clique.clone() });
                    }
                }
            });
            let nodes = hood.members.iter().copied().chain([node]);
            let heaviest = nodes.zip(best).filter_map(|(node, weighed)| Some((node, weighed?)));
            Found { heaviest: heaviest.collect(), used, complete }
        })
        .collect()
}

/// The first of equally heavy cliques stays.
fn keep(best: &mut [Option<Weighed>], place: u32, weighed: Weighed) {
    let held = &mut best[place as usize];
    if held.as_ref().is_none_or(|held| weighed.weight > held.weight) {
        *held = Some(weighed);
    }
}

/// The cliques in the order of the first node that keeps each.
fn without_repeats(best: &[Option<Weighed>]) -> Vec<Clique> {
    let keeps = |node: u32, clique: &Clique| {
        best[node as usize].as_ref().is_some_and(|held| Arc::ptr_eq(&held.clique, clique))
    };
    let first = |(node, held): (u32, &Option<Weighed>)| {
        let clique = &held.as_ref()?.clique;
        let before = clique.iter().any(|&other| other < node && keeps(other, clique));
        (!before).then(|| clique.clone())
    };
    (0..).zip(best).filter_map(first).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pose::mac::samples;

    const UNLIMITED: Budget = Budget { work: u64::MAX, cliques: u64::MAX };

    /// All maximal cliques of three nodes or more of a graph of up to 20 nodes, by trying all sets.
    fn all_maximal(graph: &ScoreGraph) -> Vec<(Vec<u32>, f64)> {
        let size = graph.len();
        let mask = |i: usize| graph.neighbours(i).iter().fold(0_u32, |mask, &j| mask | 1 << j);
        let rows: Vec<u32> = (0..size).map(mask).collect();
        let members = |set: u32| (0..size as u32).filter(move |i| set >> i & 1 == 1);
        let shared =
            |set: u32| members(set).fold(u32::MAX >> (32 - size), |all, i| all & rows[i as usize]);
        (0..1_u32 << size)
            .filter(|&set| set.count_ones() >= 3)
            .filter(|&set| members(set).all(|i| set & !(1 << i) & !rows[i as usize] == 0))
            .filter(|&set| shared(set) == 0)
            .map(|set| {
                (members(set).collect(), weight_of(graph, &members(set).collect::<Vec<_>>()))
            })
            .collect()
    }

    fn weight_of(graph: &ScoreGraph, clique: &[u32]) -> f64 {
        let inside = |i: u32| {
            let row = graph.neighbours(i as usize).iter().zip(graph.weights(i as usize));
            row.filter(|(j, _)| clique.contains(j))
                .map(|(_, &weight)| f64::from(weight))
                .sum::<f64>()
        };
        clique.iter().map(|&i| inside(i)).sum::<f64>() / 2.0
    }

    /// The cliques of all nodes, sorted, as often as they are found.
    fn enumerate(graph: &ScoreGraph, min_size: usize) -> Vec<(Vec<u32>, f64)> {
        let order = degeneracy_order(graph);
        let mut rank = vec![0; graph.len()];
        (0..).zip(&order).for_each(|(at, &node)| rank[node as usize] = at);
        let (mut hood, mut search) = (Neighbourhood::new(graph.len()), CliqueSearch::default());
        let mut found = Vec::new();
        for &node in &order {
            hood.fill(graph, &rank, node);
            search.run(&hood, min_size, UNLIMITED, |members, weight| {
                let members = members.iter().map(|&i| hood.members[i as usize]);
                let mut clique: Vec<u32> = members.chain([node]).collect();
                clique.sort_unstable();
                found.push((clique, weight));
            });
        }
        found.sort_by(|a, b| a.0.cmp(&b.0));
        found
    }

    #[test]
    fn every_maximal_clique_is_found_once_with_its_weight() {
        let mut total = 0;
        for seed in 0..40 {
            let (size, share) = (6 + seed as usize % 11, [0.2, 0.5, 0.8, 1.0][seed as usize % 4]);
            let graph = samples::random_graph(size, share, seed);
            let mut expected = all_maximal(&graph);
            expected.sort_by(|a, b| a.0.cmp(&b.0));
            let found = enumerate(&graph, 3);
            assert_eq!(found.len(), expected.len());
            for (found, expected) in found.iter().zip(&expected) {
                assert_eq!(found.0, expected.0);
                assert!((found.1 - expected.1).abs() < 1e-5 * expected.1, "{found:?} {expected:?}");
            }
            let large = expected.iter().filter(|(clique, _)| clique.len() >= 5).count();
            assert_eq!(enumerate(&graph, 5).len(), large);
            total += found.len();
        }
        assert!(total > 200, "{total}");
    }

    #[test]
    fn sets_longer_than_a_word_work() {
        // Cliques of 100 nodes that share 50.
        let joined = |i: usize, j: usize| i < 50 || j < 50 || (i < 100) == (j < 100);
        let graph = ScoreGraph::joined_by(150, joined);
        let found = enumerate(&graph, 3);
        let sizes: Vec<usize> = found.iter().map(|(clique, _)| clique.len()).collect();
        assert_eq!(sizes, [100, 100]);
        let random = samples::random_graph(150, 0.3, 5);
        let found = enumerate(&random, 3);
        let mut unique = found.clone();
        unique.dedup_by(|a, b| a.0 == b.0);
        assert_eq!(unique.len(), found.len());
        assert!(unique.len() > 1000);
        for (clique, _) in &unique {
            let row = |&i: &u32| random.neighbours(i as usize);
            let joined_to_all = |i: &u32| clique.iter().all(|member| row(member).contains(i));
            assert!(!(0..150).any(|i| joined_to_all(&i)), "{clique:?} is not maximal");
        }
    }

    #[test]
    fn each_node_keeps_its_heaviest_clique() {
        let graph = samples::random_graph(16, 0.5, 3);
        let all = all_maximal(&graph);
        let kept = select(&graph, 3, UNLIMITED);
        assert!(kept.complete);
        let weights: Vec<f64> =
            kept.cliques.iter().map(|clique| weight_of(&graph, clique)).collect();
        for node in 0..16 {
            let heaviest = all.iter().filter(|(clique, _)| clique.contains(&node));
            let heaviest = heaviest.map(|&(_, weight)| weight).fold(0.0, f64::max);
            let ours =
                kept.cliques.iter().zip(&weights).filter(|(clique, _)| clique.contains(&node));
            let ours = ours.map(|(_, &weight)| weight).fold(0.0, f64::max);
            assert!((ours - heaviest).abs() < 1e-5 * heaviest, "node {node}: {ours} {heaviest}");
        }
        assert!(kept.cliques.len() < all.len(), "{} {}", kept.cliques.len(), all.len());
    }

    #[test]
    fn limits_are_kept_and_what_was_found_stays() {
        let graph = samples::random_graph(120, 0.7, 7);
        let all = select(&graph, 3, UNLIMITED);
        assert!(all.complete);
        for budget in [Budget { work: 300_000, ..UNLIMITED }, Budget { cliques: 1000, ..UNLIMITED }]
        {
            let some = select(&graph, 3, budget);
            assert!(!some.complete && !some.cliques.is_empty());
            for clique in &some.cliques {
                let joined = |i: &u32, j: &u32| i == j || graph.neighbours(*i as usize).contains(j);
                assert!(clique.iter().all(|i| clique.iter().all(|j| joined(i, j))));
            }
        }
        assert!(select(&graph, 3, Budget::default()).cliques.is_empty());
    }
}
