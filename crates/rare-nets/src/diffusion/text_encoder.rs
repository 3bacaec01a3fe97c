//! The text encoder of CLIP ViT-L/14 (Radford et al., 2021), which tells the networks what the prompt says.
//!
//! A transformer in which every token sees those before it. The padding of a prompt is not masked, and the result is
//! that after the last normalisation, because Stable Diffusion was trained so.

use rare::{Error, Result};

use super::TextConfig;
use super::layers::{LayerNormalization, Loader};
use super::layout::text_encoder_layout;
use crate::checkpoint::Parameters;
use crate::engine::{Activation, Backend, Convolution, Shape};

/// The text encoder on a backend.
pub struct TextEncoder<B: Backend> {
    config: TextConfig,
    /// Vocabulary x width.
    token_embedding: Vec<f32>,
    /// Positions x width.
    position_embedding: Vec<f32>,
    layers: Vec<Layer<B>>,
    final_norm: LayerNormalization,
}

/// One layer of the transformer.
struct Layer<B: Backend> {
    heads: usize,
    norm1: LayerNormalization,
    queries_keys_values: B::Weight,
    attention_out: B::Weight,
    norm2: LayerNormalization,
    feed_forward_in: B::Weight,
    feed_forward_out: B::Weight,
}

impl<B: Backend> TextEncoder<B> {
    /// Reads and packs the weights.
    ///
    /// # Errors
    /// `InvalidInput` if the heads do not divide the width, or if tensors are missing, unknown, of another shape or not
    /// finite; `Io` if a file cannot be read.
    pub fn load(
        backend: &B,
        config: &TextConfig,
        parameters: &Parameters,
    ) -> Result<TextEncoder<B>> {
        let TextConfig { hidden_size: width, heads, .. } = *config;
        if width == 0 || heads == 0 || !width.is_multiple_of(heads) {
            return Err(Error::invalid(format!(
                "a text encoder cannot be {width} wide with {heads} heads: the configuration is damaged"
            )));
        }
        let layout = text_encoder_layout(config);
        let loader = Loader::new(backend, &layout, parameters, "text encoder")?;
        let layers = (0..config.layers).map(|index| Layer::load(&loader, index, config));
        Ok(TextEncoder {
            config: config.clone(),
            token_embedding: loader.values("text_model.embeddings.token_embedding.weight")?,
            position_embedding: loader.values("text_model.embeddings.position_embedding.weight")?,
            layers: layers.collect::<Result<Vec<Layer<B>>>>()?,
            final_norm: loader
                .layer_normalization("text_model.final_layer_norm", config.epsilon)?,
        })
    }

    /// Encodes a prompt of as many tokens as the encoder has positions (77): positions x width.
    ///
    /// # Errors
    /// `Internal` if there are more or fewer tokens, or one that is not in the vocabulary; what the backend has.
    pub fn encode(&self, backend: &B, tokens: &[u32]) -> Result<Vec<f32>> {
        let mut states = self.embed(backend, tokens)?;
        for layer in &self.layers {
            states = layer.attend(backend, &states)?;
            states = layer.feed_forward(backend, &states)?;
        }
        let mut values = backend.download(&states)?;
        self.final_norm.apply(&mut values);
        Ok(values)
    }

    /// The embedding of each token plus that of its position.
    fn embed(&self, backend: &B, tokens: &[u32]) -> Result<B::Tensor> {
        let TextConfig { hidden_size: width, positions, .. } = self.config;
        if tokens.len() != positions {
            return Err(Error::Internal(format!(
                "a prompt of {} tokens for an encoder of {positions} positions",
                tokens.len()
            )));
        }
        let mut values = self.position_embedding.clone();
        for (state, &token) in values.chunks_exact_mut(width).zip(tokens) {
            for (value, embedded) in state.iter_mut().zip(self.token(token)?) {
                *value += embedded;
            }
        }
        backend.upload(Shape { batch: 1, height: 1, width: positions, channels: width }, &values)
    }

    /// The embedding of a token.
    fn token(&self, token: u32) -> Result<&[f32]> {
        let mut rows = self.token_embedding.chunks_exact(self.config.hidden_size);
        rows.nth(token as usize).ok_or_else(|| {
            Error::Internal(format!("token {token} in a vocabulary of {}", self.config.vocabulary))
        })
    }
}

impl<B: Backend> Layer<B> {
    fn load(loader: &Loader<'_, B>, index: usize, config: &TextConfig) -> Result<Layer<B>> {
        let name = format!("text_model.encoder.layers.{index}");
        let norm =
            |part: &str| loader.layer_normalization(&format!("{name}.{part}"), config.epsilon);
        let kernel = |part: &str| loader.kernel(&format!("{name}.{part}"));
        Ok(Layer {
            heads: config.heads,
            norm1: norm("layer_norm1")?,
            queries_keys_values: loader
                .joint_kernel(&format!("{name}.self_attn"), &["q_proj", "k_proj", "v_proj"])?,
            attention_out: kernel("self_attn.out_proj")?,
            norm2: norm("layer_norm2")?,
            feed_forward_in: kernel("mlp.fc1")?,
            feed_forward_out: kernel("mlp.fc2")?,
        })
    }

    fn attend(&self, backend: &B, states: &B::Tensor) -> Result<B::Tensor> {
        let fused = Convolution {
            prologue: self.norm1.prologue(),
            intermediate: true,
            ..Convolution::default()
        };
        let projected = backend.convolve(states, &self.queries_keys_values, &fused)?;
        let attended = backend.self_attention(&projected, self.heads, true)?;
        let fused = Convolution { residual: Some(states), ..Convolution::default() };
        backend.convolve(&attended, &self.attention_out, &fused)
    }

    fn feed_forward(&self, backend: &B, states: &B::Tensor) -> Result<B::Tensor> {
        let fused = Convolution {
            prologue: self.norm2.prologue(),
            activation: Activation::QuickGelu,
            intermediate: true,
            ..Convolution::default()
        };
        let inner = backend.convolve(states, &self.feed_forward_in, &fused)?;
        let fused = Convolution { residual: Some(states), ..Convolution::default() };
        backend.convolve(&inner, &self.feed_forward_out, &fused)
    }
}
