//! The residual block (He et al., 2016), as diffusion networks have it (Ho, Jain, Abbeel, 2020).

use rare::Result;

use super::{GroupNormalization, Loader};
use crate::engine::{Backend, Convolution, Prologue};

/// Added to the variance in normalisations.
const EPSILON: f32 = 1e-5;

/// Two normalised 3 x 3 convolutions around the time embedding, beside the input or a 1 x 1 convolution of it.
pub(crate) struct Resnet<B: Backend> {
    norm1: GroupNormalization,
    conv1: B::Weight,
    time_projection: B::Weight,
    norm2: GroupNormalization,
    conv2: B::Weight,
    /// Where the number of channels changes.
    shortcut: Option<B::Weight>,
}

impl<B: Backend> Resnet<B> {
    pub(crate) fn load(loader: &Loader<'_, B>, name: &str, groups: usize) -> Result<Resnet<B>> {
        let norm =
            |part: &str| loader.group_normalization(&format!("{name}.{part}"), groups, EPSILON);
        let kernel = |part: &str| loader.kernel(&format!("{name}.{part}"));
        let has_shortcut = loader.has(&format!("{name}.conv_shortcut"));
        Ok(Resnet {
            norm1: norm("norm1")?,
            conv1: kernel("conv1")?,
            time_projection: kernel("time_emb_proj")?,
            norm2: norm("norm2")?,
            conv2: kernel("conv2")?,
            shortcut: if has_shortcut { Some(kernel("conv_shortcut")?) } else { None },
        })
    }

    /// What the block adds to its channels at a time: one pixel.
    pub(crate) fn offset(&self, backend: &B, time_embedding: &B::Tensor) -> Result<B::Tensor> {
        let fused = Convolution { prologue: Prologue::Silu, ..Convolution::default() };
        backend.convolve(time_embedding, &self.time_projection, &fused)
    }

    pub(crate) fn run(
        &self,
        backend: &B,
        input: &B::Tensor,
        offset: &B::Tensor,
    ) -> Result<B::Tensor> {
        let first = Convolution {
            prologue: self.norm1.then_silu(),
            offset: Some(offset),
            ..Convolution::default()
        };
        let inner = backend.convolve(input, &self.conv1, &first)?;
        let projected = self.project(backend, input)?;
        let second = Convolution {
            prologue: self.norm2.then_silu(),
            residual: Some(projected.as_ref().unwrap_or(input)),
            ..Convolution::default()
        };
        backend.convolve(&inner, &self.conv2, &second)
    }

    /// The input with the channels of the result, if it does not have them.
    fn project(&self, backend: &B, input: &B::Tensor) -> Result<Option<B::Tensor>> {
        let Some(shortcut) = &self.shortcut else { return Ok(None) };
        backend.convolve(input, shortcut, &Convolution::default()).map(Some)
    }
}
