//! A residual block and the transformer after it.

use rare::Result;

use super::resnet::Resnet;
use super::transformer::Transformer;
use super::{Conditioning, Loader};
use crate::diffusion::UnetConfig;
use crate::engine::Backend;

/// The unit of which every level is made.
pub(crate) struct Block<B: Backend> {
    resnet: Resnet<B>,
    /// On all levels but the coarsest.
    transformer: Option<Transformer<B>>,
}

impl<B: Backend> Block<B> {
    /// Loads number `index` of `level`.
    pub(crate) fn load(
        loader: &Loader<'_, B>,
        level: &str,
        index: usize,
        config: &UnetConfig,
    ) -> Result<Block<B>> {
        let resnet = Resnet::load(loader, &format!("{level}.resnets.{index}"), config.groups)?;
        let name = format!("{level}.attentions.{index}");
        let transformer = if loader.has(&format!("{name}.norm")) {
            Some(Transformer::load(loader, &name, config)?)
        } else {
            None
        };
        Ok(Block { resnet, transformer })
    }

    /// See [`Resnet::offset`].
    pub(crate) fn offset(&self, backend: &B, time_embedding: &B::Tensor) -> Result<B::Tensor> {
        self.resnet.offset(backend, time_embedding)
    }

    /// See [`Transformer::context`]; nothing without a transformer.
    pub(crate) fn context(&self, backend: &B, text: &B::Tensor) -> Result<Option<B::Tensor>> {
        let Some(transformer) = &self.transformer else { return Ok(None) };
        transformer.context(backend, text).map(Some)
    }

    pub(crate) fn run(
        &self,
        backend: &B,
        input: &B::Tensor,
        conditioning: &mut Conditioning<'_, B::Tensor>,
    ) -> Result<B::Tensor> {
        let output = self.resnet.run(backend, input, conditioning.next_offset()?)?;
        let Some(transformer) = &self.transformer else { return Ok(output) };
        transformer.run(backend, &output, &conditioning.next_contexts()?)
    }
}
