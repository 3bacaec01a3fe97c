//! The search for several nearest features of each source keypoint.
//!
//! As in [`super::search`], the nearest target of a source maximises `a.b - |b|^2 / 2`. Blocks of source rows meet all
//! targets in one product; the highest of each row are selected, then ordered, ties by the lowest index.

use faer::linalg::matmul::matmul;
use faer::{Accum, MatMut, MatRef, Par};
use rayon::prelude::*;

use crate::data::PointFeatures;

/// Source rows of one product: with 20 000 targets it takes 2.5 MB.
const ROWS: usize = 32;

/// The indices of the `count` nearest targets of each source, nearest first.
pub(super) fn ranked(
    source: &PointFeatures,
    target: &PointFeatures,
    count: usize,
) -> Vec<Vec<u32>> {
    let (dimension, targets) = (source.dimension(), target.len());
    let half_squared_norm = |j: usize| {
        let squares = target.feature(j).iter().map(|&x| f64::from(x).powi(2));
        (squares.sum::<f64>() / 2.0) as f32
    };
    let half_norms: Vec<f32> = (0..targets).map(half_squared_norm).collect();
    if count == 0 || targets == 0 || dimension == 0 {
        return vec![Vec::new(); source.len()];
    }
    let block = |rows: &[f32]| {
        let height = rows.len() / dimension;
        let mut products = vec![0.0; height * targets];
        // Seen column-major, the row-major product is its transpose: target times transposed source.
        matmul(
            MatMut::from_column_major_slice_mut(&mut products, targets, height),
            Accum::Replace,
            MatRef::from_row_major_slice(target.values(), targets, dimension),
            MatRef::from_column_major_slice(rows, dimension, height),
            1.0,
            Par::Seq,
        );
        let best = |row: &[f32]| highest(row, &half_norms, count);
        products.chunks_exact(targets).map(best).collect::<Vec<_>>()
    };
    source.values().par_chunks(ROWS * dimension).flat_map_iter(block).collect()
}

/// The columns with the `count` highest scores, highest first; those that are not finite are left out.
fn highest(products: &[f32], half_norms: &[f32], count: usize) -> Vec<u32> {
    let scores = products.iter().zip(half_norms).map(|(product, norm)| product - norm);
    let mut scored: Vec<(f32, u32)> =
        scores.zip(0..).filter(|(score, _)| score.is_finite()).collect();
    let before = |a: &(f32, u32), b: &(f32, u32)| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1));
    if count < scored.len() {
        scored.select_nth_unstable_by(count - 1, before);
        scored.truncate(count);
    }
    scored.sort_unstable_by(before);
    scored.into_iter().map(|(_, column)| column).collect()
}

#[cfg(test)]
mod tests {
    use nalgebra::Point3;

    use super::*;
    use crate::random::Random;

    #[test]
    fn the_ranking_is_that_of_all_distances() {
        let mut random = Random::new(4, 0);
        let mut features = |count: usize| {
            let values = (0..5 * count).map(|_| random.normal() as f32).collect();
            PointFeatures::new(vec![Point3::origin(); count], 5, values).unwrap()
        };
        let (source, target) = (features(70), features(45));
        let distance = |i: usize, j: usize| {
            let differences = source.feature(i).iter().zip(target.feature(j));
            differences.map(|(a, b)| (a - b).powi(2)).sum::<f32>()
        };
        for count in [0, 1, 7, 45, 100] {
            let found = ranked(&source, &target, count);
            assert_eq!(found.len(), 70);
            for (i, row) in found.into_iter().enumerate() {
                let mut expected: Vec<u32> = (0..45).collect();
                expected
                    .sort_by(|&a, &b| distance(i, a as usize).total_cmp(&distance(i, b as usize)));
                expected.truncate(count);
                assert_eq!(row, expected);
            }
        }
    }

    #[test]
    fn ties_go_to_the_lowest_index_and_what_is_not_finite_has_no_rank() {
        let features = |values: &[f32]| {
            PointFeatures::new(vec![Point3::origin(); values.len()], 1, values.to_vec()).unwrap()
        };
        let target = features(&[1.0, 3.0, f32::NAN, 1.0, 3.0]);
        let found = ranked(&features(&[0.0, f32::INFINITY, 3.0]), &target, 3);
        assert_eq!(found, [vec![0, 3, 1], vec![], vec![1, 4, 0]]);
        assert_eq!(ranked(&target, &features(&[]), 3), vec![Vec::<u32>::new(); 5]);
    }
}
