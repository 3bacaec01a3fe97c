//! Features of the coarsest points, brought to the finest ones.

use rare::Result;

use crate::Matrix;
use crate::backbones::kpconv::{NormalizationKind, Pyramid, Unary, upsample};
use crate::checkpoint::Layout;
use crate::engine::CpuBackend;
use crate::layers::{Activation, Linear, Weights};

/// The sizes of a decoder.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::backbones) struct DecoderSizes {
    /// Channels at the coarsest stage.
    pub(in crate::backbones) inputs: usize,
    /// Channels that the encoder gives for the finest stage; each coarser one has twice as many.
    pub(in crate::backbones) width: usize,
    /// Number of stages.
    pub(in crate::backbones) stages: usize,
    /// Channels at the finest stage.
    pub(in crate::backbones) outputs: usize,
}

impl DecoderSizes {
    /// Inputs and outputs of the layer at each stage but the coarsest, in the order in which they follow each other.
    fn layers(&self) -> Vec<[usize; 2]> {
        let mut channels = self.inputs;
        let layer = |level: usize| {
            let inputs = channels + (self.width << level);
            channels = if level == 0 { self.outputs } else { channels / 2 };
            [inputs, channels]
        };
        (0..self.stages.saturating_sub(1)).rev().map(layer).collect()
    }

    /// Adds the tensors of a decoder whose names begin with `prefix`.
    pub(in crate::backbones) fn add_to(&self, layout: &mut Layout, prefix: &str) {
        for (index, [inputs, outputs]) in self.layers().into_iter().enumerate() {
            layout.insert(format!("{}.mlp.weight", name(prefix, index)), vec![outputs, inputs]);
        }
    }
}

/// Every other block only brings features to the next stage, and has no tensors.
fn name(prefix: &str, index: usize) -> String {
    format!("{prefix}.{}", 2 * index + 1)
}

/// Layers for the features of each stage beside those that the encoder found there.
pub(in crate::backbones) struct Decoder {
    inner: Vec<Unary>,
    last: Linear,
}

impl Decoder {
    /// Reads the tensors whose names begin with `prefix`.
    ///
    /// # Errors
    /// Those of [`Weights::values`].
    pub(in crate::backbones) fn read(
        cpu: &CpuBackend,
        weights: &Weights<'_>,
        prefix: &str,
        sizes: &DecoderSizes,
    ) -> Result<Decoder> {
        let last = sizes.layers().len().saturating_sub(1);
        let (kind, activation) = (NormalizationKind::Instance, Activation::LeakyRelu);
        let inner = |index| Unary::load(cpu, weights, &name(prefix, index), kind, activation);
        Ok(Decoder {
            inner: (0..last).map(inner).collect::<Result<_>>()?,
            last: weights.linear(cpu, &format!("{}.mlp", name(prefix, last)))?,
        })
    }

    /// Features of the finest points from `coarsest` and those `skipped`, the finest first, which are used up.
    ///
    /// # Errors
    /// `Internal` if sizes do not fit.
    pub(in crate::backbones) fn apply(
        &self,
        cpu: &CpuBackend,
        pyramid: &Pyramid,
        skipped: Vec<Matrix>,
        coarsest: Matrix,
    ) -> Result<Matrix> {
        let mut features = coarsest;
        let stages = pyramid.stages.iter().zip(skipped).enumerate().rev();
        let mut inner = self.inner.iter();
        for (level, (stage, skipped)) in stages.take(self.inner.len() + 1) {
            let joined = upsample(stage, &features).beside(&skipped)?;
            features = match inner.next() {
                Some(unary) if level > 0 => unary.apply(cpu, &joined)?,
                _ => self.last.apply(cpu, &joined)?,
            };
        }
        Ok(features)
    }
}
