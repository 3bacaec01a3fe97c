//! From products to weights.

use super::super::math::exp2;
use super::super::simd::{LANES, Simd};
use super::super::vectors::{load, store};

/// What is known of all keys of a query, relative to the largest score.
pub(super) struct Total {
    /// The weight of a key that is not listed; 0 where all are.
    pub(super) rest: f32,
    /// The sum of all weights.
    pub(super) weight: f32,
}

/// Makes scores, as powers of 2, of products.
#[inline(always)]
pub(super) fn scores<S: Simd>(simd: S, row: &mut [f32], factors: &[f32], scale: f32) {
    let scale = simd.splat(scale);
    for start in (0..row.len()).step_by(LANES) {
        let factor = simd.mul(load(simd, factors, start), scale);
        store(simd, simd.mul(load(simd, row, start), factor), row, start);
    }
}

/// Turns the scores of the listed keys, of `count` in all, into what their weights exceed that of the others by.
#[inline(always)]
pub(super) fn exponentiate<S: Simd>(simd: S, row: &mut [f32], count: usize) -> Total {
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
