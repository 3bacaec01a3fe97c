//! The correspondences that belong to a seed, by the votes of all layers (section 3.3 of the paper).
//!
//! Every layer says twice how much each correspondence has to do with a seed: by the likeness of their features times
//! their spatial consistency, and by its attention. The most related ones of each of these rankings get a vote. Of the
//! shares of votes after one ranking, two, and so on, the lower bound of Wilson's confidence interval counts (Wilson
//! 1927), at its largest.
//!
//! No matrix over all correspondences is formed: only those that are consistent with the seed can be related to it.

use rare::pose::Mode;

use super::super::compatibility::Compatibilities;
use super::super::encoder::CHANNELS;
use super::super::seed_consensus::{dot, similarity};
use super::network::Record;

/// The quantile of the confidence interval: 95 percent.
const QUANTILE: f64 = 1.96;
/// Width of the likeness of features, that which the released code has before it loads weights.
const LIKENESS_SIGMA: f32 = 1.0;

/// What the votes need.
pub(super) struct Votes<'a> {
    pub(super) compatibilities: &'a Compatibilities,
    /// Of all layers, the first first. The last layer votes first.
    pub(super) records: &'a [Record],
    /// Number of correspondences.
    pub(super) pairs: usize,
    pub(super) mode: Mode,
}

/// How much a correspondence has to do with the seed.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Related {
    other: usize,
    value: f32,
}

impl Votes<'_> {
    /// The seed and the `count - 1` correspondences with the most votes, ties by the lowest index.
    pub(super) fn consensus(&self, seed: usize, count: usize) -> Vec<usize> {
        let others = count.saturating_sub(1);
        let (consistent, consistencies) = self.compatibilities.row(seed);
        let mut votes = vec![0_u32; self.pairs];
        let mut bounds = vec![0.0; self.pairs];
        let mut rankings = 0;
        for record in self.records.iter().rev() {
            let likeness = |other: usize, consistency: f32| {
                let (a, b) = (record.features.row(seed), record.features.row(other));
                similarity(a, b, LIKENESS_SIGMA).clamp(0.0, 1.0) * consistency
            };
            let attention = |other: usize, consistency: f32| {
                consistency * dot(record.queries.row(seed), record.keys.row(other))
            };
            for by_attention in [false, true] {
                let related = consistent.iter().zip(&consistencies);
                let related = related.map(|(&other, &consistency)| Related {
                    other: other as usize,
                    value: if by_attention {
                        attention(other as usize, consistency)
                    } else {
                        likeness(other as usize, consistency)
                    },
                });
                let related = related.filter(|related| related.other != seed).collect();
                rankings += 1;
                for other in self.most_related(related, seed, others, by_attention) {
                    votes[other] += 1;
                    // Without a vote the bound falls.
                    let bound = lower_bound(f64::from(votes[other]), f64::from(rankings));
                    bounds[other] = bound.max(bounds[other]);
                }
            }
        }
        self.elected(seed, others, &bounds)
    }

    /// The `count` most related to the seed of all, of which `related` lists those that are consistent with it.
    fn most_related(
        &self,
        mut related: Vec<Related>,
        seed: usize,
        count: usize,
        by_attention: bool,
    ) -> Vec<usize> {
        related.sort_unstable_by(|a, b| b.value.total_cmp(&a.value).then(a.other.cmp(&b.other)));
        let positive = related.partition_point(|related| related.value > 0.0);
        let mut most: Vec<usize> =
            related.iter().take(count.min(positive)).map(|r| r.other).collect();
        if self.mode == Mode::Fixed || most.len() == count {
            return most;
        }
        // All that are not listed, and the seed itself but for attention, count as 0.
        let mut is_other = vec![false; self.pairs];
        let nonzero = related.iter().filter(|related| related.value != 0.0);
        nonzero.for_each(|related| is_other[related.other] = true);
        is_other[seed] |= by_attention;
        most.extend((0..self.pairs).filter(|&other| !is_other[other]).take(count - most.len()));
        let negative = related.iter().filter(|related| related.value < 0.0);
        most.extend(negative.map(|related| related.other).take(count - most.len()));
        most
    }

    fn elected(&self, seed: usize, count: usize, bounds: &[f64]) -> Vec<usize> {
        let mut order: Vec<usize> = (0..bounds.len()).filter(|&other| other != seed).collect();
        let before = |a: &usize, b: &usize| bounds[*b].total_cmp(&bounds[*a]).then(a.cmp(b));
        if count > 0 && count < order.len() {
            order.select_nth_unstable_by(count - 1, before);
        }
        order.truncate(count);
        order.sort_unstable_by(before);
        if self.mode == Mode::Fixed {
            order.retain(|&other| bounds[other] > 0.0);
        }
        order.insert(0, seed);
        order
    }

    /// The attention of a correspondence to all others in a layer: a row of its softmax, 0 for itself.
    pub(super) fn attention(&self, layer: &Record, seed: usize) -> Vec<f32> {
        let (consistent, consistencies) = self.compatibilities.row(seed);
        let mut scores = vec![0.0; self.pairs];
        let scale = (CHANNELS as f32).sqrt();
        for (&other, consistency) in consistent.iter().zip(consistencies) {
            let other = other as usize;
            scores[other] =
                consistency * dot(layer.queries.row(seed), layer.keys.row(other)) / scale;
        }
        let largest = scores.iter().copied().fold(f32::MIN, f32::max);
        scores.iter_mut().for_each(|score| *score = (*score - largest).exp());
        let sum: f32 = scores.iter().sum();
        scores.iter_mut().for_each(|score| *score /= sum);
        scores[seed] = 0.0;
        scores
    }
}

/// The lower bound of Wilson's confidence interval of a share of `votes` among `count`.
fn lower_bound(votes: f64, count: f64) -> f64 {
    let share = votes / count;
    let square = QUANTILE * QUANTILE;
    let spread = (share * (1.0 - share) / count + square / (4.0 * count * count)).sqrt();
    (share + square / (2.0 * count) - QUANTILE * spread) / (1.0 + square / count)
}
