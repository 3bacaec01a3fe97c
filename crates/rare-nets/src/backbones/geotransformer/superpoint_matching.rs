//! Which superpoints belong together (Qin et al., CVPR 2022, section 3.2, equations 6 and 7).

use rare::Result;
use rayon::prelude::*;

use super::Partition;
use crate::Matrix;
use crate::engine::CpuBackend;
use crate::layers::products;

/// A superpoint of the target, one of the source, and how well they match.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SuperpointMatch {
    /// Index among the superpoints of the target.
    pub target: usize,
    /// Index among those of the source.
    pub source: usize,
    /// Gaussian correlation after normalisation of both sides, 0 to 1.
    pub score: f32,
}

/// The best `most` pairs of superpoints that have points, the best first; of equal ones the first.
///
/// Gaussian correlations of the features, of unit length, are divided by the sums of their rows and columns, which
/// suppresses what matches everything.
pub(super) fn match_superpoints(
    cpu: &CpuBackend,
    features: &[Matrix; 2],
    partitions: &[Partition; 2],
    most: usize,
) -> Result<Vec<SuperpointMatch>> {
    let [targets, sources] = [partitions[0].occupied(), partitions[1].occupied()];
    let [target, source] = [(&features[0], &targets), (&features[1], &sources)]
        .map(|(features, occupied)| features.gather(occupied.iter().copied()));
    let mut scores = products(cpu, &target, &source)?;
    let columns = scores.columns().max(1);
    let correlation = |value: &mut f32| *value = (-(2.0 - 2.0 * *value).max(0.0)).exp();
    scores.values_mut().par_iter_mut().for_each(correlation);
    let mut column_sums = vec![0.0_f64; columns];
    let mut row_sums = Vec::with_capacity(scores.rows());
    for row in scores.values().chunks_exact(columns) {
        column_sums.iter_mut().zip(row).for_each(|(sum, &value)| *sum += f64::from(value));
        row_sums.push(row.iter().map(|&value| f64::from(value)).sum::<f64>() as f32);
    }
    let rows = scores.values_mut().chunks_exact_mut(columns);
    for (row, row_sum) in rows.zip(row_sums) {
        let normalise = |(value, &column_sum): (&mut f32, &f64)| {
            *value = (*value / row_sum) * (*value / column_sum as f32);
        };
        row.iter_mut().zip(&column_sums).for_each(normalise);
    }
    let best = largest(scores.values(), most);
    let pair = |index: usize| {
        let (target, source) = (targets.get(index / columns)?, sources.get(index % columns)?);
        let score = *scores.values().get(index)?;
        Some(SuperpointMatch { target: *target, source: *source, score })
    };
    Ok(best.into_iter().filter_map(pair).collect())
}

/// The places of the largest values, in descending order.
fn largest(values: &[f32], most: usize) -> Vec<usize> {
    let mut places: Vec<usize> = (0..values.len()).collect();
    let descending = |a: &usize, b: &usize| values[*b].total_cmp(&values[*a]).then(a.cmp(b));
    if places.len() > most && most > 0 {
        places.select_nth_unstable_by(most - 1, descending);
    }
    places.truncate(most);
    places.sort_by(descending);
    places
}
