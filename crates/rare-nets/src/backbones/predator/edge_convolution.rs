//! Convolutions on the graph of nearest points (Wang et al.: Dynamic graph CNN, ACM Transactions on Graphics 2019).

use rare::{Error, Result};
use rayon::prelude::*;

use crate::Matrix;
use crate::backbones::kpconv::Point;
use crate::engine::CpuBackend;
use crate::layers::{Activation, Linear, Weights, instance_normalization};

/// The nearest other points of each point of a cloud.
pub(super) struct Graph {
    /// For every point the same number of others.
    neighbours: Vec<Vec<usize>>,
    degree: usize,
}

impl Graph {
    /// Finds the `degree` nearest others, or all others where there are fewer.
    pub(super) fn new(points: &[Point], degree: usize) -> Graph {
        let degree = degree.min(points.len().saturating_sub(1));
        let nearest = |(index, point): (usize, &Point)| {
            let others = points.iter().enumerate().filter(|(other, _)| *other != index);
            let mut others: Vec<(f64, usize)> =
                others.map(|(other, place)| (squared_distance(point, place), other)).collect();
            if let Some(last) = degree.checked_sub(1) {
                others.select_nth_unstable_by(last, |a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
            }
            others.truncate(degree);
            others.sort_unstable_by_key(|(_, other)| *other);
            others.into_iter().map(|(_, other)| other).collect()
        };
        Graph { neighbours: points.par_iter().enumerate().map(nearest).collect(), degree }
    }

    /// Neighbours of each point.
    pub(super) fn degree(&self) -> usize {
        self.degree
    }
}

fn squared_distance(a: &Point, b: &Point) -> f64 {
    a.iter().zip(b).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)).sum()
}

/// A linear layer of each edge `[x_i, x_j - x_i]`, normalised over all edges of a cloud; of the edges of a point the
/// largest value of each channel counts.
///
/// The layer is that of `x_i`, with the weights of the difference subtracted, plus that of `x_j`: a product for each point
/// instead of one for each edge.
struct Edges {
    own: Linear,
    other: Linear,
}

impl Edges {
    fn read(cpu: &CpuBackend, weights: &Weights<'_>, name: &str) -> Result<Edges> {
        let all = weights.matrix(name)?.transposed();
        let half = all.rows() / 2;
        let (mut own, mut other) = (all.part(0, half), all.part(half, half));
        own.values_mut().iter_mut().zip(other.values_mut()).for_each(|(own, other)| *own -= *other);
        Ok(Edges {
            own: Linear::new(cpu, own.transposed(), None)?,
            other: Linear::new(cpu, other.transposed(), None)?,
        })
    }

    fn apply(&self, cpu: &CpuBackend, graph: &Graph, features: &Matrix) -> Result<Matrix> {
        let own = self.own.apply(cpu, features)?;
        let other = self.other.apply(cpu, features)?;
        let ends = graph.neighbours.iter().flatten().copied().collect::<Vec<_>>();
        let mut edges = other.gather(ends.into_iter());
        let columns = edges.columns().max(1);
        let of_points = edges.values_mut().par_chunks_mut((graph.degree * columns).max(1));
        of_points.enumerate().for_each(|(point, edges)| {
            for edge in edges.chunks_exact_mut(columns) {
                edge.iter_mut().zip(own.row(point)).for_each(|(value, own)| *value += own);
            }
        });
        instance_normalization(&mut edges, Activation::LeakierRelu);
        let mut largest = Matrix::filled(features.rows(), columns, f32::NEG_INFINITY);
        let of_points = edges.values().chunks_exact((graph.degree * columns).max(1));
        for (row, edges) in largest.values_mut().chunks_exact_mut(columns).zip(of_points) {
            for edge in edges.chunks_exact(columns) {
                row.iter_mut().zip(edge).for_each(|(value, edge)| *value = value.max(*edge));
            }
        }
        Ok(largest)
    }
}

/// Two convolutions of the edges of a graph and a layer that joins what comes before, between and after them.
pub(super) struct EdgeConvolutions {
    first: Edges,
    second: Edges,
    joined: Linear,
}

impl EdgeConvolutions {
    /// Reads the layer `name`.
    pub(super) fn read(
        cpu: &CpuBackend,
        weights: &Weights<'_>,
        name: &str,
    ) -> Result<EdgeConvolutions> {
        Ok(EdgeConvolutions {
            first: Edges::read(cpu, weights, &format!("{name}.conv1.weight"))?,
            second: Edges::read(cpu, weights, &format!("{name}.conv2.weight"))?,
            joined: weights.linear(cpu, &format!("{name}.conv3"))?,
        })
    }

    /// New features of the points of one cloud.
    pub(super) fn apply(
        &self,
        cpu: &CpuBackend,
        graph: &Graph,
        features: &Matrix,
    ) -> Result<Matrix> {
        if graph.degree == 0 {
            return Err(Error::Internal("a graph without edges".to_owned()));
        }
        let first = self.first.apply(cpu, graph, features)?;
        let second = self.second.apply(cpu, graph, &first)?;
        let all = features.beside(&first)?.beside(&second)?;
        let mut joined = self.joined.apply(cpu, &all)?;
        instance_normalization(&mut joined, Activation::LeakierRelu);
        Ok(joined)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_point_is_not_its_own_neighbour() {
        let points: Vec<Point> = [0.0, 1.0, 3.0, 7.0].map(|x| [x, 0.0, 0.0]).to_vec();
        let graph = Graph::new(&points, 2);
        assert_eq!(graph.neighbours, [[1, 2], [0, 2], [0, 1], [1, 2]]);
        assert_eq!(Graph::new(&points, 10).degree(), 3);
        assert_eq!(Graph::new(&points[..1], 10).degree(), 0);
    }
}
