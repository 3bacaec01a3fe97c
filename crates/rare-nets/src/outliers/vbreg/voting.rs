//! The correspondences that belong to a seed, by the votes of all layers (section 3.3 of the paper).
//!
//! Every layer says twice how much each correspondence has to do with a seed: by the likeness of their features times
//! their spatial consistency, and by its attention. The most related ones of each of these rankings get a vote. Of the
//! shares of votes after one ranking, two, and so on, the lower bound of Wilson's confidence interval counts (Wilson
//! 1927), at its largest.
//!
//! No matrix over all correspondences is formed: only those that are consistent with the seed can be related to it.

use rare::Result;
use rare::pose::Mode;

use super::super::compatibility::Compatibilities;
use super::super::encoder::CHANNELS;
use super::super::seed_consensus::{dot, similarity};
use super::network::Record;
use crate::Matrix;
use crate::engine::{Columns, CpuBackend, FactorRows};

/// The quantile of the confidence interval: 95 percent.
const QUANTILE: f64 = 1.96;
/// Width of the likeness of features, that which the released code has before it loads weights.
const LIKENESS_SIGMA: f32 = 1.0;

/// What the votes need.
pub(super) struct Votes<'a> {
    pub(super) cpu: &'a CpuBackend,
    pub(super) compatibilities: &'a Compatibilities,
    /// Of all layers, the first first. The last layer votes first.
    pub(super) records: &'a [Record],
    /// Number of correspondences.
    pub(super) pairs: usize,
    pub(super) mode: Mode,
}

/// What a layer says of a correspondence.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Ranking {
    /// How like its features are, times their consistency.
    Likeness,
    /// How much attention it gets.
    Attention,
}

/// How much a correspondence has to do with the seed.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Related {
    other: usize,
    value: f32,
}

/// The votes on the correspondences of a seed.
struct Ballot {
    seed: usize,
    votes: Vec<u8>,
    bounds: Vec<f32>,
}

impl Votes<'_> {
    /// For each seed, itself and the `count - 1` correspondences with the most votes, ties by the lowest index. (For a
    /// few seeds at a time: the votes on all correspondences are in memory.)
    ///
    /// # Errors
    /// `Internal` if sizes do not fit.
    pub(super) fn consensus(&self, seeds: &[usize], count: usize) -> Result<Vec<Vec<usize>>> {
        let others = count.saturating_sub(1);
        let mut consistent = FactorRows::default();
        for &seed in seeds {
            let (keys, values) = self.compatibilities.row(seed);
            let listed = keys.into_iter().zip(values);
            consistent.push(listed.filter(|&(key, _)| key as usize != seed));
        }
        let mut ballots: Vec<Ballot> =
            seeds.iter().map(|&seed| Ballot::new(seed, self.pairs)).collect();
        let mut rankings = 0;
        for record in self.records.iter().rev() {
            for ranking in [Ranking::Likeness, Ranking::Attention] {
                rankings += 1;
                let products = self.products(record, ranking, seeds, &consistent)?;
                for (row, ballot) in ballots.iter_mut().enumerate() {
                    let (others_of, values) = consistent.row(row);
                    let related =
                        others_of.iter().zip(values).zip(&products[consistent.range(row)]);
                    let related = related.map(|((&other, &consistency), &product)| Related {
                        other: other as usize,
                        value: ranking.value(product, consistency),
                    });
                    let elected =
                        self.most_related(related.collect(), ballot.seed, others, ranking);
                    ballot.count(&elected, rankings);
                }
            }
        }
        Ok(ballots.into_iter().map(|ballot| ballot.elected(others, self.mode)).collect())
    }

    /// The inner products of which a ranking is made.
    fn products(
        &self,
        record: &Record,
        ranking: Ranking,
        seeds: &[usize],
        consistent: &FactorRows,
    ) -> Result<Vec<f32>> {
        let (queries, keys) = match ranking {
            Ranking::Attention => (record.queries.gather(seeds.iter().copied()), &record.keys),
            Ranking::Likeness => {
                let values = seeds.iter().flat_map(|&seed| record.features.row(seed).to_vec());
                let values = values.collect();
                (Matrix::new(seeds.len(), CHANNELS, values)?, &record.features)
            }
        };
        self.cpu.listed_products(Columns::all(&queries), keys, consistent)
    }

    /// The `count` most related to the seed of all, in any order. `related` lists those that are consistent with it.
    fn most_related(
        &self,
        mut related: Vec<Related>,
        seed: usize,
        count: usize,
        ranking: Ranking,
    ) -> Vec<usize> {
        let before =
            |a: &Related, b: &Related| b.value.total_cmp(&a.value).then(a.other.cmp(&b.other));
        let positive = related.iter().filter(|related| related.value > 0.0).count();
        let wanted = count.min(positive);
        if wanted > 0 && wanted < related.len() {
            related.select_nth_unstable_by(wanted - 1, before);
        }
        let mut most: Vec<usize> = related.iter().take(wanted).map(|r| r.other).collect();
        if self.mode == Mode::Faithful && most.len() < count {
            related.sort_unstable_by(before);
            self.fill_up(&mut most, &related, seed, count, ranking);
        }
        most
    }

    /// Adds those that have nothing to do with the seed, then those that have the least.
    fn fill_up(
        &self,
        most: &mut Vec<usize>,
        related: &[Related],
        seed: usize,
        count: usize,
        ranking: Ranking,
    ) {
        // All that are not listed count as 0, as does the seed itself. Attention is never as low as that for others.
        let mut is_taken = vec![false; self.pairs];
        let nonzero = related.iter().filter(|related| related.value != 0.0);
        nonzero.for_each(|related| is_taken[related.other] = true);
        is_taken[seed] = ranking == Ranking::Attention;
        most.extend((0..self.pairs).filter(|&other| !is_taken[other]).take(count - most.len()));
        let negative = related.iter().filter(|related| related.value < 0.0);
        most.extend(negative.map(|related| related.other).take(count - most.len()));
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

impl Ranking {
    fn value(self, product: f32, consistency: f32) -> f32 {
        match self {
            Ranking::Likeness => similarity(product, LIKENESS_SIGMA).clamp(0.0, 1.0) * consistency,
            // Of one row of a softmax, the order is that of the scores.
            Ranking::Attention => product * consistency,
        }
    }
}

impl Ballot {
    fn new(seed: usize, pairs: usize) -> Ballot {
        Ballot { seed, votes: vec![0; pairs], bounds: vec![0.0; pairs] }
    }

    fn count(&mut self, elected: &[usize], rankings: u8) {
        for &other in elected {
            self.votes[other] += 1;
            // Without a vote the bound falls.
            let bound = lower_bound(f64::from(self.votes[other]), f64::from(rankings)) as f32;
            self.bounds[other] = bound.max(self.bounds[other]);
        }
    }

    /// The seed and the others with the highest bounds.
    fn elected(&self, count: usize, mode: Mode) -> Vec<usize> {
        let Ballot { seed, bounds, .. } = self;
        let has_votes = |other: &usize| mode == Mode::Faithful || bounds[*other] > 0.0;
        let mut order: Vec<usize> =
            (0..bounds.len()).filter(|other| other != seed && has_votes(other)).collect();
        let before = |a: &usize, b: &usize| bounds[*b].total_cmp(&bounds[*a]).then(a.cmp(b));
        if count > 0 && count < order.len() {
            order.select_nth_unstable_by(count - 1, before);
        }
        order.truncate(count);
        order.sort_unstable_by(before);
        order.insert(0, *seed);
        order
    }
}

/// The lower bound of Wilson's confidence interval of a share of `votes` among `count`.
fn lower_bound(votes: f64, count: f64) -> f64 {
    let share = votes / count;
    let square = QUANTILE * QUANTILE;
    let spread = (share * (1.0 - share) / count + square / (4.0 * count * count)).sqrt();
    (share + square / (2.0 * count) - QUANTILE * spread) / (1.0 + square / count)
}
