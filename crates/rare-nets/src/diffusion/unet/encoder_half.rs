//! The way down and the middle of the U-Net, which the `ControlNet` has as well, with weights of its own.

use rare::Result;

use crate::diffusion::UnetConfig;
use crate::diffusion::layers::{Block, Conditioning, Loader, TimeEmbedding};
use crate::diffusion::layout::BLOCKS_PER_LEVEL;
use crate::engine::{Backend, Convolution};

/// First convolution, four levels, middle.
pub(crate) struct EncoderHalf<B: Backend> {
    time_embedding: TimeEmbedding<B>,
    conv_in: B::Weight,
    levels: Vec<Level<B>>,
    middle: [Block<B>; 2],
}

/// The blocks of one size of image; all levels but the coarsest then halve it.
struct Level<B: Backend> {
    blocks: Vec<Block<B>>,
    downsampling: Option<B::Weight>,
}

impl<B: Backend> EncoderHalf<B> {
    pub(crate) fn load(loader: &Loader<'_, B>, config: &UnetConfig) -> Result<EncoderHalf<B>> {
        let levels = 0..config.block_out_channels.len();
        let middle = |index| Block::load(loader, "mid_block", index, config);
        Ok(EncoderHalf {
            time_embedding: TimeEmbedding::load(loader, config.block_out_channels[0])?,
            conv_in: loader.kernel("conv_in")?,
            levels: levels
                .map(|level| Level::load(loader, level, config))
                .collect::<Result<_>>()?,
            middle: [middle(0)?, middle(1)?],
        })
    }

    /// All blocks in the order of computation.
    fn blocks(&self) -> impl Iterator<Item = &Block<B>> {
        self.levels.iter().flat_map(|level| &level.blocks).chain(&self.middle)
    }

    /// The embedding of a time of diffusion: one pixel.
    pub(crate) fn embed_time(&self, backend: &B, time: f32) -> Result<B::Tensor> {
        self.time_embedding.run(backend, time)
    }

    /// What each residual block adds at that time.
    pub(crate) fn offsets(
        &self,
        backend: &B,
        time_embedding: &B::Tensor,
    ) -> Result<Vec<B::Tensor>> {
        self.blocks().map(|block| block.offset(backend, time_embedding)).collect()
    }

    /// The keys and values of a prompt for each transformer.
    pub(crate) fn contexts(&self, backend: &B, text: &B::Tensor) -> Result<Vec<B::Tensor>> {
        self.blocks().filter_map(|block| block.context(backend, text).transpose()).collect()
    }

    /// The twelve hidden states of the way down, then that of the middle. `added` is added after the first convolution;
    /// of fewer images than there are latents, it repeats.
    pub(crate) fn run(
        &self,
        backend: &B,
        latents: &B::Tensor,
        added: Option<&B::Tensor>,
        conditioning: &mut Conditioning<'_, B::Tensor>,
    ) -> Result<Vec<B::Tensor>> {
        let fused = Convolution { residual: added, ..Convolution::default() };
        let mut last = backend.convolve(latents, &self.conv_in, &fused)?;
        let mut states = Vec::new();
        for level in &self.levels {
            for block in &level.blocks {
                let next = block.run(backend, &last, conditioning)?;
                states.push(std::mem::replace(&mut last, next));
            }
            if let Some(kernel) = &level.downsampling {
                let fused = Convolution { stride: 2, ..Convolution::default() };
                let next = backend.convolve(&last, kernel, &fused)?;
                states.push(std::mem::replace(&mut last, next));
            }
        }
        let middle = self.run_middle(backend, &last, conditioning)?;
        states.extend([last, middle]);
        Ok(states)
    }

    fn run_middle(
        &self,
        backend: &B,
        input: &B::Tensor,
        conditioning: &mut Conditioning<'_, B::Tensor>,
    ) -> Result<B::Tensor> {
        let [first, second] = &self.middle;
        let inner = first.run(backend, input, conditioning)?;
        second.run(backend, &inner, conditioning)
    }
}

impl<B: Backend> Level<B> {
    fn load(loader: &Loader<'_, B>, level: usize, config: &UnetConfig) -> Result<Level<B>> {
        let name = format!("down_blocks.{level}");
        let block = |index| Block::load(loader, &name, index, config);
        let downsampler = format!("{name}.downsamplers.0.conv");
        let halves = loader.has(&downsampler);
        Ok(Level {
            blocks: (0..BLOCKS_PER_LEVEL).map(block).collect::<Result<_>>()?,
            downsampling: if halves { Some(loader.kernel(&downsampler)?) } else { None },
        })
    }
}
