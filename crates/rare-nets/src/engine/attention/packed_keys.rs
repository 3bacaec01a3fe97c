//! Keys and values in the order in which the products of attention read them.

use half::bf16;
use rayon::prelude::*;

use super::super::arena::Lent;
use super::super::convolution::Context;
use super::super::cpu::Precision;
use super::super::simd::LANES;
use super::super::tensor::{Tensor, Values};
use super::super::vectors::Element;
use super::{Keys, PANEL};

/// Keys and values of all images and heads in the order of the products.
pub(super) struct PackedKeys {
    /// For each image and head: panels of [`PANEL`] keys, each with all units of the head's channels.
    pub(super) keys: Lent,
    /// For each image and head: all keys (or pairs of keys), each with the head's channels.
    pub(super) values: Lent,
    pub(super) images: usize,
    /// How many keys there are.
    pub(super) count: usize,
    /// The same, filled up to whole panels.
    pub(super) padded: usize,
    /// Units of a head's channels.
    pub(super) units: usize,
    /// A head's channels, filled up to whole vectors.
    pub(super) width: usize,
    /// Units of a head's keys, and of its values.
    pub(super) key_length: usize,
    pub(super) value_length: usize,
}

impl PackedKeys {
    pub(super) fn new(
        context: Context<'_>,
        images: &[(Keys<'_>, usize)],
        head: usize,
        heads: usize,
    ) -> PackedKeys {
        let shape = images[0].0.tensor.shape;
        let count = shape.height * shape.width;
        let padded = count.next_multiple_of(PANEL);
        let (units, width) = (context.precision.units(head), head.next_multiple_of(LANES));
        let key_length = padded * units;
        let value_length = context.precision.units(padded) * width;
        let parts = images.len() * heads;
        let mut packed = PackedKeys {
            keys: context.arena.lend(parts * key_length * 4),
            values: context.arena.lend(parts * value_length * 4),
            images: images.len(),
            count,
            padded,
            units,
            width,
            key_length,
            value_length,
        };
        let keys = packed.keys.slice_mut::<f32>().par_chunks_exact_mut(key_length);
        let values = packed.values.slice_mut::<f32>().par_chunks_exact_mut(value_length);
        keys.zip(values).take(parts).enumerate().for_each(|(part, (keys, values))| {
            let (source, image) = images[part / heads];
            let first = |channel: usize| channel + part % heads * head;
            let from = |channel: usize| HeadOf {
                source: source.tensor,
                image,
                first: first(channel),
                head,
            };
            match context.precision {
                Precision::F32 => {
                    from(source.first_key).pack(keys, |key, channel| {
                        (key / PANEL * units + channel) * PANEL + key % PANEL
                    });
                    from(source.first_value).pack(values, |key, channel| key * width + channel);
                }
                Precision::Bf16 => {
                    from(source.first_key).pack::<bf16>(
                        bytemuck::must_cast_slice_mut(keys),
                        |key, channel| {
                            let unit = (key / PANEL * units + channel / 2) * PANEL + key % PANEL;
                            2 * unit + channel % 2
                        },
                    );
                    from(source.first_value)
                        .pack::<bf16>(bytemuck::must_cast_slice_mut(values), |key, channel| {
                            2 * (key / 2 * width + channel) + key % 2
                        });
                }
            }
        });
        packed
    }
}

/// One head's channels of one image.
struct HeadOf<'a> {
    source: &'a Tensor,
    image: usize,
    first: usize,
    head: usize,
}

impl HeadOf<'_> {
    /// Puts every channel of every pixel in its place, and zeros everywhere else.
    fn pack<T: FromFloat>(&self, target: &mut [T], place: impl Fn(usize, usize) -> usize) {
        target.fill(T::default());
        let shape = self.source.shape;
        let pixels = shape.height * shape.width;
        for key in 0..pixels {
            let start = (self.image * pixels + key) * shape.channels + self.first;
            match self.source.values(start, self.head) {
                Values::F32(values) => {
                    for (channel, value) in values.iter().enumerate() {
                        target[place(key, channel)] = T::from_float(*value);
                    }
                }
                Values::Bf16(values) => {
                    for (channel, value) in values.iter().enumerate() {
                        target[place(key, channel)] = T::from_float(value.to_f32());
                    }
                }
            }
        }
    }
}

/// What keys and values are kept as.
trait FromFloat: Element {
    fn from_float(value: f32) -> Self;
}

impl FromFloat for f32 {
    fn from_float(value: f32) -> f32 {
        value
    }
}

impl FromFloat for bf16 {
    fn from_float(value: f32) -> bf16 {
        bf16::from_f32(value)
    }
}
