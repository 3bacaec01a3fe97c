//! Attention without its matrix: blocks of keys pass by a block of queries, and a running maximum and sum replace the
//! softmax over all keys (Milakov and Gimelshein: Online normalizer calculation for softmax, 2018; Dao et al.:
//! `FlashAttention`, 2022).

mod packed_keys;

use half::bf16;
use rare::{Error, Result};
use rayon::prelude::*;

use super::convolution::Context;
use super::cpu::Precision;
use super::math::exp2;
use super::shared_output::SharedOutput;
use super::simd::{LANES, Simd, Vectorized};
use super::tensor::{Elements, Tensor};
use super::tile::{Segment, Tile};
use super::vectors::{Element, load, load_values, store};
use packed_keys::PackedKeys;

/// Queries of a block.
const QUERIES: usize = 56;
/// Keys of a block: scores of a block of queries fit the second-level cache beside keys and values.
const KEYS: usize = 512;
/// Keys of a panel: two groups.
const PANEL: usize = 2 * LANES;
/// The score of what must not be seen: its exponential is below 1e-37, and no arithmetic on it gives infinity.
const UNSEEN: f32 = -1e30;

/// Where keys and values are.
#[derive(Clone, Copy)]
pub(super) struct Keys<'a> {
    pub(super) tensor: &'a Tensor,
    /// First channel of the keys.
    pub(super) first_key: usize,
    /// First channel of the values.
    pub(super) first_value: usize,
}

/// Attention of queries (the first `channels` channels of each pixel) to keys. One tensor of keys with as many images
/// serves each image its own; otherwise every tensor of one image serves an equal share of the images.
pub(super) fn attend(
    context: Context<'_>,
    queries: &Tensor,
    keys: &[Keys<'_>],
    channels: usize,
    heads: usize,
    causal: bool,
) -> Result<Tensor> {
    let images = sources(queries, keys);
    let fits = |keys: &Keys<'_>| keys.first_value + channels == keys.tensor.shape.channels;
    let divides = heads > 0 && channels > 0 && channels.is_multiple_of(heads);
    if images.is_empty() || !divides || !keys.iter().all(fits) {
        return Err(Error::Internal(format!(
            "attention of {:?} with {heads} heads to {} tensors of keys does not fit",
            queries.shape,
            keys.len()
        )));
    }
    let elements = match context.precision {
        Precision::F32 => Elements::F32,
        Precision::Bf16 => Elements::Bf16,
    };
    let shape = super::Shape { channels, ..queries.shape };
    let mut buffer = context.arena.lend(shape.values() * elements.bytes());
    let attention = Attention {
        context,
        queries,
        channels,
        head: channels / heads,
        heads,
        causal,
        packed: PackedKeys::new(context, &images, channels / heads, heads),
    };
    match elements {
        Elements::F32 => attention.compute::<f32>(&mut buffer.slice_mut()[..shape.values()]),
        Elements::Bf16 => attention.compute::<bf16>(&mut buffer.slice_mut()[..shape.values()]),
    }
    Ok(Tensor { shape, elements, buffer })
}

/// Images of keys, one after the other; none if they cannot be shared out.
fn sources<'a>(queries: &Tensor, keys: &[Keys<'a>]) -> Vec<(Keys<'a>, usize)> {
    let batch = queries.shape.batch;
    let images: Vec<_> = keys
        .iter()
        .flat_map(|keys| (0..keys.tensor.shape.batch).map(move |image| (*keys, image)))
        .collect();
    let tokens = |keys: &Keys<'_>| keys.tensor.shape.height * keys.tensor.shape.width;
    let same = keys.windows(2).all(|pair| tokens(&pair[0]) == tokens(&pair[1]));
    let shared = !images.is_empty() && batch.is_multiple_of(images.len());
    if same && shared { images } else { Vec::new() }
}

struct Attention<'a> {
    context: Context<'a>,
    queries: &'a Tensor,
    channels: usize,
    /// Channels of a head.
    head: usize,
    heads: usize,
    causal: bool,
    packed: PackedKeys,
}

impl Attention<'_> {
    fn compute<T: Element>(&self, output: &mut [T]) {
        let shape = self.queries.shape;
        let pixels = shape.height * shape.width;
        let blocks = pixels.div_ceil(QUERIES);
        let output = SharedOutput::new(output);
        let items = shape.batch * self.heads * blocks;
        (0..items).into_par_iter().with_max_len(1).for_each(|item| {
            let (part, block) = (item / blocks, item % blocks);
            let first = pixels * block / blocks;
            self.context.processor.run(QueryBlock {
                attention: self,
                image: part / self.heads,
                head: part % self.heads,
                first,
                count: pixels * (block + 1) / blocks - first,
                output: &output,
            });
        });
    }
}

/// Some queries of one head of one image.
struct QueryBlock<'a, T> {
    attention: &'a Attention<'a>,
    image: usize,
    head: usize,
    first: usize,
    count: usize,
    output: &'a SharedOutput<'a, T>,
}

/// What a block of queries knows after some keys.
struct Running<'a> {
    /// The largest score of each query.
    largest: [f32; QUERIES],
    /// The sum of exponentials of each query, relative to the largest.
    sum: [f32; QUERIES],
    /// The values, weighted with the exponentials.
    values: &'a mut [f32],
}

impl<T: Element> Vectorized for QueryBlock<'_, T> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Attention { context, packed, .. } = self.attention;
        let mut lent = context.arena.lend((QUERIES * (packed.units + packed.width + 2 * KEYS)) * 4);
        let (queries, rest) = lent.slice_mut::<f32>().split_at_mut(QUERIES * packed.units);
        let (values, rest) = rest.split_at_mut(QUERIES * packed.width);
        let (scores, halves) = rest.split_at_mut(QUERIES * KEYS);
        self.copy_queries(simd, queries);
        values.fill(0.0);
        let mut running = Running { largest: [UNSEEN; QUERIES], sum: [0.0; QUERIES], values };
        for first_key in (0..packed.padded).step_by(KEYS) {
            let keys = KEYS.min(packed.padded - first_key);
            self.score(queries, first_key, keys, scores);
            self.exponentiate(simd, first_key, keys, scores, halves, &mut running);
            let weights = match context.precision {
                Precision::F32 => &*scores,
                Precision::Bf16 => &*halves,
            };
            self.weigh(first_key, keys, weights, &mut running);
        }
        self.write(simd, &running);
    }
}

impl<T: Element> QueryBlock<'_, T> {
    /// The head's channels of the queries, in the precision of the products.
    #[inline(always)]
    fn copy_queries<S: Simd>(&self, simd: S, target: &mut [f32]) {
        let Attention { context, queries, packed, head, .. } = self.attention;
        let shape = queries.shape;
        for query in 0..self.count {
            let pixel = self.image * shape.height * shape.width + self.first + query;
            let source = queries.values(pixel * shape.channels + self.head * head, *head);
            let target = &mut target[query * packed.units..(query + 1) * packed.units];
            // A head with an odd number of channels ends in half a unit.
            target.fill(0.0);
            for channel in (0..*head).step_by(LANES) {
                let value = load_values(simd, source, channel);
                match context.precision {
                    Precision::F32 => store(simd, value, target, channel),
                    Precision::Bf16 => {
                        let target: &mut [bf16] = bytemuck::must_cast_slice_mut(target);
                        store(simd, value, &mut target[..*head], channel);
                    }
                }
            }
        }
    }

    /// Products of all queries with some keys.
    fn score(&self, queries: &[f32], first_key: usize, keys: usize, scores: &mut [f32]) {
        let Attention { context, packed, heads, .. } = self.attention;
        let part = self.source() * heads + self.head;
        let start = part * packed.key_length + first_key * packed.units;
        let columns = &packed.keys.slice::<f32>()[start..start + keys * packed.units];
        let rows = rows(packed.units);
        let segments = [Segment { offset: 0, steps: packed.units as u32 }];
        for (panel, columns) in columns.chunks_exact(PANEL * packed.units).enumerate() {
            let tile = Tile {
                a: queries,
                rows: &rows[..self.count],
                segments: &segments,
                b: columns,
                b_stride: PANEL,
                c_stride: KEYS,
                groups: PANEL / LANES,
                accumulate: false,
            };
            tile.multiply(context.processor, context.precision, &mut scores[panel * PANEL..]);
        }
    }

    /// The image of keys that serves this image.
    fn source(&self) -> usize {
        self.image * self.attention.packed.images / self.attention.queries.shape.batch
    }

    /// Turns scores into exponentials relative to the new maximum, and scales what was summed before to it.
    #[inline(always)]
    fn exponentiate<S: Simd>(
        &self,
        simd: S,
        first_key: usize,
        keys: usize,
        scores: &mut [f32],
        halves: &mut [f32],
        running: &mut Running<'_>,
    ) {
        let Attention { context, packed, causal, head, .. } = self.attention;
        let factor = std::f32::consts::LOG2_E / (*head as f32).sqrt();
        for query in 0..self.count {
            let limit = if *causal { self.first + query + 1 } else { packed.count };
            let seen = limit.min(packed.count).saturating_sub(first_key).min(keys);
            let scores = &mut scores[query * KEYS..query * KEYS + keys];
            scores[seen..].fill(UNSEEN);
            let before = running.largest[query];
            let largest = before.max(maximum(simd, scores));
            let sum = match context.precision {
                Precision::F32 => exponentials(simd, scores, factor, largest, |_, _| ()),
                Precision::Bf16 => {
                    let halves = &mut halves[query * KEYS / 2..query * KEYS / 2 + keys / 2];
                    let halves: &mut [bf16] = bytemuck::must_cast_slice_mut(halves);
                    exponentials(simd, scores, factor, largest, |index, value| {
                        store(simd, value, halves, index);
                    })
                }
            };
            let correction = ((before - largest) * factor).exp2();
            running.largest[query] = largest;
            running.sum[query] = running.sum[query] * correction + sum;
            if before < largest {
                let values = &mut running.values[query * packed.width..(query + 1) * packed.width];
                for value in values.as_chunks_mut::<LANES>().0 {
                    let scaled = simd.mul(simd.load(value), simd.splat(correction));
                    simd.store(scaled, value);
                }
            }
        }
    }

    /// Adds the values of some keys, weighted.
    fn weigh(&self, first_key: usize, keys: usize, weights: &[f32], running: &mut Running<'_>) {
        let Attention { context, packed, heads, .. } = self.attention;
        let (before, steps) = (context.precision.units(first_key), context.precision.units(keys));
        let start = (self.source() * heads + self.head) * packed.value_length;
        let values = &packed.values.slice::<f32>()[start..start + packed.value_length];
        let tile = Tile {
            a: weights,
            rows: &rows(context.precision.units(KEYS))[..self.count],
            segments: &[Segment { offset: 0, steps: steps as u32 }],
            b: &values[before * packed.width..(before + steps) * packed.width],
            b_stride: packed.width,
            c_stride: packed.width,
            groups: packed.width / LANES,
            accumulate: true,
        };
        tile.multiply(context.processor, context.precision, running.values);
    }

    /// Divides by the sums.
    #[inline(always)]
    fn write<S: Simd>(&self, simd: S, running: &Running<'_>) {
        let Attention { queries, packed, channels, head, .. } = self.attention;
        let pixels = queries.shape.height * queries.shape.width;
        for query in 0..self.count {
            let pixel = self.image * pixels + self.first + query;
            // SAFETY: a head's channels of a pixel are written by the one block that has this query.
            #[allow(unsafe_code)]
            let target = unsafe { self.output.part(pixel * channels + self.head * head, *head) };
            let values = &running.values[query * packed.width..];
            let inverse = simd.splat(1.0 / running.sum[query]);
            for channel in (0..*head).step_by(LANES) {
                store(simd, simd.mul(load(simd, values, channel), inverse), target, channel);
            }
        }
    }
}

/// Where rows of this length begin.
fn rows(length: usize) -> [u32; QUERIES] {
    std::array::from_fn(|row| (row * length) as u32)
}

/// The largest of some scores (whole vectors).
#[inline(always)]
fn maximum<S: Simd>(simd: S, scores: &[f32]) -> f32 {
    let mut largest = simd.splat(UNSEEN);
    for scores in scores.as_chunks::<LANES>().0 {
        largest = simd.max(largest, simd.load(scores));
    }
    simd.maximum(largest)
}

/// `2^(factor * (score - largest))` in the place of each score (whole vectors), which are also handed to `also`; gives
/// their sum.
#[inline(always)]
fn exponentials<S: Simd>(
    simd: S,
    scores: &mut [f32],
    factor: f32,
    largest: f32,
    mut also: impl FnMut(usize, S::Floats),
) -> f32 {
    let (factor, shift) = (simd.splat(factor), simd.splat(-largest * factor));
    let mut sum = simd.splat(0.0);
    for (index, scores) in scores.as_chunks_mut::<LANES>().0.iter_mut().enumerate() {
        let value = exp2(simd, simd.mul_add(simd.load(scores), factor, shift));
        sum = simd.add(sum, value);
        simd.store(value, scores);
        also(index * LANES, value);
    }
    simd.sum(sum)
}
