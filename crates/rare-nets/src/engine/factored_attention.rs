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

mod rows;
mod softmax;

use rare::{Error, Result};
use rayon::prelude::*;

use super::simd::{LANES, Processor, Simd, Vectorized};
use crate::Matrix;
use rows::Piece;
pub(crate) use rows::{AlignedRows, Columns, FactorRows, ScoreFactors};
use softmax::{Total, exponentiate, scores};

/// Queries of a block, and so of the rows that [`ScoreFactors`] gives at once.
pub(crate) const QUERIES: usize = 256;
/// Products that are summed up side by side.
const BATCH: usize = 4;

/// One head of queries, keys and values, all with the same number of channels.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Head<'a> {
    pub(crate) queries: Columns<'a>,
    pub(crate) keys: &'a AlignedRows,
    pub(crate) values: &'a AlignedRows,
}

/// `softmax(factor * (query . key) / sqrt(channels)) value` for each query.
pub(super) fn attend(
    processor: Processor,
    head: &Head<'_>,
    factors: &impl ScoreFactors,
) -> Result<Matrix> {
    match vectors(head.queries, head.keys)? {
        1 => attend_wide::<1>(processor, head, factors),
        2 => attend_wide::<2>(processor, head, factors),
        4 => attend_wide::<4>(processor, head, factors),
        _ => attend_wide::<8>(processor, head, factors),
    }
}

/// The inner products of some rows with those that are listed for them, one after the other; factors do not count.
pub(super) fn products(
    processor: Processor,
    queries: Columns<'_>,
    keys: &AlignedRows,
    rows: &FactorRows,
) -> Result<Vec<f32>> {
    require_rows(rows, queries.matrix.rows(), keys.rows())?;
    let (first, mut products) = (0, vec![0.0; rows.listed()]);
    let pieces = &rows.pieces(keys.rows());
    let output = &mut products;
    match vectors(queries, keys)? {
        1 => {
            let keys = keys.vectors::<1>();
            processor.run(Products { queries, first, keys, rows, pieces, output });
        }
        2 => {
            let keys = keys.vectors::<2>();
            processor.run(Products { queries, first, keys, rows, pieces, output });
        }
        4 => {
            let keys = keys.vectors::<4>();
            processor.run(Products { queries, first, keys, rows, pieces, output });
        }
        _ => {
            let keys = keys.vectors::<8>();
            processor.run(Products { queries, first, keys, rows, pieces, output });
        }
    }
    Ok(products)
}

/// How many vectors the rows on both sides have.
fn vectors(queries: Columns<'_>, keys: &AlignedRows) -> Result<usize> {
    let (channels, vectors) = (keys.columns(), keys.columns() / LANES);
    if [1, 2, 4, 8].contains(&vectors) && queries.first + channels <= queries.matrix.columns() {
        Ok(vectors)
    } else {
        Err(Error::Internal(format!("no products of rows of {channels}")))
    }
}

fn require_rows(rows: &FactorRows, queries: usize, keys: usize) -> Result<()> {
    if rows.fits(queries, keys) {
        Ok(())
    } else {
        Err(Error::Internal(format!("no factors of {queries} queries and {keys} keys")))
    }
}

/// With so many vectors of channels.
fn attend_wide<const VECTORS: usize>(
    processor: Processor,
    head: &Head<'_>,
    factors: &impl ScoreFactors,
) -> Result<Matrix> {
    let (keys, values) = (head.keys.vectors::<VECTORS>(), head.values.vectors::<VECTORS>());
    if keys.len() != values.len() {
        let (keys, values) = (head.keys.rows(), head.values.rows());
        return Err(Error::Internal(format!("{keys} keys and {values} values")));
    }
    let value_sums = &value_sums(head.values);
    let (queries, channels) = (head.queries.matrix.rows(), VECTORS * LANES);
    let mut output = Matrix::filled(queries, channels, 0.0);
    let blocks = output.values_mut().par_chunks_mut(QUERIES * channels).enumerate();
    blocks.try_for_each(|(block, output)| {
        let first = block * QUERIES;
        let end = queries.min(first + QUERIES);
        let rows = factors.rows(first..end);
        require_rows(&rows, end - first, keys.len())?;
        let (queries, rows) = (head.queries, rows.as_ref());
        processor.run(Block { queries, keys, values, rows, first, value_sums, output });
        Ok(())
    })?;
    Ok(output)
}

/// The sum of all values, channel by channel.
fn value_sums(values: &AlignedRows) -> Vec<f32> {
    let mut sums = vec![0.0; values.columns()];
    for row in 0..values.rows() {
        sums.iter_mut().zip(values.row(row)).for_each(|(sum, &value)| *sum += f64::from(value));
    }
    sums.into_iter().map(|sum| sum as f32).collect()
}

/// The inner products of some queries with the keys that are listed for them.
struct Products<'a, const VECTORS: usize> {
    queries: Columns<'a>,
    /// The first query.
    first: usize,
    keys: &'a [[[f32; LANES]; VECTORS]],
    rows: &'a FactorRows,
    pieces: &'a [Piece],
    output: &'a mut [f32],
}

impl<const VECTORS: usize> Vectorized for Products<'_, VECTORS> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        for Piece { query, listed } in self.pieces {
            let Some(asked) = self.queries.row::<VECTORS>(self.first + query) else { return };
            let mut query = [simd.splat(0.0); VECTORS];
            for vector in 0..VECTORS {
                query[vector] = simd.load(&asked[vector]);
            }
            let listed_keys = self.rows.keys[listed.clone()].chunks(BATCH);
            for (output, listed) in self.output[listed.clone()].chunks_mut(BATCH).zip(listed_keys) {
                // What a short batch lacks is computed for nothing.
                let key = |at: usize| self.keys.get(listed[at.min(listed.len() - 1)] as usize);
                let (Some(a), Some(b), Some(c), Some(d)) = (key(0), key(1), key(2), key(3)) else {
                    return;
                };
                let mut sums = [simd.splat(0.0); BATCH];
                for vector in 0..VECTORS {
                    sums[0] = simd.mul_add(query[vector], simd.load(&a[vector]), sums[0]);
                    sums[1] = simd.mul_add(query[vector], simd.load(&b[vector]), sums[1]);
                    sums[2] = simd.mul_add(query[vector], simd.load(&c[vector]), sums[2]);
                    sums[3] = simd.mul_add(query[vector], simd.load(&d[vector]), sums[3]);
                }
                let sums =
                    [simd.sum(sums[0]), simd.sum(sums[1]), simd.sum(sums[2]), simd.sum(sums[3])];
                output.iter_mut().zip(sums).for_each(|(product, sum)| *product = sum);
            }
        }
    }
}

/// Some queries.
struct Block<'a, const VECTORS: usize> {
    queries: Columns<'a>,
    keys: &'a [[[f32; LANES]; VECTORS]],
    values: &'a [[[f32; LANES]; VECTORS]],
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
        let pieces = &self.rows.pieces(self.keys.len());
        let Block { queries, keys, rows, first, .. } = self;
        Products { queries, first, keys, rows, pieces, output: &mut weights }.run(simd);
        let scale = std::f32::consts::LOG2_E / ((VECTORS * LANES) as f32).sqrt();
        let mut totals = Vec::with_capacity(rows.ends.len());
        for query in 0..rows.ends.len() {
            let range = rows.range(query);
            let (row, factors) = (&mut weights[range.clone()], &rows.factors[range]);
            scores(simd, row, factors, scale);
            totals.push(exponentiate(simd, row, keys.len()));
        }
        for Piece { query, listed } in pieces {
            self.weigh(simd, *query, &rows.keys[listed.clone()], &weights[listed.clone()]);
        }
        self.finish(simd, &totals);
    }
}

impl<const VECTORS: usize> Block<'_, VECTORS> {
    /// Adds the values of some listed keys.
    #[inline(always)]
    fn weigh<S: Simd>(&mut self, simd: S, query: usize, listed: &[u32], weights: &[f32]) {
        let output = self.output.as_chunks_mut::<LANES>().0;
        let Some(output) = output.get_mut(query * VECTORS..(query + 1) * VECTORS) else { return };
        let mut sums = [simd.splat(0.0); VECTORS];
        for vector in 0..VECTORS {
            sums[vector] = simd.load(&output[vector]);
        }
        for (&key, &weight) in listed.iter().zip(weights) {
            let Some(values) = self.values.get(key as usize) else { return };
            let weight = simd.splat(weight);
            for vector in 0..VECTORS {
                sums[vector] = simd.mul_add(weight, simd.load(&values[vector]), sums[vector]);
            }
        }
        for vector in 0..VECTORS {
            simd.store(sums[vector], &mut output[vector]);
        }
    }

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
}

#[cfg(test)]
mod tests;
