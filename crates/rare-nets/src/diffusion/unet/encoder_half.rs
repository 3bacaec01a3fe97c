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
    steps: Vec<Step<B>>,
    middle: [Block<B>; 2],
}

/// What makes one hidden state of the one before.
enum Step<B: Backend> {
    Block(Block<B>),
    /// Halves the image.
    Downsampling(B::Weight),
}

impl<B: Backend> EncoderHalf<B> {
    pub(crate) fn load(loader: &Loader<'_, B>, config: &UnetConfig) -> Result<EncoderHalf<B>> {
        let time_embedding = TimeEmbedding::load(loader, config.block_out_channels[0])?;
        let conv_in = loader.kernel("conv_in")?;
        let mut steps = Vec::new();
        for level in (0..config.block_out_channels.len()).map(|level| format!("down_blocks.{level}")) {
            for index in 0..BLOCKS_PER_LEVEL {
                steps.push(Step::Block(Block::load(loader, &level, index, config)?));
            }
            let downsampler = format!("{level}.downsamplers.0.conv");
            if loader.has(&downsampler) {
                steps.push(Step::Downsampling(loader.kernel(&downsampler)?));
            }
        }
        let middle = |index| Block::load(loader, "mid_block", index, config);
        Ok(EncoderHalf { time_embedding, conv_in, steps, middle: [middle(0)?, middle(1)?] })
    }

    /// All blocks in the order of computation.
    fn blocks(&self) -> impl Iterator<Item = &Block<B>> {
        let way_down = self.steps.iter().filter_map(|step| match step {
            Step::Block(block) => Some(block),
            Step::Downsampling(_) => None,
        });
        way_down.chain(&self.middle)
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
        for step in &self.steps {
            let next = step.run(backend, &last, conditioning)?;
            states.push(std::mem::replace(&mut last, next));
        }
        let [first, second] = &self.middle;
        let middle = first.run(backend, &last, conditioning)?;
        let middle = second.run(backend, &middle, conditioning)?;
        states.push(last);
        states.push(middle);
        Ok(states)
    }
}

impl<B: Backend> Step<B> {
    fn run(
        &self,
        backend: &B,
        input: &B::Tensor,
        conditioning: &mut Conditioning<'_, B::Tensor>,
    ) -> Result<B::Tensor> {
        match self {
            Step::Block(block) => block.run(backend, input, conditioning),
            Step::Downsampling(kernel) => {
                let fused = Convolution { stride: 2, ..Convolution::default() };
                backend.convolve(input, kernel, &fused)
            }
        }
    }
}
