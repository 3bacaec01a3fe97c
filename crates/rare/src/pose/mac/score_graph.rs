//! The graph of compatible correspondences with its first- and second-order scores, row by row.
//!
//! Only joined pairs are stored, twelve bytes for either direction: the graphs are sparse (about 1 % of the pairs), and
//! a dense one exceeds the limit on the work before it exceeds the memory.

use rayon::prelude::*;

use crate::pose::mac::FirstOrderScore;
use crate::pose::{CompatibilityGraph, Consistency};

/// Neighbours (ascending, without the node itself) and the scores of the edges to them.
#[derive(Debug, Clone)]
pub(in crate::pose) struct ScoreGraph {
    /// Row `i` is at `starts[i]..starts[i + 1]` in the others.
    starts: Vec<usize>,
    neighbours: Vec<u32>,
    /// First order, `s_ij`.
    scores: Vec<f32>,
    /// Second order, `W_ij = s_ij * sum over k of s_ik s_kj`; 0 where `i` and `j` share no neighbour.
    weights: Vec<f32>,
}

impl ScoreGraph {
    /// The steps that [`ScoreGraph::new`] takes for `graph`: for every edge the row of one of its ends.
    pub(in crate::pose) fn work(graph: &CompatibilityGraph) -> u64 {
        (0..graph.len()).map(|i| u64::from(graph.degree(i)).pow(2)).sum()
    }

    /// The scores of the edges of `graph`, which was made from `consistency`.
    pub(in crate::pose) fn new(
        consistency: &Consistency,
        graph: &CompatibilityGraph,
        score: FirstOrderScore,
    ) -> ScoreGraph {
        let mut starts = vec![0];
        let mut neighbours = Vec::new();
        for i in 0..graph.len() {
            neighbours.extend(graph.neighbours(i).filter(|&j| j != i).map(|j| j as u32));
            starts.push(neighbours.len());
        }
        let row = |i: usize| &neighbours[starts[i]..starts[i + 1]];
        let scores: Vec<f32> = (0..graph.len())
            .into_par_iter()
            .flat_map_iter(|i| {
                row(i).iter().map(move |&j| score.of(consistency.difference(i, j as usize)))
            })
            .collect();
        let mut sparse = ScoreGraph { starts, neighbours, scores, weights: Vec::new() };
        sparse.weights = sparse.row_products(&sparse.scores);
        for (weight, score) in sparse.weights.iter_mut().zip(&sparse.scores) {
            *weight *= score;
        }
        sparse
    }

    /// Number of nodes.
    pub(in crate::pose) fn len(&self) -> usize {
        self.starts.len() - 1
    }

    /// Number of edges, counted in both directions.
    pub(in crate::pose) fn edge_ends(&self) -> usize {
        self.neighbours.len()
    }

    pub(in crate::pose) fn neighbours(&self, i: usize) -> &[u32] {
        &self.neighbours[self.starts[i]..self.starts[i + 1]]
    }

    /// First-order scores of the edges to [`ScoreGraph::neighbours`].
    pub(in crate::pose) fn scores(&self, i: usize) -> &[f32] {
        self.row(&self.scores, i)
    }

    /// Second-order weights of the edges to [`ScoreGraph::neighbours`].
    pub(in crate::pose) fn weights(&self, i: usize) -> &[f32] {
        self.row(&self.weights, i)
    }

    /// The second-order weights of all edges, row after row.
    pub(super) fn all_weights(&self) -> &[f32] {
        &self.weights
    }

    /// The part of `values` (one for each edge end) that belongs to node `i`.
    pub(super) fn row<'a>(&self, values: &'a [f32], i: usize) -> &'a [f32] {
        &values[self.starts[i]..self.starts[i + 1]]
    }

    /// `sum over k of v_ik v_kj` for every edge `(i, j)` of a symmetric matrix `v` that vanishes off the edges.
    pub(super) fn row_products(&self, values: &[f32]) -> Vec<f32> {
        let upper: Vec<Vec<f32>> = (0..self.len())
            .into_par_iter()
            .map_init(|| vec![0.0; self.len()], |dense, i| self.products_of_row(values, i, dense))
            .collect();
        let mut products = vec![0.0; values.len()];
        // Rows are ascending: the mirror image of an edge is the next free place of the other row.
        let mut next = self.starts.clone();
        for (i, upper) in upper.into_iter().enumerate() {
            let first = self.starts[i + 1] - upper.len();
            for (at, product) in (first..).zip(upper) {
                let j = self.neighbours[at] as usize;
                products[at] = product;
                products[next[j]] = product;
                next[j] += 1;
            }
        }
        products
    }

    /// The products of row `i` with the rows of its neighbours after it; `dense` is all 0 before and after.
    fn products_of_row(&self, values: &[f32], i: usize, dense: &mut [f32]) -> Vec<f32> {
        for (&k, &value) in self.neighbours(i).iter().zip(self.row(values, i)) {
            dense[k as usize] = value;
        }
        let product = |&j: &u32| -> f32 {
            let other = self.neighbours(j as usize).iter().zip(self.row(values, j as usize));
            other.map(|(&k, value)| dense[k as usize] * value).sum()
        };
        let products =
            self.neighbours(i).iter().filter(|&&j| j as usize > i).map(product).collect();
        for &k in self.neighbours(i) {
            dense[k as usize] = 0.0;
        }
        products
    }

    /// The same graph with the edges between `kept` nodes alone; scores and weights stay.
    pub(super) fn between(&self, kept: &[bool]) -> ScoreGraph {
        let mut graph = ScoreGraph {
            starts: vec![0],
            neighbours: Vec::new(),
            scores: Vec::new(),
            weights: Vec::new(),
        };
        for i in 0..self.len() {
            for at in self.starts[i]..self.starts[i + 1] {
                if kept[i] && kept[self.neighbours[at] as usize] {
                    graph.neighbours.push(self.neighbours[at]);
                    graph.scores.push(self.scores[at]);
                    graph.weights.push(self.weights[at]);
                }
            }
            graph.starts.push(graph.neighbours.len());
        }
        graph
    }
}

#[cfg(test)]
impl ScoreGraph {
    /// `count` nodes joined by a symmetric rule, with scores between 0.9 and 1.
    pub(super) fn joined_by(count: usize, joined: impl Fn(usize, usize) -> bool) -> ScoreGraph {
        let mut graph =
            ScoreGraph { starts: vec![0], neighbours: vec![], scores: vec![], weights: vec![] };
        for i in 0..count {
            for j in (0..count).filter(|&j| j != i && joined(i, j)) {
                graph.neighbours.push(j as u32);
                graph.scores.push(0.9 + 0.1 * ((i * j + 7 * (i + j)) as f32 * 0.618).fract());
            }
            graph.starts.push(graph.neighbours.len());
        }
        graph.weights = graph.row_products(&graph.scores);
        graph.weights.iter_mut().zip(&graph.scores).for_each(|(weight, score)| *weight *= score);
        graph
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pose::mac::samples;

    #[test]
    fn weights_are_the_elementwise_product_of_the_scores_and_their_square() {
        for count in [0, 3, 64, 90] {
            let consistency = Consistency::new(&samples::scattered(count));
            let score = FirstOrderScore::Quadratic { distance: 2.0 };
            let [graph] = consistency.graphs([score.reach(0.5)]);
            let sparse = ScoreGraph::new(&consistency, &graph, score);
            let s = |i: usize, j: usize| {
                let value = 1.0 - (consistency.difference(i, j) / 2.0).powi(2);
                if i != j && value > 0.5 { value } else { 0.0 }
            };
            let mut edges = 0;
            for i in 0..count {
                let row = sparse.neighbours(i).iter().zip(sparse.weights(i)).zip(sparse.scores(i));
                for ((&j, &weight), &score) in row {
                    let j = j as usize;
                    let expected = s(i, j) * (0..count).map(|k| s(i, k) * s(k, j)).sum::<f32>();
                    assert!((score - s(i, j)).abs() < 1e-6 && (weight - expected).abs() < 1e-4);
                    edges += 1;
                }
            }
            let expected = (0..count).flat_map(|i| (0..count).map(move |j| (i, j)));
            assert_eq!(edges, expected.filter(|&(i, j)| s(i, j) > 0.0).count());
            assert!(count < 64 || edges > 100, "{edges}");
        }
    }
}
