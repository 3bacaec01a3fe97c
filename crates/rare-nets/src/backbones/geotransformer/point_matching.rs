//! Which points of matched patches belong together (Qin et al., CVPR 2022, section 3.3).

use rare::Result;
use rayon::prelude::*;

use super::{FineMatchingConfig, Partition, SuperpointMatch};
use crate::Matrix;
use crate::engine::{CpuBackend, log_transport};
use crate::layers::products;

/// A point of the target, one of the source, and how sure the match is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PointMatch {
    /// The pair of patches in which they met, by its place among the matched superpoints.
    pub patch: usize,
    /// Index among the points of the target at the second finest stage.
    pub target: usize,
    /// Index among those of the source.
    pub source: usize,
    /// The share of both that goes to the other, 0 to 1.
    pub score: f32,
}

/// The logarithms of the transport plans of matched patches: a row for each point of the target's patch and one for what
/// finds no partner, columns likewise for the source.
pub(super) fn transport(
    cpu: &CpuBackend,
    features: &[Matrix; 2],
    partitions: &[Partition; 2],
    matches: &[SuperpointMatch],
    dustbin: f32,
    iterations: usize,
) -> Result<Vec<Matrix>> {
    let plan = |pair: &SuperpointMatch| {
        let [target, source] = patches(partitions, pair);
        let rows = |features: &Matrix, patch: &[u32]| {
            features.gather(patch.iter().map(|&index| index as usize))
        };
        let (target, source) = (rows(&features[0], target), rows(&features[1], source));
        let mut scores = products(cpu, &target, &source)?;
        let scale = 1.0 / (features[0].columns().max(1) as f32).sqrt();
        scores.values_mut().iter_mut().for_each(|score| *score *= scale);
        Ok(log_transport(cpu.processor(), &scores, dustbin, iterations))
    };
    matches.par_iter().map(plan).collect()
}

/// The points of two matched patches.
fn patches<'a>(partitions: &'a [Partition; 2], pair: &SuperpointMatch) -> [&'a [u32]; 2] {
    let patch = |partition: &'a Partition, index: usize| {
        partition.patches.get(index).map(Vec::as_slice).unwrap_or_default()
    };
    [patch(&partitions[0], pair.target), patch(&partitions[1], pair.source)]
}

/// The matches in all plans, patch by patch, row by row: what is among the best of its row and of its column and sure
/// enough.
#[must_use]
pub fn match_points(
    plans: &[Matrix],
    partitions: &[Partition; 2],
    matches: &[SuperpointMatch],
    config: &FineMatchingConfig,
) -> Vec<PointMatch> {
    let of_patch = |(patch, (plan, pair)): (usize, (&Matrix, &SuperpointMatch))| {
        let [targets, sources] = patches(partitions, pair);
        let found = mutual_best(plan, config);
        let index = |list: &[u32], place: usize| list.get(place).map(|&index| index as usize);
        let pair = |(row, column, score): (usize, usize, f32)| {
            let (target, source) = (index(targets, row)?, index(sources, column)?);
            Some(PointMatch { patch, target, source, score })
        };
        found.into_iter().filter_map(pair).collect::<Vec<_>>()
    };
    plans.par_iter().zip(matches).enumerate().flat_map_iter(of_patch).collect()
}

/// Places and values in a plan without its dustbins.
fn mutual_best(plan: &Matrix, config: &FineMatchingConfig) -> Vec<(usize, usize, f32)> {
    let (rows, columns) = (plan.rows().saturating_sub(1), plan.columns().saturating_sub(1));
    let values: Vec<f32> = (0..rows)
        .flat_map(|row| plan.row(row)[..columns].iter().map(|value| value.exp()))
        .collect();
    let by_row = best(rows, columns, config.best, |row, column| values[row * columns + column]);
    let by_column = best(columns, rows, config.best, |column, row| values[row * columns + column]);
    let place = |at: usize| (at / columns, at % columns, values[at]);
    let kept = |&(row, column, score): &(usize, usize, f32)| {
        score > config.confidence
            && by_row[row].contains(&column)
            && by_column[column].contains(&row)
    };
    (0..values.len()).map(place).filter(kept).collect()
}

/// For each line the places of its so many largest values; of equal ones the first.
fn best(
    lines: usize,
    length: usize,
    count: usize,
    value: impl Fn(usize, usize) -> f32,
) -> Vec<Vec<usize>> {
    let line = |line: usize| {
        let mut kept: Vec<usize> = Vec::with_capacity(count + 1);
        for place in 0..length {
            let rank = kept.partition_point(|&other| value(line, other) >= value(line, place));
            if rank < count {
                kept.insert(rank, place);
                kept.truncate(count);
            }
        }
        kept
    };
    (0..lines).map(line).collect()
}
