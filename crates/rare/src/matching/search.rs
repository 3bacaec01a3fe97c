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
/// Independent running maxima, so that the compiler can keep them in vector registers.
const LANES: usize = 16;
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
    let columns = if both_directions { target.len() } else { 0 };
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
    Nearest { of_source: rows.indices(), of_target: best_columns.indices() }
}

/// The features of one side, and half of their squared norms.
struct Side<'a> {
    values: &'a [f32],
    dimension: usize,
    half_squared_norms: Vec<f32>,
}

impl<'a> Side<'a> {
    fn new(features: &'a PointFeatures) -> Side<'a> {
        let squared_norm = |row: &[f32]| row.iter().map(|&x| f64::from(x).powi(2)).sum::<f64>();
        let (values, dimension) = (features.values(), features.dimension().max(1));
        let half = |row| (squared_norm(row) / 2.0) as f32;
        Side {
            values,
            dimension,
            half_squared_norms: values.chunks_exact(dimension).map(half).collect(),
        }
    }

    /// The rows from `first` on, at most `count`: their features and half squared norms.
    fn rows(&self, first: usize, count: usize) -> (&[f32], &[f32]) {
        let end = self.half_squared_norms.len().min(first + count);
        (
            &self.values[first * self.dimension..end * self.dimension],
            &self.half_squared_norms[first..end],
        )
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
        let (source, source_norms) = self.source.rows(first, TILE_ROWS);
        let targets = self.target.half_squared_norms.len();
        let mut tile = vec![0.0; source_norms.len() * TILE_COLUMNS.min(targets)];
        for from in (0..targets).step_by(TILE_COLUMNS) {
            if self.window.as_ref().is_some_and(|window| window.excludes(first, from)) {
                continue;
            }
            let (target, target_norms) = self.target.rows(from, TILE_COLUMNS);
            let products = &mut tile[..source_norms.len() * target_norms.len()];
            multiply(source, target, self.source.dimension, products);
            if let Some(window) = &self.window {
                window.mask(first, from, target_norms.len(), products);
            }
            let rows = row_score.iter_mut().zip(row_index.iter_mut());
            for ((score, index), row) in rows.zip(products.chunks_exact(target_norms.len())) {
                best_of_row(row, target_norms, from, score, index);
            }
            best_of_columns(
                products,
                source_norms,
                first,
                from..from + target_norms.len(),
                columns,
            );
        }
    }
}

/// `products` (source rows x target rows, row-major) = source features times target features, transposed.
fn multiply(source: &[f32], target: &[f32], dimension: usize, products: &mut [f32]) {
    let (rows, columns) = (source.len() / dimension, target.len() / dimension);
    // Seen column-major, the row-major product is its transpose: target times transposed source.
    matmul(
        MatMut::from_column_major_slice_mut(products, columns, rows),
        Accum::Replace,
        MatRef::from_row_major_slice(target, columns, dimension),
        MatRef::from_column_major_slice(source, dimension, rows),
        1.0,
        Par::Seq,
    );
}

/// Takes the columns of one row, which start at column `from`, into the row's running best.
fn best_of_row(
    products: &[f32],
    half_norms: &[f32],
    from: usize,
    score: &mut f32,
    index: &mut u32,
) {
    let (product_lanes, product_rest) = products.as_chunks::<LANES>();
    let (norm_lanes, norm_rest) = half_norms.as_chunks::<LANES>();
    let mut best = [f32::NEG_INFINITY; LANES];
    for (product, norm) in product_lanes.iter().zip(norm_lanes) {
        for lane in 0..LANES {
            let candidate = product[lane] - norm[lane];
            best[lane] = if candidate > best[lane] { candidate } else { best[lane] };
        }
    }
    let rest = product_rest.iter().zip(norm_rest).map(|(product, norm)| product - norm);
    let highest = best.into_iter().chain(rest).fold(f32::NEG_INFINITY, f32::max);
    if highest > *score {
        let mut candidates = products.iter().zip(half_norms);
        if let Some(column) = candidates.position(|(product, norm)| product - norm == highest) {
            (*score, *index) = (highest, (from + column) as u32);
        }
    }
}

/// Takes the rows of one tile, which start at row `first`, into the running best of its columns, if that is asked for.
fn best_of_columns(
    products: &[f32],
    half_norms: &[f32],
    first: usize,
    range: std::ops::Range<usize>,
    columns: &mut Best,
) {
    let Some(scores) = columns.score.get_mut(range.clone()) else { return };
    let Some(indices) = columns.index.get_mut(range) else { return };
    let rows = products.chunks_exact(scores.len()).zip(half_norms);
    for (row, (products, half_norm)) in rows.enumerate() {
        let row = (first + row) as u32;
        for ((product, score), index) in products.iter().zip(&mut *scores).zip(&mut *indices) {
            // Two selects, not a branch, so that the loop becomes vector code.
            let candidate = product - half_norm;
            let better = candidate > *score;
            *score = if better { candidate } else { *score };
            *index = if better { row } else { *index };
        }
    }
}
