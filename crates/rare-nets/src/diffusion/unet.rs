//! The U-Net of Stable Diffusion 1.x (Ronneberger et al., 2015; Rombach et al., 2022): predicts the noise in a latent
//! image, and on the way computes the features that the paper uses (section "Depth Diffusion Feature Extraction").
//!
//! The encoder half hands thirteen hidden states over: twelve to the blocks of the decoder half, from the last to the
//! first, and one through the middle. What a `ControlNet` says is added to them there. Features come from the decoder
//! half, so a run stops after the last layer asked for, and what lies behind the last layer that will ever be asked for
//! need not be loaded.

mod decoder_block;
mod encoder_half;
mod sizes;

use rare::{Error, Result};

use super::layers::{Conditioning, Contexts, GroupNormalization, Loader, Timestep};
use super::layout::{BLOCKS_PER_LEVEL, unet_layout};
use super::{Control, UnetConfig};
use crate::checkpoint::Parameters;
use crate::engine::{Backend, Convolution, Shape};

use decoder_block::DecoderBlock;
pub(crate) use encoder_half::EncoderHalf;
pub(crate) use sizes::{check_config, check_latents};

/// Number of layers that give features: the middle and the twelve blocks of the decoder half.
pub const LAYERS: usize = 13;

/// Added to the variance in the last normalisation.
const EPSILON: f32 = 1e-5;

/// How much of the U-Net is loaded or run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Extent {
    /// The layers 0 to this one, at most 12. Layer 0 is the middle block, layer `i + 1` block `i` of the decoder half,
    /// with its upsampling where it has one (the numbering of `FreeReg`).
    UpToLayer(usize),
    /// Everything.
    Whole,
}

/// What a run of the U-Net gives.
pub struct Output<T> {
    /// The layers up to the one asked for, in order; empty for [`Extent::Whole`], which keeps none in memory.
    pub layers: Vec<T>,
    /// The predicted noise, of the shape of the latent images; only for [`Extent::Whole`].
    pub noise: Option<T>,
}

/// The U-Net, or its first layers, on a backend.
pub struct Unet<B: Backend> {
    config: UnetConfig,
    extent: Extent,
    encoder: EncoderHalf<B>,
    decoder: Vec<DecoderBlock<B>>,
    head: Option<Head<B>>,
}

/// Turns the last layer into noise.
struct Head<B: Backend> {
    norm: GroupNormalization,
    convolution: B::Weight,
}

impl Extent {
    /// The number of blocks of the decoder half.
    fn blocks(self) -> Result<usize> {
        match self {
            Extent::Whole => Ok(LAYERS - 1),
            Extent::UpToLayer(layer) if layer < LAYERS => Ok(layer),
            Extent::UpToLayer(layer) => Err(Error::invalid(format!(
                "there is no layer {layer} in the U-Net: its layers are 0 to {}",
                LAYERS - 1
            ))),
        }
    }

    /// Whether a network of this extent can be run to the other one.
    fn covers(self, other: Extent) -> bool {
        match (self, other) {
            (Extent::Whole, _) => true,
            (Extent::UpToLayer(loaded), Extent::UpToLayer(asked)) => asked <= loaded,
            (Extent::UpToLayer(_), Extent::Whole) => false,
        }
    }
}

impl<B: Backend> Unet<B> {
    /// Reads and packs the weights that runs up to `extent` need, and no others.
    ///
    /// # Errors
    /// `InvalidInput` if there is no such layer, if the sizes of the configuration do not fit each other, or if tensors
    /// are missing, unknown, of another shape or not finite; `Io` if a file cannot be read.
    pub fn load(
        backend: &B,
        config: &UnetConfig,
        parameters: &Parameters,
        extent: Extent,
    ) -> Result<Unet<B>> {
        let blocks = extent.blocks()?;
        check_config(config)?;
        let layout = unet_layout(config);
        let loader = Loader::new(backend, &layout, parameters, "U-Net")?;
        let encoder = EncoderHalf::load(&loader, config)?;
        let decoder = (0..blocks)
            .map(|block| (block / (BLOCKS_PER_LEVEL + 1), block % (BLOCKS_PER_LEVEL + 1)))
            .map(|(level, index)| DecoderBlock::load(&loader, level, index, config))
            .collect::<Result<Vec<DecoderBlock<B>>>>()?;
        let head = match extent {
            Extent::Whole => Some(Head::load(&loader, config)?),
            Extent::UpToLayer(_) => None,
        };
        Ok(Unet { config: config.clone(), extent, encoder, decoder, head })
    }

    /// Prepares a prompt: `text` is what the text encoder says of it, tokens x width.
    ///
    /// # Errors
    /// `Internal` if the number of values is not a multiple of the width; what the backend has.
    pub fn contexts(&self, backend: &B, text: &[f32]) -> Result<Contexts<B::Tensor>> {
        let text = upload_text(backend, text, self.config.cross_attention_dim)?;
        let mut keys_values = self.encoder.contexts(backend, &text)?;
        for block in &self.decoder {
            keys_values.extend(block.context(backend, &text)?);
        }
        Ok(Contexts { keys_values })
    }

    /// Prepares a time of diffusion, in training steps (0 to 999, any number in between).
    ///
    /// # Errors
    /// What the backend has.
    pub fn timestep(&self, backend: &B, time: f32) -> Result<Timestep<B::Tensor>> {
        let embedding = self.encoder.embed_time(backend, time)?;
        let mut offsets = self.encoder.offsets(backend, &embedding)?;
        for block in &self.decoder {
            offsets.push(block.offset(backend, &embedding)?);
        }
        Ok(Timestep { offsets })
    }

    /// Runs the network on latent images (4 channels; height and width multiples of 8), all at one time. Each of the
    /// prompts serves an equal share of the images, in order. `control` is what a `ControlNet` says of the same images.
    ///
    /// # Errors
    /// `Internal` if the network was not loaded that far, if time or prompts come from another network, or if shapes do
    /// not fit; what the backend has.
    pub fn run(
        &self,
        backend: &B,
        latents: &B::Tensor,
        timestep: &Timestep<B::Tensor>,
        contexts: &[&Contexts<B::Tensor>],
        mut control: Option<Control<'_, B>>,
        extent: Extent,
    ) -> Result<Output<B::Tensor>> {
        self.check(backend.shape(latents), extent)?;
        let mut conditioning = Conditioning::new(timestep, contexts);
        let mut states = self.encoder.run(backend, latents, None, &mut conditioning)?;
        let mut layer = take_last(backend, &mut states, &mut control)?;
        let mut layers = Vec::new();
        for block in self.decoder.iter().take(extent.blocks()?) {
            let state = take_last(backend, &mut states, &mut control)?;
            let next = block.run(backend, &layer, &state, &mut conditioning)?;
            let finished = std::mem::replace(&mut layer, next);
            if extent != Extent::Whole {
                layers.push(finished);
            }
        }
        self.finish(backend, layers, layer, extent)
    }

    /// Adds the last layer to the others, or turns it into noise.
    fn finish(
        &self,
        backend: &B,
        mut layers: Vec<B::Tensor>,
        last: B::Tensor,
        extent: Extent,
    ) -> Result<Output<B::Tensor>> {
        if let (Extent::Whole, Some(head)) = (extent, &self.head) {
            return Ok(Output { layers, noise: Some(head.run(backend, &last)?) });
        }
        layers.push(last);
        Ok(Output { layers, noise: None })
    }

    fn check(&self, latents: Shape, extent: Extent) -> Result<()> {
        if !self.extent.covers(extent) {
            return Err(Error::Internal(format!(
                "a U-Net of which {:?} is loaded cannot be run {extent:?}",
                self.extent
            )));
        }
        check_latents(latents, &self.config)
    }
}

impl<B: Backend> Head<B> {
    fn load(loader: &Loader<'_, B>, config: &UnetConfig) -> Result<Head<B>> {
        let norm = loader.group_normalization("conv_norm_out", config.groups, EPSILON)?;
        Ok(Head { norm, convolution: loader.kernel("conv_out")? })
    }

    fn run(&self, backend: &B, layer: &B::Tensor) -> Result<B::Tensor> {
        let fused = Convolution { prologue: self.norm.then_silu(), ..Convolution::default() };
        backend.convolve(layer, &self.convolution, &fused)
    }
}

/// Puts the text of one prompt, tokens x width, on the backend.
pub(crate) fn upload_text<B: Backend>(
    backend: &B,
    text: &[f32],
    width: usize,
) -> Result<B::Tensor> {
    let shape = Shape { batch: 1, height: 1, width: text.len() / width.max(1), channels: width };
    backend.upload(shape, text)
}

/// Takes the last of the hidden states, with what the `ControlNet` says of it.
fn take_last<B: Backend>(
    backend: &B,
    states: &mut Vec<B::Tensor>,
    control: &mut Option<Control<'_, B>>,
) -> Result<B::Tensor> {
    let state = states
        .pop()
        .ok_or_else(|| Error::Internal("the encoder half gave too few states".to_owned()))?;
    match control {
        Some(control) => control.add_last(backend, &state),
        None => Ok(state),
    }
}
