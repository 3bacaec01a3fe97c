//! Which keys are listed for which query, with which factors; and rows of numbers as the products read them.

use std::borrow::Cow;
use std::ops::Range;
use std::sync::Arc;

use rare::{Error, Result};

use super::super::arena::{Arena, Lent};
use super::super::simd::LANES;
use crate::Matrix;

/// Keys whose channels stay in the second-level cache while all queries of a block pass by.
pub(super) const KEYS: usize = 256;

/// The factors of the scores between queries and keys.
pub(crate) trait ScoreFactors: Sync {
    /// The factors of these queries.
    fn rows(&self, queries: Range<usize>) -> Cow<'_, FactorRows>;
}

/// For some queries, the keys whose factor is not 0.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct FactorRows {
    /// Where each query's keys end.
    pub(super) ends: Vec<usize>,
    pub(super) keys: Vec<u32>,
    pub(super) factors: Vec<f32>,
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

    /// Where the listed keys of a query are among those of all.
    pub(crate) fn range(&self, query: usize) -> Range<usize> {
        let end = self.ends.get(query).copied().unwrap_or(0);
        let start = if query == 0 { 0 } else { self.ends.get(query - 1).copied().unwrap_or(end) };
        start.min(end)..end
    }

    /// The places of all listed keys, a block of keys after the other, query by query.
    pub(super) fn pieces(&self, keys: usize) -> Vec<Piece> {
        let mut next: Vec<usize> =
            (0..self.ends.len()).map(|query| self.range(query).start).collect();
        let mut pieces = Vec::with_capacity(self.ends.len() * keys.div_ceil(KEYS));
        for first in (0..keys).step_by(KEYS) {
            for (query, next) in next.iter_mut().enumerate() {
                let left = &self.keys[*next..self.ends[query]];
                let end = *next + left.partition_point(|&key| (key as usize) < first + KEYS);
                pieces.push(Piece { query, listed: *next..end });
                *next = end;
            }
        }
        pieces
    }

    /// Whether these are rows of so many queries to so many keys, in order.
    pub(super) fn fits(&self, queries: usize, keys: usize) -> bool {
        let ascends = |row: &[u32]| row.is_sorted_by(|a, b| a < b);
        let within = |row: &[u32]| row.last().is_none_or(|&key| (key as usize) < keys);
        self.ends.len() == queries
            && (0..queries).map(|query| self.row(query).0).all(|row| ascends(row) && within(row))
    }
}

/// Some listed keys of a query.
pub(super) struct Piece {
    pub(super) query: usize,
    pub(super) listed: Range<usize>,
}

/// Some columns of a matrix, from `first` on.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Columns<'a> {
    pub(crate) matrix: &'a Matrix,
    pub(crate) first: usize,
}

impl<'a> Columns<'a> {
    /// All columns.
    pub(crate) fn all(matrix: &'a Matrix) -> Columns<'a> {
        Columns { matrix, first: 0 }
    }

    /// Vectors of a row; `None` where there are not so many.
    #[inline(always)]
    pub(super) fn row<const VECTORS: usize>(
        &self,
        row: usize,
    ) -> Option<&'a [[f32; LANES]; VECTORS]> {
        let values = self.matrix.values().get(row * self.matrix.columns() + self.first..)?;
        values.as_chunks().0.first_chunk()
    }
}

/// Rows of whole vectors, each vector in a cache line of its own.
#[derive(Debug)]
pub(crate) struct AlignedRows {
    buffer: Lent,
    rows: usize,
    columns: usize,
}

impl AlignedRows {
    /// Copies so many columns.
    ///
    /// # Errors
    /// `Internal` if there are not so many or they are no whole vectors.
    pub(in super::super) fn copy(
        arena: &Arc<Arena>,
        source: Columns<'_>,
        columns: usize,
    ) -> Result<AlignedRows> {
        let Columns { matrix, first } = source;
        let rows = matrix.rows();
        let whole = columns > 0 && columns.is_multiple_of(LANES);
        if !whole || first + columns > matrix.columns() || rows > u32::MAX as usize {
            return Err(Error::Internal(format!("no {columns} columns of {rows} rows to align")));
        }
        let mut buffer = arena.lend(rows * columns * 4);
        let targets = buffer.slice_mut::<f32>().chunks_exact_mut(columns);
        for (target, row) in targets.zip(matrix.values().chunks_exact(matrix.columns())) {
            target.copy_from_slice(&row[first..first + columns]);
        }
        Ok(AlignedRows { buffer, rows, columns })
    }

    /// Number of rows.
    pub(crate) fn rows(&self) -> usize {
        self.rows
    }

    /// Length of a row.
    pub(crate) fn columns(&self) -> usize {
        self.columns
    }

    /// A row. The caller knows that there is one.
    pub(crate) fn row(&self, row: usize) -> &[f32] {
        &self.buffer.slice::<f32>()[row * self.columns..(row + 1) * self.columns]
    }

    /// The vectors of all rows; nothing if a row has another number of them.
    pub(super) fn vectors<const VECTORS: usize>(&self) -> &[[[f32; LANES]; VECTORS]] {
        if self.columns != VECTORS * LANES {
            return &[];
        }
        let values = &self.buffer.slice::<f32>()[..self.rows * self.columns];
        values.as_chunks().0.as_chunks().0
    }
}
