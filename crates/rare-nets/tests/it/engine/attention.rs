//! Attention: sizes of all kinds, and scores that a softmax in low precision would not survive.

use std::fmt;

use rare::Result;
use rare_nets::engine::{Backend, Precision, Shape};

use super::convolution::Case;
use super::{Candidates, Operation, numbers, uploaded};

/// Attention of random pixels to each other.
#[derive(Debug)]
pub(super) struct SelfAttention {
    pub(super) batch: usize,
    pub(super) tokens: usize,
    pub(super) heads: usize,
    /// Channels of a head.
    pub(super) head: usize,
    pub(super) causal: bool,
}

impl SelfAttention {
    fn input(&self) -> Shape {
        let channels = 3 * self.heads * self.head;
        Shape { batch: self.batch, height: 1, width: self.tokens, channels }
    }
}

impl Operation for SelfAttention {
    fn run<B: Backend>(&self, backend: &B) -> Result<Vec<f32>> {
        let input = uploaded(backend, 1, self.input())?;
        let attended = backend.self_attention(&input, self.heads, self.causal)?;
        let channels = self.heads * self.head;
        assert_eq!(backend.shape(&attended), Shape { channels, ..self.input() });
        backend.download(&attended)
    }
}

/// Attention of random pixels to contexts, a third as many pixels as tokens of a context.
#[derive(Debug)]
pub(super) struct CrossAttention {
    pub(super) batch: usize,
    pub(super) contexts: usize,
    pub(super) tokens: usize,
    pub(super) heads: usize,
    /// Channels of a head.
    pub(super) head: usize,
}

impl Operation for CrossAttention {
    fn run<B: Backend>(&self, backend: &B) -> Result<Vec<f32>> {
        let channels = self.heads * self.head;
        let (height, width) = (2, self.tokens.div_ceil(6));
        let queries = Shape { batch: self.batch, height, width, channels };
        let context = Shape { batch: 1, height: 1, width: self.tokens, channels: 2 * channels };
        let tensors = (0..self.contexts)
            .map(|index| uploaded(backend, 2 + index as u64, context))
            .collect::<Result<Vec<B::Tensor>>>()?;
        let tensors: Vec<&B::Tensor> = tensors.iter().collect();
        let input = uploaded(backend, 1, queries)?;
        let attended = backend.cross_attention(&input, &tensors, self.heads)?;
        assert_eq!(backend.shape(&attended), queries);
        backend.download(&attended)
    }
}

/// Single precision: measured 1.1e-6.
fn single() -> Candidates {
    Candidates::new(Precision::F32, 3e-6)
}

/// Factors and results of 8 bits: measured 5.3e-3.
fn half() -> Candidates {
    Candidates::new(Precision::Bf16, 1e-2)
}

#[test]
fn pixels_attend_to_each_other() {
    for candidates in [single(), half()] {
        for (head, tokens) in
            [2, 3, 5, 40, 80, 160].into_iter().flat_map(|head| [1, 77, 300].map(|t| (head, t)))
        {
            for causal in [false, true] {
                let (heads, batch) = if head < 40 { (3, 2) } else { (1, 1) };
                candidates.follow(&SelfAttention { batch, tokens, heads, head, causal });
            }
        }
    }
}

#[test]
fn pixels_attend_to_contexts() {
    for candidates in [single(), half()] {
        for (head, tokens) in
            [1, 3, 16, 40].into_iter().flat_map(|head| [1, 77, 300].map(|t| (head, t)))
        {
            for (batch, contexts) in [(1, 1), (4, 1), (4, 2)] {
                candidates.follow(&CrossAttention { batch, contexts, tokens, heads: 2, head });
            }
        }
    }
}

/// A projection that stays in the precision of products, and attention to it.
#[derive(Debug)]
pub(super) struct Projected(pub(super) SelfAttention);

impl Operation for Projected {
    fn run<B: Backend>(&self, backend: &B) -> Result<Vec<f32>> {
        let shape = self.0.input();
        let input = Shape { channels: 5, ..shape };
        let case = Case { intermediate: true, ..Case::plain(input, shape.channels, 1) };
        let projected = case.convolve(backend, &uploaded(backend, 1, input)?)?;
        backend.download(&backend.self_attention(&projected, self.0.heads, self.0.causal)?)
    }
}

#[test]
fn attention_takes_intermediate_results() {
    for candidates in [single(), half()] {
        for head in [5, 40] {
            let sizes = SelfAttention { batch: 2, tokens: 77, heads: 2, head, causal: false };
            candidates.follow(&Projected(sizes));
        }
    }
}

/// Attention to given queries, keys and values of one head.
struct Given {
    head: usize,
    /// Queries, keys, values of each pixel.
    values: Vec<f32>,
}

impl fmt::Debug for Given {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "attention of {} pixels, {} channels", self.pixels(), self.head)
    }
}

impl Given {
    fn pixels(&self) -> usize {
        self.values.len() / (3 * self.head)
    }

    /// Scores as the softmax sees them, in double precision.
    fn scores(&self, query: usize) -> Vec<f64> {
        let pixel = |index: usize| &self.values[index * 3 * self.head..][..3 * self.head];
        let query = &pixel(query)[..self.head];
        let product = |key: &[f32]| {
            query.iter().zip(key).map(|(&a, &b)| f64::from(a) * f64::from(b)).sum::<f64>()
        };
        let scale = (self.head as f64).sqrt();
        (0..self.pixels()).map(|key| product(&pixel(key)[self.head..]) / scale).collect()
    }
}

impl Operation for Given {
    fn run<B: Backend>(&self, backend: &B) -> Result<Vec<f32>> {
        let shape = Shape { batch: 1, height: 1, width: self.pixels(), channels: 3 * self.head };
        let input = backend.upload(shape, &self.values)?;
        backend.download(&backend.self_attention(&input, 1, false)?)
    }
}

/// Random pixels, the first half of whose keys come again in the second half, in another block of keys. The largest
/// score is 60: rounding one factor to bf16 moves it by up to 0.1.
fn large_scores(pixels: usize, head: usize) -> Given {
    let mut given = Given { head, values: numbers(7, pixels * 3 * head) };
    for key in 0..pixels / 2 {
        let from = (key * 3 + 1) * head;
        given.values.copy_within(from..from + head, ((key + pixels / 2) * 3 + 1) * head);
    }
    let scores = (0..pixels).flat_map(|query| given.scores(query));
    let scale = (60.0 / scores.fold(0.0, f64::max)).sqrt() as f32;
    for pixel in given.values.chunks_exact_mut(3 * head) {
        pixel[..2 * head].iter_mut().for_each(|value| *value *= scale);
    }
    given
}

#[test]
fn large_scores_keep_single_precision() {
    for head in [2, 40, 80] {
        let given = large_scores(301, head);
        let twice = (0..301).filter(|&query| {
            let scores = given.scores(query);
            let largest = scores.iter().copied().fold(f64::MIN, f64::max);
            scores.iter().filter(|&&score| score == largest).count() == 2
        });
        assert!(twice.count() > 100);
        // Measured 5.5e-6.
        Candidates::new(Precision::F32, 1e-5).follow(&given);
    }
}

#[test]
fn one_key_takes_all() {
    let head = 16;
    let mut given = Given { head, values: numbers(8, 290 * 3 * head) };
    for (index, pixel) in given.values.chunks_exact_mut(3 * head).enumerate() {
        // All queries point along all keys, of which one is positive and all others negative.
        let sign = if index == 270 { 30.0 } else { -30.0 };
        pixel[..head].fill(1.25);
        pixel[head..2 * head].fill(sign);
    }
    let scores = given.scores(0);
    assert!(scores[270] - scores[0] > 250.0);
    Candidates::new(Precision::F32, 1e-7).follow(&given);
}
