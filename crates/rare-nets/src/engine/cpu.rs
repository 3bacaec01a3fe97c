//! The backend on the CPU.

use std::sync::Arc;

use rare::{Error, Result};
use serde::{Deserialize, Serialize};

use super::arena::Arena;
use super::attention::{self, Keys};
use super::backend::{Backend, Convolution, Kernel, Shape};
use super::convolution::{self, Context};
use super::factored_attention::{self, AlignedRows, Columns, FactorRows, Head, ScoreFactors};
use super::pack::{self, PackedWeight};
use super::recurrent::GatedUpdate;
use super::simd::Processor;
use super::tensor::{Elements, Tensor, Values};
use crate::Matrix;

/// The precision of products. Sums are always in single precision.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Precision {
    /// Single precision.
    #[default]
    F32,
    /// Factors are rounded to bf16.
    Bf16,
}

impl Precision {
    /// Units of 32 bits that this many values fill.
    pub(super) fn units(self, values: usize) -> usize {
        match self {
            Precision::F32 => values,
            Precision::Bf16 => values.div_ceil(2),
        }
    }
}

/// Computes networks on the CPU, on the threads of rayon's current pool. Results do not depend on their number.
///
/// ```
/// use rare_nets::engine::{Backend, CpuBackend, Precision, Shape};
/// let cpu = CpuBackend::new(Precision::F32)?;
/// let shape = Shape { batch: 1, height: 1, width: 2, channels: 3 };
/// let tensor = cpu.upload(shape, &[1.0, 2.0, 3.0, 4.0, 5.0, 6.0])?;
/// assert_eq!(cpu.download(&tensor)?[4], 5.0);
/// # Ok::<(), rare::Error>(())
/// ```
#[derive(Debug)]
pub struct CpuBackend {
    processor: Processor,
    precision: Precision,
    arena: Arc<Arena>,
}

impl CpuBackend {
    /// With the best instructions of this machine, or those that the environment variable `RARE_CPU` forces.
    ///
    /// # Errors
    /// `Unsupported` if the variable names instructions that this machine does not have.
    pub fn new(precision: Precision) -> Result<CpuBackend> {
        Ok(CpuBackend::on(Processor::detect()?, precision))
    }

    /// With these instructions.
    #[must_use]
    pub fn on(processor: Processor, precision: Precision) -> CpuBackend {
        CpuBackend { processor, precision, arena: Arc::default() }
    }

    /// The instructions that are used.
    #[must_use]
    pub fn processor(&self) -> Processor {
        self.processor
    }

    /// Attention whose scores are multiplied by factors before the softmax:
    /// `softmax(factor * (query . key) / sqrt(channels)) value` for each query. Always in single precision.
    ///
    /// # Errors
    /// `Internal` if the sizes do not fit; there must be 16, 32, 64 or 128 channels.
    pub(crate) fn factored_attention(
        &self,
        head: &Head<'_>,
        factors: &impl ScoreFactors,
    ) -> Result<Matrix> {
        factored_attention::attend(self.processor, head, factors)
    }

    /// Copies so many columns for [`Head`] and [`CpuBackend::listed_products`].
    ///
    /// # Errors
    /// `Internal` if there are not so many or their number is no multiple of 16.
    pub(crate) fn aligned(&self, source: Columns<'_>, columns: usize) -> Result<AlignedRows> {
        AlignedRows::copy(&self.arena, source, columns)
    }

    /// The inner products of each query with the keys that are listed for it, one after the other; factors do not count.
    ///
    /// # Errors
    /// `Internal` if the sizes do not fit; rows must have 16, 32, 64 or 128 numbers.
    pub(crate) fn listed_products(
        &self,
        queries: Columns<'_>,
        keys: &AlignedRows,
        rows: &FactorRows,
    ) -> Result<Vec<f32>> {
        factored_attention::products(self.processor, queries, keys, rows)
    }

    /// One step of a gated recurrent unit (Cho et al., 2014) for each row of `states`, from `input = W_i u + b_i` and
    /// `hidden = W_h state + b_h`: three gates each, in the order reset, update, new.
    ///
    /// # Errors
    /// `Internal` if the sizes do not fit.
    pub(crate) fn gated_update(
        &self,
        input: &Matrix,
        hidden: &Matrix,
        states: &mut Matrix,
    ) -> Result<()> {
        let (rows, width) = (states.rows(), states.columns());
        let fits = |gates: &Matrix| gates.rows() == rows && gates.columns() == 3 * width;
        if width == 0 || !fits(input) || !fits(hidden) {
            return Err(Error::Internal(format!("no gates of {rows} states of {width} numbers")));
        }
        let (input, hidden, states) = (input.values(), hidden.values(), states.values_mut());
        self.processor.run(GatedUpdate { width, input, hidden, states });
        Ok(())
    }

    fn context(&self) -> Context<'_> {
        Context { processor: self.processor, precision: self.precision, arena: &self.arena }
    }
}

impl Backend for CpuBackend {
    type Tensor = Tensor;
    type Weight = PackedWeight;

    fn pack(&self, kernel: &Kernel<'_>) -> Result<PackedWeight> {
        pack::pack(self.processor, kernel, self.precision)
    }

    fn upload(&self, shape: Shape, values: &[f32]) -> Result<Tensor> {
        let sizes = [shape.batch, shape.height, shape.width, shape.channels];
        let count = sizes.into_iter().try_fold(1, usize::checked_mul);
        // No tensor is empty: so no operation needs to say what it does then.
        if values.is_empty() || count != Some(values.len()) {
            let count = values.len();
            return Err(Error::Internal(format!("{count} values make no tensor of {shape:?}")));
        }
        let mut buffer = self.arena.lend(values.len() * 4);
        buffer.slice_mut()[..values.len()].copy_from_slice(values);
        Ok(Tensor { shape, elements: Elements::F32, buffer })
    }

    fn download(&self, tensor: &Tensor) -> Result<Vec<f32>> {
        Ok(match tensor.values(0, tensor.shape.values()) {
            Values::F32(values) => values.to_vec(),
            Values::Bf16(values) => values.iter().map(|value| value.to_f32()).collect(),
        })
    }

    fn shape(&self, tensor: &Tensor) -> Shape {
        tensor.shape
    }

    fn convolve(
        &self,
        input: &Tensor,
        weight: &PackedWeight,
        fused: &Convolution<'_, Tensor>,
    ) -> Result<Tensor> {
        convolution::convolve(self.context(), input, weight, fused)
    }

    fn self_attention(&self, input: &Tensor, heads: usize, causal: bool) -> Result<Tensor> {
        let channels = input.shape.channels / 3;
        let keys = [Keys { tensor: input, first_key: channels, first_value: 2 * channels }];
        attention::attend(self.context(), input, &keys, channels, heads, causal)
    }

    fn cross_attention(
        &self,
        queries: &Tensor,
        contexts: &[&Tensor],
        heads: usize,
    ) -> Result<Tensor> {
        let channels = queries.shape.channels;
        if let Some(context) = contexts.iter().find(|context| context.shape.batch != 1) {
            return Err(Error::Internal(format!("{:?} is no context of one image", context.shape)));
        }
        let keys: Vec<Keys<'_>> = contexts
            .iter()
            .map(|tensor| Keys { tensor, first_key: 0, first_value: channels })
            .collect();
        attention::attend(self.context(), queries, &keys, channels, heads, false)
    }

    fn concatenate(&self, first: &Tensor, second: &Tensor) -> Result<Tensor> {
        let pixels = |shape: Shape| (shape.batch, shape.height, shape.width);
        let (Some(left), Some(right), true) =
            (first.as_f32(), second.as_f32(), pixels(first.shape) == pixels(second.shape))
        else {
            let (first, second) = (first.shape, second.shape);
            return Err(Error::Internal(format!("{first:?} and {second:?} cannot be joined")));
        };
        let (a, b) = (first.shape.channels, second.shape.channels);
        let shape = Shape { channels: a + b, ..first.shape };
        let mut buffer = self.arena.lend(shape.values() * 4);
        let pixels = buffer.slice_mut::<f32>().chunks_exact_mut(a + b);
        for ((pixel, left), right) in pixels.zip(left.chunks_exact(a)).zip(right.chunks_exact(b)) {
            pixel[..a].copy_from_slice(left);
            pixel[a..].copy_from_slice(right);
        }
        Ok(Tensor { shape, elements: Elements::F32, buffer })
    }
}
