//! The left operand of the matrix product: activations, normalised and activated, with a border of zeros, in the
//! precision of the products.

use std::sync::Arc;

use half::bf16;
use rayon::prelude::*;

use super::arena::{Arena, Lent};
use super::backend::Prologue;
use super::cpu::Precision;
use super::math::sigmoid_linear;
use super::normalization::{self, Affine, ImageAffine, pixel_moments};
use super::shared_output::SharedOutput;
use super::simd::{LANES, Processor, Simd, Vectorized};
use super::tensor::{Tensor, Values};
use super::vectors::{Element, load, load_values, store};

/// Activations as the product reads them.
pub(super) enum Operand<'a> {
    /// A tensor that can be read as it is.
    Direct(&'a Tensor),
    /// A copy.
    Prepared(Lent),
}

/// How an operand lies in memory, in units of 32 bits.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Layout {
    /// Rows of an image, with the border.
    pub(super) height: usize,
    /// Columns of an image, with the border.
    pub(super) width: usize,
    /// Units per pixel.
    pub(super) units: usize,
}

impl Layout {
    /// Whether offsets of 32 bits reach all units of this many images.
    pub(super) fn is_addressable(&self, images: usize) -> bool {
        let sizes = [self.height, self.width, self.units];
        let units = sizes.into_iter().try_fold(images, usize::checked_mul);
        units.is_some_and(|units| u32::try_from(units).is_ok())
    }
}

impl Operand<'_> {
    /// Everything, in units of 32 bits.
    pub(super) fn units(&self) -> &[f32] {
        match self {
            Operand::Direct(tensor) => tensor.buffer.slice(),
            Operand::Prepared(buffer) => buffer.slice(),
        }
    }
}

/// What is to be done to the input of a convolution.
pub(super) struct Preparation<'a> {
    pub(super) processor: Processor,
    pub(super) arena: &'a Arc<Arena>,
    pub(super) precision: Precision,
    pub(super) prologue: Prologue<'a>,
    pub(super) upsample: bool,
    /// Pixels of zeros on each side.
    pub(super) border: usize,
}

impl Preparation<'_> {
    /// Where the pixels of the operand will lie.
    pub(super) fn layout(&self, input: &Tensor) -> Layout {
        let factor = if self.upsample { 2 } else { 1 };
        Layout {
            height: input.shape.height * factor + 2 * self.border,
            width: input.shape.width * factor + 2 * self.border,
            units: self.precision.units(input.shape.channels),
        }
    }

    /// Makes the operand.
    pub(super) fn prepare<'a>(&self, input: &'a Tensor) -> Operand<'a> {
        let changed = self.upsample || self.border > 0 || !matches!(self.prologue, Prologue::None);
        // Pairs must not reach into the next pixel.
        let even = self.precision == Precision::F32 || input.shape.channels.is_multiple_of(2);
        if !changed && even && input.elements.precision() == self.precision {
            return Operand::Direct(input);
        }
        let layout = self.layout(input);
        let bytes = input.shape.batch * layout.height * layout.width * layout.units * 4;
        let mut buffer = self.arena.lend(bytes);
        let affine = normalization::affine(self.processor, &self.prologue, input);
        match self.precision {
            Precision::F32 => self.fill::<f32>(input, layout, &affine, buffer.slice_mut()),
            Precision::Bf16 => self.fill::<bf16>(input, layout, &affine, buffer.slice_mut()),
        }
        Operand::Prepared(buffer)
    }

    /// Writes all rows of all images, border included.
    fn fill<T: Element>(
        &self,
        input: &Tensor,
        layout: Layout,
        affine: &Affine<'_>,
        target: &mut [T],
    ) {
        let pixel = layout.units * (4 / size_of::<T>());
        let row = layout.width * pixel;
        let rows = input.shape.batch * layout.height;
        let silu = matches!(
            self.prologue,
            Prologue::Silu | Prologue::GroupNormalization { silu: true, .. }
        );
        let output = SharedOutput::new(&mut target[..rows * row]);
        (0..rows).into_par_iter().for_each(|index| {
            let (image, y) = (index / layout.height, index % layout.height);
            // SAFETY: every row is written by one call.
            #[allow(unsafe_code)]
            let target = unsafe { output.part(index * row, row) };
            let inside = (self.border..layout.height - self.border).contains(&y);
            if !inside {
                target.fill(T::default());
                return;
            }
            let (left, rest) = target.split_at_mut(self.border * pixel);
            let (target, right) = rest.split_at_mut((layout.width - 2 * self.border) * pixel);
            left.fill(T::default());
            right.fill(T::default());
            let y = if self.upsample { (y - self.border) / 2 } else { y - self.border };
            self.processor.run(PixelRow {
                source: input.row(image, y),
                channels: input.shape.channels,
                affine: affine.of_image(image),
                silu,
                repeat: if self.upsample { 2 } else { 1 },
                pixel,
                target,
            });
        });
    }
}

/// A row of pixels of the operand.
struct PixelRow<'a, T> {
    source: Values<'a>,
    channels: usize,
    affine: ImageAffine<'a>,
    silu: bool,
    /// How often each pixel is written.
    repeat: usize,
    /// Elements between pixels of the target.
    pixel: usize,
    target: &'a mut [T],
}

impl<T: Element> Vectorized for PixelRow<'_, T> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let PixelRow { channels, silu, repeat, pixel, .. } = self;
        for (index, targets) in self.target.chunks_exact_mut(pixel * repeat).enumerate() {
            let source = self.source.part(index * channels, channels);
            let (first, copies) = targets.split_at_mut(pixel);
            match self.affine {
                ImageAffine::None => write(simd, source, silu, first, |_, value| value),
                ImageAffine::Channels { factors, summands } => {
                    write(simd, source, silu, first, |channel, value| {
                        let factor = load(simd, factors, channel);
                        simd.mul_add(value, factor, load(simd, summands, channel))
                    });
                }
                ImageAffine::Pixels { epsilon, scale, shift } => {
                    let (mean, inverse) = pixel_moments(simd, source, epsilon);
                    let (mean, inverse) = (simd.splat(mean), simd.splat(inverse));
                    write(simd, source, silu, first, |channel, value| {
                        let normal = simd.mul(simd.sub(value, mean), inverse);
                        simd.mul_add(normal, load(simd, scale, channel), load(simd, shift, channel))
                    });
                }
            }
            copies.copy_from_slice(&first[..copies.len()]);
        }
    }
}

/// Writes one pixel, and zero where its channels do not fill a unit.
#[inline(always)]
fn write<S: Simd, T: Element>(
    simd: S,
    source: Values<'_>,
    silu: bool,
    target: &mut [T],
    transform: impl Fn(usize, S::Floats) -> S::Floats,
) {
    let (channels, beyond) = target.split_at_mut(source.len());
    for channel in (0..channels.len()).step_by(LANES) {
        let value = transform(channel, load_values(simd, source, channel));
        let value = if silu { sigmoid_linear(simd, value, 1.0) } else { value };
        store(simd, value, channels, channel);
    }
    beyond.fill(T::default());
}

#[cfg(test)]
mod tests {
    use super::Layout;

    #[test]
    fn offsets_of_32_bits_end_somewhere() {
        let layout = Layout { height: 1 << 10, width: 1 << 10, units: 1 << 10 };
        assert!(layout.is_addressable(3));
        assert!(!layout.is_addressable(4));
        assert!(!layout.is_addressable(1 << 34));
    }
}
