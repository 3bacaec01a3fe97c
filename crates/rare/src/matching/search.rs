//! The search for nearest features: tiles of the matrix product, and a running best of every row and column.
//!
//! `|a - b|^2 / 2 = |a|^2 / 2 + |b|^2 / 2 - a.b`, so the nearest `b` of `a` maximises `a.b - |b|^2 / 2` and the
//! nearest `a` of `b` maximises `a.b - |a|^2 / 2`. Tiles have a fixed size; blocks of source rows run in parallel,
//! and taking the best of two blocks is exact, so that neither threads nor their timing can change the result.

use faer::linalg::matmul::matmul;
use faer::{Accum, MatMut, MatRef, Par};
use rayon::prelude::*;

use super::Locality;
use super::window::Window;
use crate::data::PointFeatures;

/// Source rows of one tile: enough that packing the target block is small beside multiplying it.
pub(super) const TILE_ROWS: usize = 256;
/// Target rows of one tile: 256 x 512 products are 512 KiB and stay in the second-level cache.
pub(super) const TILE_COLUMNS: usize = 512;
/// Columns that are compared at a time, so that the compiler keeps their maxima in vector registers. Tiles are padded
/// to a multiple of it.
const LANES: usize = 16;
/// Rows of which the highest is found before a column's best is looked at.
const ROW_GROUP: usize = 8;
/// No candidate so far.
const NONE: u32 = u32::MAX;

/// The nearest neighbours in feature space. `None` where there is no candidate.
pub(super) struct Nearest {
    /// Target index per source keypoint.
    pub(super) of_source: Vec<Option<usize>>,
    /// Source index per target keypoint; empty unless both directions were asked for.
    pub(super) of_target: Vec<Option<usize>>,
}

/// Finds the nearest target of every source and, if asked for, the nearest source of every target.
pub(super) fn search(
    source: &PointFeatures,
    target: &PointFeatures,
    locality: Option<&Locality<'_>>,
    both_directions: bool,
) -> Nearest {
    let targets = target.len();
    let columns = if both_directions { targets.next_multiple_of(LANES) } else { 0 };
    let search = Search {
        source: Side::new(source),
        target: Side::new(target),
        window: locality.map(Window::new),
    };
    let mut rows = Best::new(source.len());
    let best_columns = rows
        .score
        .par_chunks_mut(TILE_ROWS)
        .zip(rows.index.par_chunks_mut(TILE_ROWS))
        .enumerate()
        .map(|(block, (score, index))| {
            let mut columns = Best::new(columns);
            search.block_of_rows(block, score, index, &mut columns);
            columns
        })
        .reduce_with(Best::merge)
        .unwrap_or_else(|| Best::new(columns));
    let mut of_target = best_columns.indices();
    of_target.truncate(targets);
    Nearest { of_source: rows.indices(), of_target }
}

/// The features of one side.
struct Side<'a> {
    values: &'a [f32],
    dimension: usize,
    len: usize,
    /// Half of each squared norm, filled up to a multiple of [`LANES`] with what is infinitely far away.
    half_squared_norms: Vec<f32>,
}

impl<'a> Side<'a> {
    fn new(features: &'a PointFeatures) -> Side<'a> {
        let squared_norm = |row: &[f32]| row.iter().map(|&x| f64::from(x).powi(2)).sum::<f64>();
        let (values, dimension) = (features.values(), features.dimension().max(1));
        let half = |row| (squared_norm(row) / 2.0) as f32;
        let mut half_squared_norms: Vec<f32> = values.chunks_exact(dimension).map(half).collect();
        let len = half_squared_norms.len();
        half_squared_norms.resize(len.next_multiple_of(LANES), f32::INFINITY);
        Side { values, dimension, len, half_squared_norms }
    }

    /// The features of the rows from `first` on, at most `count`.
    fn features(&self, first: usize, count: usize) -> &[f32] {
        let end = self.len.min(first + count);
        &self.values[first * self.dimension..end * self.dimension]
    }

    /// The half squared norms of the same rows and of what fills them up; `count` is a multiple of [`LANES`].
    fn half_squared_norms(&self, first: usize, count: usize) -> &[f32] {
        &self.half_squared_norms[first..self.half_squared_norms.len().min(first + count)]
    }
}

/// The best candidate so far of each of some rows or columns.
struct Best {
    score: Vec<f32>,
    index: Vec<u32>,
}

impl Best {
    fn new(len: usize) -> Best {
        Best { score: vec![f32::NEG_INFINITY; len], index: vec![NONE; len] }
    }

    /// The better of both, element by element; equals go to `self`, whose candidates have the lower indices.
    fn merge(mut self, later: Best) -> Best {
        let mine = self.score.iter_mut().zip(&mut self.index);
        for ((score, index), (later_score, later_index)) in
            mine.zip(later.score.into_iter().zip(later.index))
        {
            if later_score > *score {
                (*score, *index) = (later_score, later_index);
            }
        }
        self
    }

    fn indices(&self) -> Vec<Option<usize>> {
        self.index.iter().map(|&index| (index != NONE).then_some(index as usize)).collect()
    }
}

struct Search<'a> {
    source: Side<'a>,
    target: Side<'a>,
    window: Option<Window>,
}

impl Search<'_> {
    /// One block of source rows against all targets.
    fn block_of_rows(
        &self,
        block: usize,
        row_score: &mut [f32],
        row_index: &mut [u32],
        columns: &mut Best,
    ) {
        let first = block * TILE_ROWS;
        let source_norms = self.source.half_squared_norms(first, TILE_ROWS);
        let widest = TILE_COLUMNS.min(self.target.half_squared_norms.len());
        let mut tile = vec![0.0; row_index.len() * widest];
        for from in (0..self.target.len).step_by(TILE_COLUMNS) {
            if self.window.as_ref().is_some_and(|window| window.excludes(first, from)) {
                continue;
            }
            let target_norms = self.target.half_squared_norms(from, TILE_COLUMNS);
            let width = target_norms.len();
            let products = &mut tile[..row_index.len() * width];
            self.fill(first, from, width, products);
            let rows = row_score.iter_mut().zip(row_index.iter_mut());
            for ((score, index), row) in rows.zip(products.chunks_exact(width)) {
                best_of_row(row, target_norms, from, score, index);
            }
            let range = from..from + width;
            let scores = columns.score.get_mut(range.clone());
            if let (Some(scores), Some(indices)) = (scores, columns.index.get_mut(range)) {
                best_of_columns(products, source_norms, first, scores, indices);
            }
        }
    }

    /// The products of the tile at source row `first` and target row `from`. Its rows are `width` apart; what fills
    /// them up beyond the last target is left as it is, because nothing that is taken from it is kept.
    fn fill(&self, first: usize, from: usize, width: usize, products: &mut [f32]) {
        let dimension = self.source.dimension;
        let source = self.source.features(first, TILE_ROWS);
        let target = self.target.features(from, TILE_COLUMNS);
        let (rows, columns) = (source.len() / dimension, target.len() / dimension);
        // Seen column-major, the row-major product is its transpose: target times transposed source.
        matmul(
            MatMut::from_column_major_slice_with_stride_mut(products, columns, rows, width),
            Accum::Replace,
            MatRef::from_row_major_slice(target, columns, dimension),
            MatRef::from_column_major_slice(source, dimension, rows),
            1.0,
            Par::Seq,
        );
        if let Some(window) = &self.window {
            window.mask(first, from, columns, width, products);
        }
    }
}

/// The maximum of both, lane by lane, where NaN never wins.
fn highest(lanes: &mut [f32; LANES], products: &[f32; LANES], half_norm: impl Fn(usize) -> f32) {
    for lane in 0..LANES {
        let candidate = products[lane] - half_norm(lane);
        lanes[lane] = if candidate > lanes[lane] { candidate } else { lanes[lane] };
    }
}

/// Takes the columns of one row, which start at column `from`, into the row's running best.
fn best_of_row(
    products: &[f32],
    half_norms: &[f32],
    from: usize,
    score: &mut f32,
    index: &mut u32,
) {
    let mut lanes = [f32::NEG_INFINITY; LANES];
    let (product_lanes, _) = products.as_chunks::<LANES>();
    let (norm_lanes, _) = half_norms.as_chunks::<LANES>();
    for (products, norms) in product_lanes.iter().zip(norm_lanes) {
        highest(&mut lanes, products, |lane| norms[lane]);
    }
    let best = lanes.into_iter().fold(f32::NEG_INFINITY, f32::max);
    if best > *score {
        let mut candidates = products.iter().zip(half_norms);
        if let Some(column) = candidates.position(|(product, norm)| product - norm == best) {
            (*score, *index) = (best, (from + column) as u32);
        }
    }
}

/// The best of each column of a tile whose rows start at row `first`. `scores` and `indices` are those of
/// [`Best::new`]: a block of rows meets every column once.
fn best_of_columns(
    products: &[f32],
    half_norms: &[f32],
    first: usize,
    scores: &mut [f32],
    indices: &mut [u32],
) {
    let width = scores.len();
    let (score_lanes, _) = scores.as_chunks_mut::<LANES>();
    let (index_lanes, _) = indices.as_chunks_mut::<LANES>();
    let groups = || products.chunks(ROW_GROUP * width).zip(half_norms.chunks(ROW_GROUP));
    // First only which group of rows has the best: one comparison in eight needs to carry an index.
    for ((products, half_norms), group) in groups().zip(0_u32..) {
        for (run, (score, index)) in score_lanes.iter_mut().zip(&mut *index_lanes).enumerate() {
            let mut lanes = [f32::NEG_INFINITY; LANES];
            for (row, &half_norm) in products.chunks_exact(width).zip(half_norms) {
                highest(&mut lanes, &row.as_chunks().0[run], |_| half_norm);
            }
            for lane in 0..LANES {
                // Two selects, not a branch that no processor could predict.
                let better = lanes[lane] > score[lane];
                score[lane] = if better { lanes[lane] } else { score[lane] };
                index[lane] = if better { group } else { index[lane] };
            }
        }
    }
    for (column, (score, index)) in scores.iter().zip(indices).enumerate() {
        let group_start = (*index as usize).saturating_mul(ROW_GROUP);
        let rows = products.chunks_exact(width).zip(half_norms).skip(group_start);
        let found = rows.take(ROW_GROUP).position(|(row, norm)| row[column] - norm == *score);
        *index = found.map_or(NONE, |row| (first + group_start + row) as u32);
    }
}
