//! The encoder of the depth image: eight convolutions, three of which halve the image.

use rare::Result;

use crate::diffusion::layers::Loader;
use crate::engine::{Activation, Backend, Convolution};

/// Number of convolutions between the first and the last.
const BLOCKS: usize = 6;

/// From depth images to what the `ControlNet` adds behind its first convolution.
pub(super) struct HintEmbedding<B: Backend> {
    conv_in: B::Weight,
    blocks: Vec<B::Weight>,
    conv_out: B::Weight,
}

impl<B: Backend> HintEmbedding<B> {
    pub(super) fn load(loader: &Loader<'_, B>) -> Result<HintEmbedding<B>> {
        let kernel = |part: &str| loader.kernel(&format!("controlnet_cond_embedding.{part}"));
        let blocks = (0..BLOCKS)
            .map(|index| kernel(&format!("blocks.{index}")))
            .collect::<Result<Vec<B::Weight>>>()?;
        Ok(HintEmbedding { conv_in: kernel("conv_in")?, blocks, conv_out: kernel("conv_out")? })
    }

    pub(super) fn run(&self, backend: &B, hint: &B::Tensor) -> Result<B::Tensor> {
        let mut last = backend.convolve(hint, &self.conv_in, &activated(1))?;
        for (index, kernel) in self.blocks.iter().enumerate() {
            // Every second one halves the image.
            last = backend.convolve(&last, kernel, &activated(1 + index % 2))?;
        }
        backend.convolve(&last, &self.conv_out, &Convolution::default())
    }
}

/// A convolution before another.
fn activated<'a, T>(stride: usize) -> Convolution<'a, T> {
    Convolution {
        stride,
        activation: Activation::Silu,
        intermediate: true,
        ..Convolution::default()
    }
}
