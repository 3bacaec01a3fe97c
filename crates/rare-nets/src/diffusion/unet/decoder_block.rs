//! One block of the decoder half.

use rare::Result;

use crate::diffusion::UnetConfig;
use crate::diffusion::layers::{Block, Conditioning, Loader};
use crate::engine::{Backend, Convolution};

/// Takes a hidden state of the encoder half beside its input; the last block of a level doubles the image.
pub(super) struct DecoderBlock<B: Backend> {
    block: Block<B>,
    upsampling: Option<B::Weight>,
}

impl<B: Backend> DecoderBlock<B> {
    pub(super) fn load(
        loader: &Loader<'_, B>,
        level: usize,
        index: usize,
        config: &UnetConfig,
    ) -> Result<DecoderBlock<B>> {
        let name = format!("up_blocks.{level}");
        let block = Block::load(loader, &name, index, config)?;
        let upsampler = format!("{name}.upsamplers.0.conv");
        let upsampled = index == super::BLOCKS_PER_LEVEL && loader.has(&upsampler);
        let upsampling = if upsampled { Some(loader.kernel(&upsampler)?) } else { None };
        Ok(DecoderBlock { block, upsampling })
    }

    pub(super) fn offset(&self, backend: &B, time_embedding: &B::Tensor) -> Result<B::Tensor> {
        self.block.offset(backend, time_embedding)
    }

    pub(super) fn context(&self, backend: &B, text: &B::Tensor) -> Result<Option<B::Tensor>> {
        self.block.context(backend, text)
    }

    pub(super) fn run(
        &self,
        backend: &B,
        input: &B::Tensor,
        state: &B::Tensor,
        conditioning: &mut Conditioning<'_, B::Tensor>,
    ) -> Result<B::Tensor> {
        let joined = backend.concatenate(input, state)?;
        let output = self.block.run(backend, &joined, conditioning)?;
        let Some(upsampling) = &self.upsampling else { return Ok(output) };
        let fused = Convolution { upsample: true, ..Convolution::default() };
        backend.convolve(&output, upsampling, &fused)
    }
}
