//! Which correspondences keep their distance, as the factors of attention.

use std::borrow::Cow;
use std::ops::Range;

use rare::Correspondence;
use rare::pose::Consistency;
use rayon::prelude::*;

use crate::engine::{FACTORED_QUERIES, FactorRows, ScoreFactors};

/// At most so many factors are kept from layer to layer, of 8 bytes each. Others are computed again.
const KEPT: usize = 96 << 20;

/// The spatial consistency `C_ij = max(0, 1 - D_ij^2 / sigma^2)` of correspondences, where `D_ij` is the difference of
/// their lengths; 1 on the diagonal (Bai et al., CVPR 2021, equation 3).
///
/// Few of them are not 0. So the matrix is not needed in memory: rows of it, of the size in which attention asks for
/// them, are kept while there is room.
pub(crate) struct Compatibilities {
    consistency: Consistency,
    sigma: f32,
    kept: Vec<Option<FactorRows>>,
}

impl Compatibilities {
    /// Of these pairs (metres), with `sigma` in metres.
    pub(crate) fn new(pairs: &[Correspondence], sigma: f32) -> Compatibilities {
        Compatibilities::keeping(pairs, sigma, KEPT)
    }

    fn keeping(pairs: &[Correspondence], sigma: f32, kept: usize) -> Compatibilities {
        let consistency = Consistency::new(pairs);
        let mut all = Compatibilities { consistency, sigma, kept: Vec::new() };
        let blocks = pairs.len().div_ceil(FACTORED_QUERIES);
        // Each block has the same share of the room, so that blocks need not know of each other.
        let share = kept / blocks.max(1);
        let rows = (0..blocks).into_par_iter().map(|block| {
            let first = block * FACTORED_QUERIES;
            let rows = all.computed(first..pairs.len().min(first + FACTORED_QUERIES));
            (rows.listed() <= share).then_some(rows)
        });
        all.kept = rows.collect();
        all
    }

    /// `C_ij`.
    pub(crate) fn between(&self, i: usize, j: usize) -> f32 {
        self.value(self.consistency.difference(i, j))
    }

    /// The correspondences whose consistency with `i` is not 0, and how consistent they are.
    pub(crate) fn row(&self, i: usize) -> (Vec<u32>, Vec<f32>) {
        let (block, query) = (i / FACTORED_QUERIES, i % FACTORED_QUERIES);
        let copied = |rows: &FactorRows, query| {
            let (keys, factors) = rows.row(query);
            (keys.to_vec(), factors.to_vec())
        };
        match self.kept.get(block) {
            Some(Some(rows)) => copied(rows, query),
            _ => copied(&self.computed(i..i + 1), 0),
        }
    }

    fn value(&self, difference: f32) -> f32 {
        (1.0 - difference * difference / (self.sigma * self.sigma)).max(0.0)
    }

    fn computed(&self, queries: Range<usize>) -> FactorRows {
        let mut rows = FactorRows::default();
        let mut values = vec![0.0; self.consistency.len()];
        for query in queries {
            self.consistency.differences(query, 0, &mut values);
            values.iter_mut().for_each(|value| *value = self.value(*value));
            let consistent = values.iter().filter(|&&value| value > 0.0).count();
            // Nearly full rows are listed whole: see the attention to them.
            let all = consistent > values.len() / 4 * 3;
            let listed = (0..).zip(values.iter().copied());
            rows.push(listed.filter(|&(_, value)| all || value > 0.0));
        }
        rows
    }
}

impl ScoreFactors for Compatibilities {
    fn rows(&self, queries: Range<usize>) -> Cow<'_, FactorRows> {
        match self.kept.get(queries.start / FACTORED_QUERIES) {
            Some(Some(rows)) if queries.start.is_multiple_of(FACTORED_QUERIES) => {
                Cow::Borrowed(rows)
            }
            _ => Cow::Owned(self.computed(queries)),
        }
    }
}

#[cfg(test)]
mod tests {
    use rare::nalgebra::Point3;
    use rare::random::Random;

    use super::*;

    fn pairs(count: usize, spread: f64) -> Vec<Correspondence> {
        let mut random = Random::new(8, 0);
        let mut point = || Point3::from([0; 3].map(|_| spread * random.normal()));
        (0..count)
            .map(|_| Correspondence { source: point(), target: point(), score: 1.0 })
            .collect()
    }

    #[test]
    fn what_is_not_kept_is_computed_again() {
        for spread in [1.0, 0.1] {
            let pairs = pairs(2 * FACTORED_QUERIES + 5, spread);
            let all = Compatibilities::new(&pairs, 0.3);
            let none = Compatibilities::keeping(&pairs, 0.3, 0);
            assert!(all.kept.iter().all(Option::is_some) && none.kept.iter().all(Option::is_none));
            for first in (0..pairs.len()).step_by(FACTORED_QUERIES) {
                let queries = first..pairs.len().min(first + FACTORED_QUERIES);
                assert_eq!(all.rows(queries.clone()), none.rows(queries));
            }
            for i in [0, FACTORED_QUERIES + 1, pairs.len() - 1] {
                assert_eq!(all.row(i), none.row(i));
                let (keys, values) = all.row(i);
                let value = |j: usize| {
                    keys.iter().position(|&key| key as usize == j).map_or(0.0, |at| values[at])
                };
                for j in 0..pairs.len() {
                    assert_eq!(value(j), all.between(i, j));
                    let lengths = (pairs[i].source - pairs[j].source).norm()
                        - (pairs[i].target - pairs[j].target).norm();
                    let expected = (1.0 - (lengths / 0.3).powi(2)).max(0.0);
                    assert!((f64::from(value(j)) - expected).abs() < 1e-5);
                }
            }
        }
    }
}
