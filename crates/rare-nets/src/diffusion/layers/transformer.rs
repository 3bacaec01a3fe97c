//! The transformer between residual blocks (Vaswani et al., 2017; Rombach et al., 2022): the pixels attend to each other,
//! then to the tokens of the prompt, then go through a gated feed-forward layer.

use rare::Result;

use super::{GroupNormalization, LayerNormalization, Loader};
use crate::diffusion::UnetConfig;
use crate::engine::{Backend, Convolution};

/// Added to the variance in the group normalisation, unlike in residual blocks.
const GROUP_EPSILON: f32 = 1e-6;
/// Added to the variance in layer normalisations.
const LAYER_EPSILON: f32 = 1e-5;

/// One transformer layer between two 1 x 1 convolutions.
pub(crate) struct Transformer<B: Backend> {
    heads: usize,
    norm: GroupNormalization,
    projection_in: B::Weight,
    norm1: LayerNormalization,
    self_queries_keys_values: B::Weight,
    self_out: B::Weight,
    norm2: LayerNormalization,
    cross_queries: B::Weight,
    cross_keys_values: B::Weight,
    cross_out: B::Weight,
    norm3: LayerNormalization,
    feed_forward_in: B::Weight,
    feed_forward_out: B::Weight,
    projection_out: B::Weight,
}

impl<B: Backend> Transformer<B> {
    pub(crate) fn load(
        loader: &Loader<'_, B>,
        name: &str,
        config: &UnetConfig,
    ) -> Result<Transformer<B>> {
        let block = format!("{name}.transformer_blocks.0");
        let norm =
            |part: &str| loader.layer_normalization(&format!("{block}.{part}"), LAYER_EPSILON);
        let kernel = |part: &str| loader.kernel(&format!("{block}.{part}"));
        let group_norm = format!("{name}.norm");
        Ok(Transformer {
            heads: config.heads,
            norm: loader.group_normalization(&group_norm, config.groups, GROUP_EPSILON)?,
            projection_in: loader.kernel(&format!("{name}.proj_in"))?,
            norm1: norm("norm1")?,
            self_queries_keys_values: loader
                .joint_kernel(&format!("{block}.attn1"), &["to_q", "to_k", "to_v"])?,
            self_out: kernel("attn1.to_out.0")?,
            norm2: norm("norm2")?,
            cross_queries: kernel("attn2.to_q")?,
            cross_keys_values: loader.joint_kernel(&format!("{block}.attn2"), &["to_k", "to_v"])?,
            cross_out: kernel("attn2.to_out.0")?,
            norm3: norm("norm3")?,
            feed_forward_in: loader.gated_kernel(&format!("{block}.ff.net.0.proj"))?,
            feed_forward_out: kernel("ff.net.2")?,
            projection_out: loader.kernel(&format!("{name}.proj_out"))?,
        })
    }

    /// The keys and values of a prompt, for every later [`Transformer::run`].
    pub(crate) fn context(&self, backend: &B, text: &B::Tensor) -> Result<B::Tensor> {
        let fused = Convolution { intermediate: true, ..Convolution::default() };
        backend.convolve(text, &self.cross_keys_values, &fused)
    }

    pub(crate) fn run(
        &self,
        backend: &B,
        input: &B::Tensor,
        contexts: &[&B::Tensor],
    ) -> Result<B::Tensor> {
        let fused = Convolution { prologue: self.norm.plain(), ..Convolution::default() };
        let tokens = backend.convolve(input, &self.projection_in, &fused)?;
        let tokens = self.attend_to_each_other(backend, &tokens)?;
        let tokens = self.attend_to_text(backend, &tokens, contexts)?;
        let tokens = self.feed_forward(backend, &tokens)?;
        let fused = Convolution { residual: Some(input), ..Convolution::default() };
        backend.convolve(&tokens, &self.projection_out, &fused)
    }

    fn attend_to_each_other(&self, backend: &B, tokens: &B::Tensor) -> Result<B::Tensor> {
        let projected =
            backend.convolve(tokens, &self.self_queries_keys_values, &before(&self.norm1))?;
        let attended = backend.self_attention(&projected, self.heads, false)?;
        backend.convolve(&attended, &self.self_out, &added_to(tokens))
    }

    fn attend_to_text(
        &self,
        backend: &B,
        tokens: &B::Tensor,
        contexts: &[&B::Tensor],
    ) -> Result<B::Tensor> {
        let queries = backend.convolve(tokens, &self.cross_queries, &before(&self.norm2))?;
        let attended = backend.cross_attention(&queries, contexts, self.heads)?;
        backend.convolve(&attended, &self.cross_out, &added_to(tokens))
    }

    /// The result only goes into the last 1 x 1 convolution.
    fn feed_forward(&self, backend: &B, tokens: &B::Tensor) -> Result<B::Tensor> {
        let inner = backend.convolve(tokens, &self.feed_forward_in, &before(&self.norm3))?;
        let fused = Convolution { intermediate: true, ..added_to(tokens) };
        backend.convolve(&inner, &self.feed_forward_out, &fused)
    }
}

/// A linear layer of normalised tokens, whose result only goes into attention or a further product.
fn before<T>(norm: &LayerNormalization) -> Convolution<'_, T> {
    Convolution { prologue: norm.prologue(), intermediate: true, ..Convolution::default() }
}

/// A linear layer whose result is added to the tokens.
fn added_to<T>(tokens: &T) -> Convolution<'_, T> {
    Convolution { residual: Some(tokens), ..Convolution::default() }
}
