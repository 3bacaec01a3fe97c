//! Activations in memory: pixel by pixel, all channels of a pixel together.

use half::bf16;

use super::arena::Lent;
use super::backend::Shape;
use super::cpu::Precision;

/// A tensor of activations on the CPU.
#[derive(Debug)]
pub struct Tensor {
    pub(super) shape: Shape,
    pub(super) elements: Elements,
    pub(super) buffer: Lent,
}

/// What a tensor's elements are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Elements {
    F32,
    /// Only of intermediate results, which go into products of that precision.
    Bf16,
}

/// Some elements of a tensor.
#[derive(Debug, Clone, Copy)]
pub(super) enum Values<'a> {
    F32(&'a [f32]),
    Bf16(&'a [bf16]),
}

impl<'a> Values<'a> {
    /// `count` elements from `start`.
    #[inline(always)]
    pub(super) fn part(self, start: usize, count: usize) -> Values<'a> {
        match self {
            Values::F32(values) => Values::F32(&values[start..start + count]),
            Values::Bf16(values) => Values::Bf16(&values[start..start + count]),
        }
    }

    pub(super) fn len(self) -> usize {
        match self {
            Values::F32(values) => values.len(),
            Values::Bf16(values) => values.len(),
        }
    }
}

impl Elements {
    pub(super) fn bytes(self) -> usize {
        match self {
            Elements::F32 => 4,
            Elements::Bf16 => 2,
        }
    }

    /// The products that take these elements as they are.
    pub(super) fn precision(self) -> Precision {
        match self {
            Elements::F32 => Precision::F32,
            Elements::Bf16 => Precision::Bf16,
        }
    }
}

impl Tensor {
    /// `count` elements from `start`.
    pub(super) fn values(&self, start: usize, count: usize) -> Values<'_> {
        match self.elements {
            Elements::F32 => Values::F32(&self.buffer.slice()[start..start + count]),
            Elements::Bf16 => Values::Bf16(&self.buffer.slice()[start..start + count]),
        }
    }

    /// One row of pixels.
    pub(super) fn row(&self, image: usize, y: usize) -> Values<'_> {
        let length = self.shape.width * self.shape.channels;
        self.values((image * self.shape.height + y) * length, length)
    }

    /// All elements, if they are in single precision.
    pub(super) fn as_f32(&self) -> Option<&[f32]> {
        match self.values(0, self.shape.values()) {
            Values::F32(values) => Some(values),
            Values::Bf16(_) => None,
        }
    }
}
