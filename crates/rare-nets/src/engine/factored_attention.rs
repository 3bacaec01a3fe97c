//! Attention whose scores are multiplied by factors before the softmax, most of which are zero.
//!
//! A key with the factor 0 is not masked: its score is 0 and its weight `e^0`. So all keys that are not listed for a
//! query have the same weight, and it is enough to know the sum of all values: with `B` the largest score (at least 0)
//! and `s_i` those of the listed keys, the result is
//!
//! `(e^-B sum of all V_i + sum of listed (e^(s_i - B) - e^-B) V_i) / (the same without V)`
//!
//! which is exact, and costs what the listed keys cost. Where nearly all keys are listed, the two sums could cancel:
//! whoever lists the keys then lists all of them, and the first sum falls away.

#![expect(
    clippy::needless_range_loop,
    reason = "iterators would move the vectors out of their registers"
)]

use std::borrow::Cow;
use std::ops::Range;

use rare::{Error, Result};
use rayon::prelude::*;

use super::math::exp2;
use super::simd::{LANES, Processor, Simd, Vectorized};
use super::vectors::{load, store};
use crate::Matrix;

/// Queries of a block, and so of the rows that [`ScoreFactors`] gives at once.
pub(crate) const QUERIES: usize = 128;
/// Keys whose channels stay in the second-level cache while all queries of a block pass by.
const KEYS: usize = 512;
/// Products that are summed up side by side.
const BATCH: usize = 4;

/// The factors of the scores between queries and keys.
pub(crate) trait ScoreFactors: Sync {
    /// The factors of these queries.
    fn rows(&self, queries: Range<usize>) -> Cow<'_, FactorRows>;
}

/// For some queries, the keys whose factor is not 0.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct FactorRows {
    /// Where each query's keys end.
    ends: Vec<usize>,
    keys: Vec<u32>,
    factors: Vec<f32>,
}

impl FactorRows {
    /// Adds a query with its keys, ascending, and their factors.
    pub(crate) fn push(&mut self, listed: impl Iterator<Item = (u32, f32)>) {
        for (key, factor) in listed {
            self.keys.push(key);
            self.factors.push(factor);
        }
        self.ends.push(self.keys.len());
    }

    /// Number of keys listed for all queries together.
    pub(crate) fn listed(&self) -> usize {
        self.keys.len()
    }

    /// The keys of a query and their factors; none if there is no such query.
    pub(crate) fn row(&self, query: usize) -> (&[u32], &[f32]) {
        let range = self.range(query);
        (&self.keys[range.clone()], &self.factors[range])
    }

    fn range(&self, query: usize) -> Range<usize> {
        let end = self.ends.get(query).copied().unwrap_or(0);
        let start = if query == 0 { 0 } else { self.ends.get(query - 1).copied().unwrap_or(end) };
        start.min(end)..end
    }

    /// The places of all listed keys, a block of keys after the other, query by query.
    fn pieces(&self, keys: usize) -> Vec<(usize, Range<usize>)> {
        let mut next: Vec<usize> =
            (0..self.ends.len()).map(|query| self.range(query).start).collect();
        let mut pieces = Vec::with_capacity(self.ends.len() * keys.div_ceil(KEYS));
        for first in (0..keys).step_by(KEYS) {
            for (query, next) in next.iter_mut().enumerate() {
                let left = &self.keys[*next..self.ends[query]];
                let end = *next + left.partition_point(|&key| (key as usize) < first + KEYS);
                pieces.push((query, *next..end));
                *next = end;
            }
        }
        pieces
    }

    /// Whether these are rows of so many queries to so many keys, in order.
    fn fits(&self, queries: usize, keys: usize) -> bool {
        let ascends = |row: &[u32]| row.is_sorted_by(|a, b| a < b);
        let within = |row: &[u32]| row.last().is_none_or(|&key| (key as usize) < keys);
        self.ends.len() == queries
            && (0..queries).map(|query| self.row(query).0).all(|row| ascends(row) && within(row))
    }
}

/// Some columns of a matrix, from `first` on.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Columns<'a> {
    pub(crate) matrix: &'a Matrix,
    pub(crate) first: usize,
}

/// One head of queries, keys and values.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Head<'a> {
    pub(crate) queries: Columns<'a>,
    pub(crate) keys: Columns<'a>,
    pub(crate) values: Columns<'a>,
    /// How many columns each has.
    pub(crate) channels: usize,
}

/// `softmax(factor * (query . key) / sqrt(channels)) value` for each query.
pub(super) fn attend(
    processor: Processor,
    head: &Head<'_>,
    factors: &impl ScoreFactors,
) -> Result<Matrix> {
    head.validate()?;
    match head.channels / LANES {
        1 => attend_wide::<1>(processor, head, factors),
        2 => attend_wide::<2>(processor, head, factors),
        4 => attend_wide::<4>(processor, head, factors),
        _ => attend_wide::<8>(processor, head, factors),
    }
}

/// With so many vectors of channels.
fn attend_wide<const VECTORS: usize>(
    processor: Processor,
    head: &Head<'_>,
    factors: &impl ScoreFactors,
) -> Result<Matrix> {
    let (queries, channels) = (head.queries.matrix.rows(), head.channels);
    let value_sums = head.value_sums();
    let mut output = Matrix::filled(queries, channels, 0.0);
    output.values_mut().par_chunks_mut(QUERIES * channels).enumerate().try_for_each(
        |(block, output)| {
            let first = block * QUERIES;
            let end = queries.min(first + QUERIES);
            let rows = factors.rows(first..end);
            if !rows.fits(end - first, head.keys.matrix.rows()) {
                return Err(Error::Internal(format!("no factors of queries {first} to {end}")));
            }
            let rows = rows.as_ref();
            let value_sums = &value_sums;
            processor.run(Block::<VECTORS> { head, rows, first, value_sums, output });
            Ok(())
        },
    )?;
    Ok(output)
}

impl<'a> Columns<'a> {
    /// A row of them; `None` where there is no such row.
    #[inline(always)]
    fn row<const VECTORS: usize>(&self, row: usize) -> Option<&'a [[f32; LANES]; VECTORS]> {
        let values = self.matrix.values().get(row * self.matrix.columns() + self.first..)?;
        values.as_chunks().0.first_chunk()
    }
}

impl Head<'_> {
    fn validate(&self) -> Result<()> {
        let fits =
            |columns: &Columns<'_>| columns.first + self.channels <= columns.matrix.columns();
        let wide = [1, 2, 4, 8].contains(&(self.channels / LANES));
        let columns = [self.queries, self.keys, self.values];
        if !wide || !self.channels.is_multiple_of(LANES) || !columns.iter().all(fits) {
            return Err(Error::Internal(format!("no head of {} channels", self.channels)));
        }
        let (keys, values) = (self.keys.matrix.rows(), self.values.matrix.rows());
        if keys != values || keys > u32::MAX as usize {
            return Err(Error::Internal(format!("{keys} keys and {values} values")));
        }
        Ok(())
    }

    /// The sum of all values, channel by channel.
    fn value_sums(&self) -> Vec<f32> {
        let mut sums = vec![0.0; self.channels];
        let Columns { matrix, first } = self.values;
        for row in matrix.values().chunks_exact(matrix.columns()) {
            let row = &row[first..first + self.channels];
            sums.iter_mut().zip(row).for_each(|(sum, &value)| *sum += f64::from(value));
        }
        sums.into_iter().map(|sum| sum as f32).collect()
    }
}

/// Some queries.
struct Block<'a, const VECTORS: usize> {
    head: &'a Head<'a>,
    rows: &'a FactorRows,
    /// The first query.
    first: usize,
    value_sums: &'a [f32],
    output: &'a mut [f32],
}

impl<const VECTORS: usize> Vectorized for Block<'_, VECTORS> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(mut self, simd: S) {
        // Plain loops: a closure is not compiled with the instructions of the loop that it is handed to.
        let mut weights = vec![0.0; self.rows.listed()];
        let pieces = self.rows.pieces(self.head.keys.matrix.rows());
        for (query, listed) in &pieces {
            self.score(simd, *query, listed.clone(), &mut weights);
        }
        let mut totals = Vec::with_capacity(self.rows.ends.len());
        for query in 0..self.rows.ends.len() {
            let row = &mut weights[self.rows.range(query)];
            totals.push(exponentiate(simd, row, self.head.keys.matrix.rows()));
        }
        for (query, listed) in &pieces {
            self.weigh(simd, *query, listed.clone(), &weights);
        }
        self.finish(simd, &totals);
    }
}

/// What is known of all keys of a query, relative to the largest score.
struct Total {
    /// The weight of a key that is not listed; 0 where all are.
    rest: f32,
    /// The sum of all weights.
    weight: f32,
}

impl<const VECTORS: usize> Block<'_, VECTORS> {
    /// Adds what all keys have in common, and divides by the weights.
    #[inline(always)]
    fn finish<S: Simd>(&mut self, simd: S, totals: &[Total]) {
        let output = self.output.as_chunks_mut::<LANES>().0.chunks_exact_mut(VECTORS);
        for (output, total) in output.zip(totals) {
            let (rest, inverse) = (simd.splat(total.rest), simd.splat(1.0 / total.weight));
            for (output, sums) in output.iter_mut().zip(self.value_sums.as_chunks().0) {
                let sum = simd.mul_add(rest, simd.load(sums), simd.load(output));
                simd.store(simd.mul(sum, inverse), output);
            }
        }
    }

    /// The scores of some listed keys as powers of 2.
    #[inline(always)]
    fn score<S: Simd>(&self, simd: S, query: usize, listed: Range<usize>, scores: &mut [f32]) {
        let scale = std::f32::consts::LOG2_E / (self.head.channels as f32).sqrt();
        let Some(asked) = self.head.queries.row::<VECTORS>(self.first + query) else { return };
        let mut query = [simd.splat(0.0); VECTORS];
        for vector in 0..VECTORS {
            query[vector] = simd.load(&asked[vector]);
        }
        let keys = self.rows.keys[listed.clone()].chunks(BATCH);
        let factors = self.rows.factors[listed.clone()].chunks(BATCH);
        for ((scores, keys), factors) in scores[listed].chunks_mut(BATCH).zip(keys).zip(factors) {
            // What a short batch lacks is computed for nothing.
            let key =
                |at: usize| self.head.keys.row::<VECTORS>(keys[at.min(keys.len() - 1)] as usize);
            let (Some(a), Some(b), Some(c), Some(d)) = (key(0), key(1), key(2), key(3)) else {
                return;
            };
            let rows = [a, b, c, d];
            let mut sums = [simd.splat(0.0); BATCH];
            for vector in 0..VECTORS {
                for at in 0..BATCH {
                    sums[at] = simd.mul_add(query[vector], simd.load(&rows[at][vector]), sums[at]);
                }
            }
            let sums = [simd.sum(sums[0]), simd.sum(sums[1]), simd.sum(sums[2]), simd.sum(sums[3])];
            for ((score, sum), factor) in scores.iter_mut().zip(sums).zip(factors) {
                *score = sum * (factor * scale);
            }
        }
    }

    /// Adds the values of some listed keys.
    #[inline(always)]
    fn weigh<S: Simd>(&mut self, simd: S, query: usize, listed: Range<usize>, weights: &[f32]) {
        let output = self.output.as_chunks_mut::<LANES>().0;
        let Some(output) = output.get_mut(query * VECTORS..(query + 1) * VECTORS) else { return };
        let mut sums = [simd.splat(0.0); VECTORS];
        for vector in 0..VECTORS {
            sums[vector] = simd.load(&output[vector]);
        }
        for (&key, &weight) in self.rows.keys[listed.clone()].iter().zip(&weights[listed]) {
            let Some(values) = self.head.values.row::<VECTORS>(key as usize) else { return };
            let weight = simd.splat(weight);
            for vector in 0..VECTORS {
                sums[vector] = simd.mul_add(weight, simd.load(&values[vector]), sums[vector]);
            }
        }
        for vector in 0..VECTORS {
            simd.store(sums[vector], &mut output[vector]);
        }
    }
}

/// Turns the scores of the listed keys, of `count` in all, into what their weights exceed that of the others by.
#[inline(always)]
fn exponentiate<S: Simd>(simd: S, row: &mut [f32], count: usize) -> Total {
    let all_listed = row.len() == count;
    let largest = maximum(simd, row, if all_listed { f32::MIN } else { 0.0 });
    let rest = if all_listed { 0.0 } else { (-largest).exp2() };
    let (shift, excess) = (simd.splat(-largest), simd.splat(-rest));
    for start in (0..row.len()).step_by(LANES) {
        let weight = exp2(simd, simd.add(load(simd, row, start), shift));
        store(simd, simd.add(weight, excess), row, start);
    }
    Total { rest, weight: sum(simd, row) + rest * count as f32 }
}

#[inline(always)]
fn maximum<S: Simd>(simd: S, row: &[f32], least: f32) -> f32 {
    let (lanes, tail) = row.as_chunks::<LANES>();
    let mut largest = simd.splat(least);
    for lanes in lanes {
        largest = simd.max(largest, simd.load(lanes));
    }
    tail.iter().copied().fold(simd.maximum(largest), f32::max)
}

#[inline(always)]
fn sum<S: Simd>(simd: S, row: &[f32]) -> f32 {
    let (lanes, tail) = row.as_chunks::<LANES>();
    let mut sum = simd.splat(0.0);
    for lanes in lanes {
        sum = simd.add(sum, simd.load(lanes));
    }
    simd.sum(sum) + tail.iter().sum::<f32>()
}

#[cfg(test)]
mod tests;
