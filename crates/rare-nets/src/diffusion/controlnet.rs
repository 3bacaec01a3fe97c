//! The `ControlNet` (Zhang et al., 2023): says from a depth image what to add to the hidden states of the U-Net (paper
//! section "Stable Diffusion and ControlNet").
//!
//! It is the encoder half of the U-Net again, behind whose first convolution the embedding of the depth image is added.
//! Each of its thirteen hidden states goes through a 1 x 1 convolution, which is called the zero convolution after its
//! value before training, and is then added to the state of the U-Net in the same place. The convolution and the
//! addition are one operation, done when the U-Net asks for that state, or never.

mod hint_embedding;

use rare::{Error, Result};

use super::ControlNetConfig;
use super::layers::{Conditioning, Contexts, Loader, Timestep};
use super::layout::controlnet_layout;
use super::unet::{EncoderHalf, LAYERS, check_config, check_latents, upload_text};
use crate::checkpoint::Parameters;
use crate::engine::{Backend, Convolution, Shape};

use hint_embedding::HintEmbedding;

/// Pixels of the depth image along a side of a pixel of the latent image.
const HINT_SCALE: usize = 8;

/// The `ControlNet` on a backend.
pub struct ControlNet<B: Backend> {
    config: ControlNetConfig,
    hint_embedding: HintEmbedding<B>,
    encoder: EncoderHalf<B>,
    /// For the twelve hidden states of the way down, then for that of the middle.
    zero_convolutions: Vec<B::Weight>,
}

/// What the `ControlNet` says of some latent images, for one run of the U-Net.
pub struct Control<'a, B: Backend> {
    network: &'a ControlNet<B>,
    /// The hidden states that are not yet added, before their zero convolutions.
    states: Vec<B::Tensor>,
}

impl<B: Backend> ControlNet<B> {
    /// Reads and packs all weights.
    ///
    /// # Errors
    /// `InvalidInput` if the sizes of the configuration do not fit each other, or if tensors are missing, unknown, of
    /// another shape or not finite; `Io` if a file cannot be read.
    pub fn load(
        backend: &B,
        config: &ControlNetConfig,
        parameters: &Parameters,
    ) -> Result<ControlNet<B>> {
        check_config(&config.unet)?;
        let layout = controlnet_layout(config);
        let loader = Loader::new(backend, &layout, parameters, "ControlNet")?;
        let mut zero_convolutions = (0..LAYERS - 1)
            .map(|index| loader.kernel(&format!("controlnet_down_blocks.{index}")))
            .collect::<Result<Vec<B::Weight>>>()?;
        zero_convolutions.push(loader.kernel("controlnet_mid_block")?);
        Ok(ControlNet {
            config: config.clone(),
            hint_embedding: HintEmbedding::load(&loader)?,
            encoder: EncoderHalf::load(&loader, &config.unet)?,
            zero_convolutions,
        })
    }

    /// Encodes depth images (3 equal channels in 0 to 1; 8 times as high and wide as the latent images), once for all
    /// runs on them.
    ///
    /// # Errors
    /// `Internal` if the shape does not fit; what the backend has.
    pub fn embed_hint(&self, backend: &B, hint: &B::Tensor) -> Result<B::Tensor> {
        let shape = backend.shape(hint);
        let Shape { height, width, channels, .. } = shape;
        let divisible = height.is_multiple_of(HINT_SCALE) && width.is_multiple_of(HINT_SCALE);
        if shape.values() == 0 || !divisible || channels != self.config.hint_channels {
            return Err(Error::Internal(format!(
                "depth images {shape:?}: height and width must be multiples of {HINT_SCALE}, and {} the number of channels",
                self.config.hint_channels
            )));
        }
        self.hint_embedding.run(backend, hint)
    }

    /// Prepares a prompt: `text` is what the text encoder says of it, tokens x width.
    ///
    /// # Errors
    /// `Internal` if the number of values is not a multiple of the width; what the backend has.
    pub fn contexts(&self, backend: &B, text: &[f32]) -> Result<Contexts<B::Tensor>> {
        let text = upload_text(backend, text, self.config.unet.cross_attention_dim)?;
        Ok(Contexts { keys_values: self.encoder.contexts(backend, &text)? })
    }

    /// Prepares a time of diffusion, in training steps (0 to 999, any number in between).
    ///
    /// # Errors
    /// What the backend has.
    pub fn timestep(&self, backend: &B, time: f32) -> Result<Timestep<B::Tensor>> {
        let embedding = self.encoder.embed_time(backend, time)?;
        Ok(Timestep { offsets: self.encoder.offsets(backend, &embedding)? })
    }

    /// Runs the network on latent images (see [`super::Unet::run`]). `hint` is the embedding of as many depth images, or
    /// of fewer: then latent image `i` belongs to depth image `i mod` their number.
    ///
    /// # Errors
    /// `Internal` if time or prompts come from another network or shapes do not fit; what the backend has.
    pub fn run(
        &self,
        backend: &B,
        latents: &B::Tensor,
        hint: &B::Tensor,
        timestep: &Timestep<B::Tensor>,
        contexts: &[&Contexts<B::Tensor>],
    ) -> Result<Control<'_, B>> {
        check_latents(backend.shape(latents), &self.config.unet)?;
        let mut conditioning = Conditioning::new(timestep, contexts);
        let states = self.encoder.run(backend, latents, Some(hint), &mut conditioning)?;
        Ok(Control { network: self, states })
    }
}

impl<B: Backend> Control<'_, B> {
    /// What is added to each hidden state of the U-Net: the twelve of the way down, then that of the middle.
    ///
    /// # Errors
    /// What the backend has.
    pub fn residuals(mut self, backend: &B) -> Result<Vec<B::Tensor>> {
        let mut residuals = Vec::new();
        while !self.states.is_empty() {
            residuals.push(self.last(backend, None)?);
        }
        residuals.reverse();
        Ok(residuals)
    }

    /// The last hidden state of the U-Net that was not yet asked for, with its residual added.
    pub(crate) fn add_last(&mut self, backend: &B, state: &B::Tensor) -> Result<B::Tensor> {
        self.last(backend, Some(state))
    }

    fn last(&mut self, backend: &B, onto: Option<&B::Tensor>) -> Result<B::Tensor> {
        let state = self.states.pop();
        let kernel = self.network.zero_convolutions.get(self.states.len());
        let (Some(state), Some(kernel)) = (state, kernel) else {
            return Err(Error::Internal("the ControlNet gave too few states".to_owned()));
        };
        backend.convolve(&state, kernel, &Convolution { residual: onto, ..Convolution::default() })
    }
}
