//! Which nodes of a crowded graph are kept: those with the highest cluster coefficients (section 3.2 of the paper's
//! supplement and its released code).

use rayon::prelude::*;

use crate::pose::mac::score_graph::ScoreGraph;

/// A graph is crowded if its typical cluster coefficient is higher.
const CROWDED: f64 = 3.0;

/// About so many nodes of a crowded graph are kept.
const KEPT: usize = 50;

/// Bins of the histogram for Otsu's threshold.
const BINS: usize = 100;

/// The edges between the nodes of the highest cluster coefficients if the graph is crowded and has more than 50 nodes;
/// `None` if it stays as it is.
///
/// Otsu's threshold takes its bins from 0 on though they are as wide as if from the minimum on, as released; it decides
/// only on whether and how far the graph is reduced.
pub(super) fn reduced(graph: &ScoreGraph) -> Option<ScoreGraph> {
    if graph.len() <= KEPT {
        return None;
    }
    let coefficients = Coefficients::new(graph);
    let otsu = otsu_threshold(&coefficients.of_nodes);
    if otsu.min(coefficients.mean()).min(coefficients.overall) <= CROWDED {
        return None;
    }
    let mut sorted = coefficients.of_nodes.clone();
    sorted.sort_by(|a, b| b.total_cmp(a));
    let unit = otsu.max(coefficients.overall);
    // 10, 9.95, 9.9, ...
    let factors = (0..200).map(|step| f64::from(200 - step) * 0.05);
    let bound = factors.map(|factor| factor * unit).find(|&bound| bound <= sorted[KEPT - 1])?;
    let kept: Vec<bool> = coefficients.of_nodes.iter().map(|&value| value > bound).collect();
    let reduced = graph.between(&kept);
    (reduced.edge_ends() > 0).then_some(reduced)
}

/// How closely the neighbours of the nodes are joined among themselves.
struct Coefficients {
    /// Over the pairs of a node's neighbours, the mean of `(W_ij W_ik W_jk)^(1/3)`, 0 where they are not joined.
    of_nodes: Vec<f64>,
    /// The same mean over the pairs of all nodes.
    overall: f64,
}

impl Coefficients {
    fn new(graph: &ScoreGraph) -> Coefficients {
        let roots: Vec<f32> = graph.all_weights().par_iter().map(|weight| weight.cbrt()).collect();
        let products = graph.row_products(&roots);
        let (mut of_nodes, mut sums, mut counts) = (Vec::new(), 0.0, 0.0);
        for i in 0..graph.len() {
            let row = graph.row(&roots, i);
            let pairs = row.iter().zip(graph.row(&products, i));
            // Every pair of neighbours is met from either side.
            let sum = pairs.map(|(&a, &b)| f64::from(a) * f64::from(b)).sum::<f64>() / 2.0;
            let degree = row.iter().filter(|&&root| root > 0.0).count() as f64;
            let count = degree * (degree - 1.0) / 2.0;
            of_nodes.push(if count > 0.0 { sum / count } else { 0.0 });
            sums += sum;
            counts += count;
        }
        Coefficients { of_nodes, overall: if counts > 0.0 { sums / counts } else { 0.0 } }
    }

    fn mean(&self) -> f64 {
        self.of_nodes.iter().sum::<f64>() / self.of_nodes.len().max(1) as f64
    }
}

/// The bin that best splits the values in two, in terms of the variance between them (Otsu 1979).
fn otsu_threshold(values: &[f64]) -> f64 {
    let (min, max) = values
        .iter()
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(min, max), &v| (v.min(min), v.max(max)));
    let width = (max - min) / BINS as f64;
    if width.is_nan() || width <= 0.0 {
        return 0.0;
    }
    let mut bins = [(0.0, 0.0); BINS];
    for value in values {
        let bin = &mut bins[((value / width) as usize).min(BINS - 1)];
        bin.0 += 1.0;
        bin.1 += value;
    }
    let (count, sum) = (values.len() as f64, values.iter().sum::<f64>());
    let mut best = (f64::NEG_INFINITY, (max - min) / 2.0);
    let (mut below, mut sum_below) = (0.0, 0.0);
    for (at, bin) in bins.iter().enumerate() {
        below += bin.0;
        sum_below += bin.1;
        let above = count - below;
        if below > 0.0 && above > 0.0 {
            let difference: f64 = sum_below / below - (sum - sum_below) / above;
            let variance = below * above * difference * difference;
            if variance > best.0 {
                best = (variance, at as f64 * width);
            }
        }
    }
    best.1
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pose::mac::samples;

    #[test]
    fn coefficients_agree_with_their_definition() {
        let graph = samples::random_graph(30, 0.4, 1);
        let weight = |i: usize, j: usize| {
            let at = graph.neighbours(i).iter().position(|&other| other as usize == j);
            at.map_or(0.0, |at| f64::from(graph.weights(i)[at]))
        };
        let coefficients = Coefficients::new(&graph);
        let (mut all, mut pairs) = (0.0, 0.0);
        for (i, &ours) in coefficients.of_nodes.iter().enumerate() {
            let mut sum = 0.0;
            for j in 0..30 {
                sum += (0..j)
                    .map(|k| (weight(i, j) * weight(i, k) * weight(j, k)).cbrt())
                    .sum::<f64>();
            }
            let degree = (0..30).filter(|&j| weight(i, j) > 0.0).count() as f64;
            let count = degree * (degree - 1.0) / 2.0;
            assert!((ours - sum / count).abs() < 1e-5 * ours, "{ours} {}", sum / count);
            all += sum;
            pairs += count;
        }
        assert!((coefficients.overall - all / pairs).abs() < 1e-5 * coefficients.overall);
    }

    #[test]
    fn otsu_splits_two_heaps() {
        let values: Vec<f64> =
            (0..60).map(|i| if i % 3 == 0 { 8.0 } else { f64::from(i) / 60.0 }).collect();
        let threshold = otsu_threshold(&values);
        assert!((0.9..8.0).contains(&threshold), "{threshold}");
        assert_eq!(otsu_threshold(&[2.0; 9]), 0.0);
        assert_eq!(otsu_threshold(&[]), 0.0);
    }

    #[test]
    fn only_a_crowded_graph_is_reduced_to_about_50_nodes() {
        assert!(reduced(&samples::random_graph(200, 0.05, 2)).is_none());
        assert!(reduced(&samples::random_graph(50, 0.8, 2)).is_none());
        let dense = samples::random_graph(200, 0.7, 2);
        let crowded = ScoreGraph::joined_by(200, |i, j| {
            (i < 90 && j < 90 || (i + j) % 7 == 0) && dense.neighbours(i).contains(&(j as u32))
        });
        let kept = reduced(&crowded).unwrap();
        let nodes = (0..200).filter(|&i| !kept.neighbours(i).is_empty()).count();
        assert!((40..90).contains(&nodes), "{nodes}");
        assert!(kept.edge_ends() < crowded.edge_ends());
    }
}
