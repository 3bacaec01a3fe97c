//! Everything that follows the product of a convolution, done while the result is still in the cache.

use rare::{Error, Result};

use super::backend::{Activation, Arrangement, Convolution, Shape};
use super::math::{gelu, sigmoid_linear};
use super::pack::{PANEL, PackedWeight};
use super::shared_output::SharedOutput;
use super::simd::{LANES, Simd};
use super::tensor::Tensor;
use super::vectors::{Element, load, store};

/// Everything after the product.
pub(super) struct Epilogue<'a> {
    /// Bias and offset of every column of all panels.
    summands: Vec<f32>,
    activation: Activation,
    arrangement: Arrangement,
    residual: Option<&'a [f32]>,
    channels: usize,
}

impl<'a> Epilogue<'a> {
    pub(super) fn new(
        weight: &PackedWeight,
        fused: &Convolution<'a, Tensor>,
        shape: Shape,
    ) -> Result<Epilogue<'a>> {
        let mut summands = weight.bias.clone();
        if let Some(offset) = fused.offset {
            let one = Shape { batch: 1, height: 1, width: 1, ..shape };
            let fits = offset.shape == one && weight.arrangement == Arrangement::Plain;
            let values = offset.as_f32().filter(|_| fits);
            let values = values.ok_or_else(|| unfit("an offset", shape))?;
            summands.iter_mut().zip(values).for_each(|(sum, value)| *sum += value);
        }
        let residual = match fused.residual {
            Some(residual) => Some(check_residual(residual, shape)?),
            None => None,
        };
        Ok(Epilogue {
            summands,
            activation: fused.activation,
            arrangement: weight.arrangement,
            residual,
            channels: shape.channels,
        })
    }

    /// Finishes one row of a panel.
    #[inline(always)]
    pub(super) fn apply<S: Simd, T: Element>(
        &self,
        simd: S,
        pixel: usize,
        panel: usize,
        sums: &[f32],
        output: &SharedOutput<'_, T>,
    ) {
        let summands = &self.summands[panel * PANEL..];
        let total = |group: usize| {
            simd.add(load(simd, sums, group * LANES), load(simd, summands, group * LANES))
        };
        match self.arrangement {
            Arrangement::Plain => {
                for group in 0..PANEL / LANES {
                    let channel = panel * PANEL + group * LANES;
                    self.finish(simd, pixel, channel, total(group), output);
                }
            }
            Arrangement::Gated => {
                let gated = simd.mul(total(0), gelu(simd, total(1)));
                self.finish(simd, pixel, panel * LANES, gated, output);
            }
        }
    }

    /// Activates a vector of channels, adds the residual and writes it.
    #[inline(always)]
    fn finish<S: Simd, T: Element>(
        &self,
        simd: S,
        pixel: usize,
        channel: usize,
        value: S::Floats,
        output: &SharedOutput<'_, T>,
    ) {
        let count = LANES.min(self.channels.saturating_sub(channel));
        let mut value = match self.activation {
            Activation::None => value,
            Activation::Silu => sigmoid_linear(simd, value, 1.0),
            Activation::QuickGelu => sigmoid_linear(simd, value, 1.702),
        };
        let start = pixel * self.channels + channel;
        if let Some(residual) = self.residual {
            let start = start % residual.len();
            let end = residual.len().min(start + count);
            value = simd.add(value, load(simd, &residual[start..end], 0));
        }
        // SAFETY: the channels of a panel are written by the one chunk that has this pixel.
        #[allow(unsafe_code)]
        let target = unsafe { output.part(start, count) };
        store(simd, value, target, 0);
    }
}

/// The residual's values, if it has the shape of the result or a divisor of its images.
fn check_residual(residual: &Tensor, shape: Shape) -> Result<&[f32]> {
    let one = |shape: Shape| (shape.height, shape.width, shape.channels);
    let images = residual.shape.batch;
    let fits =
        one(residual.shape) == one(shape) && images > 0 && shape.batch.is_multiple_of(images);
    residual.as_f32().filter(|_| fits).ok_or_else(|| unfit("a residual", shape))
}

fn unfit(what: &str, shape: Shape) -> Error {
    Error::Internal(format!("{what} does not fit the result {shape:?} of a convolution"))
}
