//! The maximal cliques that one node begins: Bron and Kerbosch (1973) with the pivots of Tomita, Tanaka and Takahashi
//! (2006), on bit sets over the node's neighbours alone.
//!
//! Called for every node of a degeneracy order with the neighbours after it as candidates and those before it as
//! excluded, this finds every maximal clique once (Eppstein, Loeffler and Strash 2010). The recursion is unrolled onto
//! a stack of sets: a clique may have more members than a thread's stack has room for.

use crate::pose::consistency::ones;
use crate::pose::mac::score_graph::ScoreGraph;

const WORD: usize = u64::BITS as usize;

/// Steps that a word of a set counts for: to combine and count it takes about as long as to follow so many edges.
const STEPS_PER_WORD: u64 = 4;

/// Limits on a search, or what one has used of them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Budget {
    /// Steps: edges that are looked at, and four for each word of a bit set that is combined.
    pub(super) work: u64,
    /// Maximal cliques that are found.
    pub(super) cliques: u64,
}

/// A node, its neighbours and the edges between them.
///
/// Neighbours are numbered locally: first the candidates, then the excluded.
#[derive(Debug, Clone, Default)]
pub(super) struct Neighbourhood {
    node: u32,
    /// The node each local number stands for.
    pub(super) members: Vec<u32>,
    candidates: usize,
    /// Words in a set.
    stride: usize,
    /// The neighbours of each member; those of the excluded among the candidates only.
    adjacency: Vec<u64>,
    /// Weights between candidates, row by row.
    weights: Vec<f32>,
    /// Weights between the node and the candidates.
    node_weights: Vec<f32>,
    /// For each node of the graph its local number plus 1; all 0 outside of [`Neighbourhood::fill`].
    numbers: Vec<u32>,
    work: u64,
}

impl Neighbourhood {
    /// Room for the neighbourhoods of a graph of `size` nodes.
    pub(super) fn new(size: usize) -> Neighbourhood {
        Neighbourhood { numbers: vec![0; size], ..Neighbourhood::default() }
    }

    /// Takes the neighbours of `node`: those of a higher `rank` are candidates.
    pub(super) fn fill(&mut self, graph: &ScoreGraph, rank: &[u32], node: u32) {
        let own_rank = rank[node as usize];
        let neighbours = graph.neighbours(node as usize);
        self.node = node;
        self.members.clear();
        self.node_weights.clear();
        for (&other, &weight) in neighbours.iter().zip(graph.weights(node as usize)) {
            if rank[other as usize] > own_rank {
                self.members.push(other);
                self.node_weights.push(weight);
            }
        }
        self.candidates = self.members.len();
        self.members.extend(neighbours.iter().filter(|&&other| rank[other as usize] < own_rank));
        self.stride = self.members.len().div_ceil(WORD);
        for (number, &member) in (1..).zip(&self.members) {
            self.numbers[member as usize] = number;
        }
        self.fill_edges(graph);
        for &member in &self.members {
            self.numbers[member as usize] = 0;
        }
    }

    fn fill_edges(&mut self, graph: &ScoreGraph) {
        self.adjacency.clear();
        self.adjacency.resize(self.members.len() * self.stride, 0);
        self.weights.clear();
        self.weights.resize(self.candidates * self.candidates, 0.0);
        self.work = (self.adjacency.len() + self.weights.len()) as u64;
        for i in 0..self.candidates {
            let member = self.members[i] as usize;
            for (&other, &weight) in graph.neighbours(member).iter().zip(graph.weights(member)) {
                let number = self.numbers[other as usize] as usize;
                if number > 0 {
                    let j = number - 1;
                    self.adjacency[i * self.stride + j / WORD] |= 1 << (j % WORD);
                    if j < self.candidates {
                        self.weights[i * self.candidates + j] = weight;
                    } else {
                        self.adjacency[j * self.stride + i / WORD] |= 1 << (i % WORD);
                    }
                }
            }
            self.work += graph.neighbours(member).len() as u64;
        }
    }

    fn row(&self, i: usize) -> &[u64] {
        &self.adjacency[i * self.stride..(i + 1) * self.stride]
    }

    fn weight(&self, i: usize, j: usize) -> f64 {
        f64::from(self.weights[i * self.candidates + j])
    }
}

/// The cliques of a [`Neighbourhood`], one after the other.
///
/// The set of level `l` is split into three of `stride` words: members still to be tried, candidates, excluded.
#[derive(Debug, Clone, Default)]
pub(super) struct CliqueSearch {
    sets: Vec<u64>,
    /// Local numbers.
    clique: Vec<u32>,
    /// The weight of the clique up to each level: sums over all its pairs.
    weights: Vec<f64>,
    used: Budget,
}

impl CliqueSearch {
    /// Calls `visit` with the members (local numbers, without the node) and the weight of every maximal clique of
    /// `min_size` nodes or more, until `limit` is reached. Returns what was used, to fill the neighbourhood (which the
    /// limit does not count) and since, and whether all was seen.
    pub(super) fn run(
        &mut self,
        hood: &Neighbourhood,
        min_size: usize,
        limit: Budget,
        mut visit: impl FnMut(&[u32], f64),
    ) -> (Budget, bool) {
        self.used = Budget { work: hood.work, cliques: 0 };
        self.clique.clear();
        self.weights.clear();
        self.weights.push(0.0);
        if 1 + hood.candidates < min_size {
            return (self.used, true);
        }
        self.start(hood);
        let last = limit.work.saturating_add(hood.work);
        while self.used.work < last && self.used.cliques < limit.cliques {
            if let Some(next) = self.take_next(hood) {
                self.extend(hood, min_size, next, &mut visit);
            } else if self.clique.pop().is_some() {
                self.weights.pop();
            } else {
                return (self.used, true);
            }
        }
        (self.used, false)
    }

    fn start(&mut self, hood: &Neighbourhood) {
        self.sets.clear();
        self.sets.resize(3 * hood.stride, 0);
        for i in 0..hood.members.len() {
            let set = if i < hood.candidates { 1 } else { 2 };
            self.sets[set * hood.stride + i / WORD] |= 1 << (i % WORD);
        }
        self.choose_branches(hood);
    }

    /// Removes the first member that is still to be tried at this level.
    fn take_next(&mut self, hood: &Neighbourhood) -> Option<usize> {
        let start = 3 * hood.stride * self.clique.len();
        let next = ones(&self.sets[start..start + hood.stride]).next()?;
        self.sets[start + next / WORD] &= !(1 << (next % WORD));
        Some(next)
    }

    /// Adds `next` to the clique: either that is maximal, or a new level, or neither.
    fn extend(
        &mut self,
        hood: &Neighbourhood,
        min_size: usize,
        next: usize,
        visit: &mut impl FnMut(&[u32], f64),
    ) {
        let (left, closed) = self.split(hood, next);
        let size = 2 + self.clique.len();
        if size + left < min_size || (left == 0 && !closed) {
            return;
        }
        let others: f64 = self.clique.iter().map(|&i| hood.weight(next, i as usize)).sum();
        let weight = f64::from(hood.node_weights[next]) + others;
        let weight = weight + self.weights.last().map_or(0.0, |&weight| weight);
        self.clique.push(next as u32);
        if left > 0 {
            self.weights.push(weight);
            self.choose_branches(hood);
        } else {
            self.used.cliques += 1;
            self.used.work += size as u64;
            visit(&self.clique, weight);
            self.clique.pop();
        }
    }

    /// Writes the candidates and the excluded of the level below `next` and moves `next` to the excluded of this one.
    /// Returns how many candidates there are, and whether nothing is excluded.
    fn split(&mut self, hood: &Neighbourhood, next: usize) -> (usize, bool) {
        let stride = hood.stride;
        let start = 3 * stride * self.clique.len();
        self.sets.resize(self.sets.len().max(start + 6 * stride), 0);
        let (above, below) = self.sets[start..].split_at_mut(3 * stride);
        let (mut left, mut closed) = (0, true);
        for (w, neighbours) in hood.row(next).iter().enumerate() {
            below[stride + w] = above[stride + w] & neighbours;
            below[2 * stride + w] = above[2 * stride + w] & neighbours;
            left += below[stride + w].count_ones() as usize;
            closed &= below[2 * stride + w] == 0;
        }
        above[stride + next / WORD] &= !(1 << (next % WORD));
        above[2 * stride + next / WORD] |= 1 << (next % WORD);
        self.used.work += STEPS_PER_WORD * 2 * stride as u64;
        (left, closed)
    }

    /// Finds the pivot of this level, the member joined to most candidates; the candidates not joined to it are to be
    /// tried.
    fn choose_branches(&mut self, hood: &Neighbourhood) {
        let stride = hood.stride;
        let start = 3 * stride * self.clique.len();
        let (branches, rest) = self.sets[start..start + 3 * stride].split_at_mut(stride);
        let (candidates, excluded) = rest.split_at(stride);
        let words = hood.candidates.div_ceil(WORD);
        let joined = |i: usize| -> u32 {
            let both = hood.row(i)[..words].iter().zip(candidates).map(|(a, b)| a & b);
            both.map(u64::count_ones).sum()
        };
        let total: u32 = candidates.iter().map(|word| word.count_ones()).sum();
        let mut best = (0, 0);
        for i in ones(excluded).chain(ones(candidates)) {
            let count = joined(i);
            self.used.work += STEPS_PER_WORD * words as u64;
            if best.0 == 0 || count > best.1 {
                best = (i + 1, count);
            }
            // One branch at most is left: no pivot is better.
            if count + 1 >= total {
                break;
            }
        }
        let pivot = hood.row(best.0.saturating_sub(1));
        for ((branch, candidates), neighbours) in branches.iter_mut().zip(candidates).zip(pivot) {
            *branch = candidates & !neighbours;
        }
    }
}
