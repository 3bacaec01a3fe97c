//! Which fine points of two patches belong together.

use rare::Result;
use rayon::prelude::*;

use super::CoFiNetConfig;
use super::coarse::CoarsePair;
use super::layout::FINE;
use super::patches::Patches;
use super::sinkhorn::with_slack;
use crate::Matrix;
use crate::backbones::hourglass::{MessagePassing, Turns};
use crate::engine::CpuBackend;
use crate::layers::{Linear, Weights, products};

/// Pairs of patches that are computed together; independent of the number of threads.
const BLOCK: usize = 16;
/// The score of what fills a patch up.
const FILLING: f32 = -1e6;

/// A fine point of either cloud and how sure it is that they belong together, 0 to 1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FinePair {
    /// Index into the fine points of the source.
    pub source: usize,
    /// Index into the fine points of the target.
    pub target: usize,
    /// How sure it is: the product of the confidences of the coarse points and of these.
    pub confidence: f32,
}

/// The layers between the fine points of patches.
pub(super) struct FineMatching {
    attentions: [MessagePassing; 3],
    last: Linear,
    iterations: usize,
}

/// The clouds, their fine features and the patches.
pub(super) struct Sides<'a> {
    pub(super) features: [&'a Matrix; 2],
    pub(super) patches: [&'a Patches; 2],
}

/// What a pair of patches came to.
pub(super) struct Matched {
    /// Logarithms of confidences with slack, a row and a column more than a patch has points.
    pub(super) scores: Matrix,
    pub(super) pairs: Vec<FinePair>,
}

impl FineMatching {
    pub(super) fn read(
        cpu: &CpuBackend,
        weights: &Weights<'_>,
        config: &CoFiNetConfig,
    ) -> Result<FineMatching> {
        let [first, second, third] = FINE;
        let attention = |name| MessagePassing::read(cpu, weights, name, config.heads);
        Ok(FineMatching {
            attentions: [attention(first)?, attention(second)?, attention(third)?],
            last: weights.linear(cpu, "l_final_proj")?,
            iterations: config.iterations,
        })
    }

    /// Matches the patches of all pairs, in their order.
    pub(super) fn apply(
        &self,
        cpu: &CpuBackend,
        sides: &Sides<'_>,
        pairs: &[CoarsePair],
    ) -> Result<Vec<Matched>> {
        let blocks = pairs.par_chunks(BLOCK).map(|block| self.block(cpu, sides, block));
        let blocks = blocks.collect::<Result<Vec<_>>>()?;
        Ok(blocks.into_iter().flatten().collect())
    }

    fn block(
        &self,
        cpu: &CpuBackend,
        sides: &Sides<'_>,
        pairs: &[CoarsePair],
    ) -> Result<Vec<Matched>> {
        let of_source: Vec<usize> = pairs.iter().map(|pair| pair.source).collect();
        let of_target: Vec<usize> = pairs.iter().map(|pair| pair.target).collect();
        let mut clouds = [sides.gathered(0, &of_source), sides.gathered(1, &of_target)];
        for (attention, turns) in self.attentions.iter().zip([Turns::Own, Turns::Other, Turns::Own])
        {
            attention.update(cpu, &mut clouds, pairs.len(), turns)?;
        }
        let [source, target] = clouds;
        let (source, target) = (self.last.apply(cpu, &source)?, self.last.apply(cpu, &target)?);
        let size = sides.patches[0].size;
        let matched = |(index, pair): (usize, &CoarsePair)| {
            let patches = [source.part(index * size, size), target.part(index * size, size)];
            let mut scores = products(cpu, &patches[0], &patches[1])?;
            sides.mask(&mut scores, pair, source.columns());
            let scores = with_slack(&scores, self.iterations)?;
            let pairs = sides.picked(&scores, pair);
            Ok(Matched { scores, pairs })
        };
        pairs.iter().enumerate().map(matched).collect()
    }
}

impl Sides<'_> {
    /// The features of the points of some patches of one cloud, patch by patch, each filled up.
    fn gathered(&self, side: usize, patches: &[usize]) -> Matrix {
        let slots = patches.iter().flat_map(|&patch| self.patches[side].slots(patch));
        self.features[side].gather(slots.collect::<Vec<_>>().into_iter())
    }

    /// Divides products by the root of their length, and takes what fills the patches out of the contest.
    fn mask(&self, scores: &mut Matrix, pair: &CoarsePair, length: usize) {
        let rows = self.patches[0].members(pair.source).len();
        let columns = self.patches[1].members(pair.target).len();
        let factor = 1.0 / (length as f32).sqrt();
        let width = scores.columns().max(1);
        for (row, scores) in scores.values_mut().chunks_exact_mut(width).enumerate() {
            for (column, score) in scores.iter_mut().enumerate() {
                *score = if row < rows && column < columns { *score * factor } else { FILLING };
            }
        }
    }

    /// The pairs that are the best of their row or of their column, in the order of rows, then columns. What is best
    /// without partner is left out.
    fn picked(&self, scores: &Matrix, pair: &CoarsePair) -> Vec<FinePair> {
        let (rows, columns) = (scores.rows() - 1, scores.columns() - 1);
        let mut picked: Vec<[usize; 2]> =
            (0..rows).map(|row| [row, best(scores.row(row))]).collect();
        let transposed = scores.transposed();
        picked.extend((0..columns).map(|column| [best(transposed.row(column)), column]));
        picked.sort_unstable();
        picked.dedup();
        let place = |[row, column]: [usize; 2]| {
            Some(FinePair {
                source: *self.patches[0].members(pair.source).get(row)?,
                target: *self.patches[1].members(pair.target).get(column)?,
                confidence: scores.row(row).get(column)?.exp() * pair.confidence,
            })
        };
        picked.into_iter().filter_map(place).collect()
    }
}

/// The place of the largest value, of equal ones the first.
fn best(values: &[f32]) -> usize {
    let first = (0, f32::NEG_INFINITY);
    let larger = |best: (usize, f32), (index, &value): (usize, &f32)| {
        if value > best.1 { (index, value) } else { best }
    };
    values.iter().enumerate().fold(first, larger).0
}
