//! Which tensors the weight files of each network hold, under which names and with which shapes.
//!
//! The names are those of the diffusers and transformers libraries, in which the weights are published. A layout is the
//! only place where shapes are derived from a configuration: loading asks it for the shape of every tensor, and whether
//! an optional part (the transformer of a block, the shortcut of a residual block) exists.

use rare::Result;

use super::{ControlNetConfig, TextConfig, UnetConfig};
use crate::checkpoint::{self, Layout, Parameters};

/// Residual blocks of each level of the encoder half; the decoder half has one more.
pub(crate) const BLOCKS_PER_LEVEL: usize = 2;

/// The width of the time embedding and of the gated feed-forward layers, as a multiple of the channels.
const EXPANSION: usize = 4;

/// Makes sure that weight files hold the tensors of `layout` and no others. `network` is its name for the message.
///
/// # Errors
/// `InvalidInput` with the file and the first differences.
pub(crate) fn require(layout: &Layout, parameters: &Parameters, network: &str) -> Result<()> {
    let network = format!("the {network} that its configuration describes");
    let advice = "take weights and configuration of Stable Diffusion 1.5 from one source";
    checkpoint::require(layout, parameters, &network, advice)
}

/// Every tensor of the U-Net (Ronneberger et al., 2015; Rombach et al., 2022).
#[must_use]
pub fn unet_layout(config: &UnetConfig) -> Layout {
    let mut layout = Builder::new(config.cross_attention_dim, config.block_out_channels[0]);
    let finest = config.block_out_channels[0];
    layout.encoder_half(config);
    layout.decoder_half(&config.block_out_channels);
    layout.normalization("conv_norm_out", finest);
    layout.convolution("conv_out", config.in_channels, finest, 3);
    layout.tensors
}

/// Every tensor of the `ControlNet` (Zhang et al., 2023).
#[must_use]
pub fn controlnet_layout(config: &ControlNetConfig) -> Layout {
    let channels = config.unet.block_out_channels;
    let mut layout = Builder::new(config.unet.cross_attention_dim, channels[0]);
    layout.encoder_half(&config.unet);
    layout.hint_embedding(config);
    for (index, &width) in state_channels(&channels).iter().enumerate() {
        layout.convolution(&format!("controlnet_down_blocks.{index}"), width, width, 1);
    }
    layout.convolution("controlnet_mid_block", channels[3], channels[3], 1);
    layout.tensors
}

/// Every tensor of the CLIP text encoder (Radford et al., 2021).
#[must_use]
pub fn text_encoder_layout(config: &TextConfig) -> Layout {
    let width = config.hidden_size;
    let mut layout = Builder::new(0, 0);
    layout.weight("text_model.embeddings.token_embedding", &[config.vocabulary, width]);
    layout.weight("text_model.embeddings.position_embedding", &[config.positions, width]);
    for index in 0..config.layers {
        let layer = format!("text_model.encoder.layers.{index}");
        for part in ["q_proj", "k_proj", "v_proj", "out_proj"] {
            layout.linear(&format!("{layer}.self_attn.{part}"), width, width);
        }
        layout.linear(&format!("{layer}.mlp.fc1"), config.intermediate_size, width);
        layout.linear(&format!("{layer}.mlp.fc2"), width, config.intermediate_size);
        layout.normalization(&format!("{layer}.layer_norm1"), width);
        layout.normalization(&format!("{layer}.layer_norm2"), width);
    }
    layout.normalization("text_model.final_layer_norm", width);
    layout.tensors
}

/// The channels of the twelve hidden states that the encoder half hands over: that of the first convolution, and for
/// each level those of its blocks and of its downsampling.
fn state_channels(levels: &[usize; 4]) -> Vec<usize> {
    let mut channels = vec![levels[0]];
    for (level, &width) in levels.iter().enumerate() {
        let downsampling = usize::from(level < 3);
        channels.extend(std::iter::repeat_n(width, BLOCKS_PER_LEVEL + downsampling));
    }
    channels
}

/// Collects the tensors of a network.
struct Builder {
    tensors: Layout,
    /// Width of the text context.
    context: usize,
    /// Width of the time embedding.
    time: usize,
}

impl Builder {
    fn new(context: usize, finest: usize) -> Builder {
        Builder { tensors: Layout::new(), context, time: finest.saturating_mul(EXPANSION) }
    }

    fn weight(&mut self, name: &str, shape: &[usize]) {
        self.tensors.insert(format!("{name}.weight"), shape.to_vec());
    }

    fn with_bias(&mut self, name: &str, shape: &[usize]) {
        self.weight(name, shape);
        self.tensors.insert(format!("{name}.bias"), shape[..1].to_vec());
    }

    fn normalization(&mut self, name: &str, channels: usize) {
        self.with_bias(name, &[channels]);
    }

    fn linear(&mut self, name: &str, outputs: usize, inputs: usize) {
        self.with_bias(name, &[outputs, inputs]);
    }

    fn convolution(&mut self, name: &str, outputs: usize, inputs: usize, side: usize) {
        self.with_bias(name, &[outputs, inputs, side, side]);
    }

    /// What the U-Net and the `ControlNet` have in common: the way down and the middle.
    fn encoder_half(&mut self, config: &UnetConfig) {
        let levels = config.block_out_channels;
        self.linear("time_embedding.linear_1", self.time, levels[0]);
        self.linear("time_embedding.linear_2", self.time, self.time);
        self.convolution("conv_in", levels[0], config.in_channels, 3);
        let mut inputs = levels[0];
        for (level, &width) in levels.iter().enumerate() {
            let name = format!("down_blocks.{level}");
            for index in 0..BLOCKS_PER_LEVEL {
                self.block(&name, index, inputs, width, level < 3);
                inputs = width;
            }
            if level < 3 {
                self.convolution(&format!("{name}.downsamplers.0.conv"), width, width, 3);
            }
        }
        self.block("mid_block", 0, inputs, inputs, true);
        self.block("mid_block", 1, inputs, inputs, false);
    }

    /// The way up: every block takes one hidden state of the way down, from the last to the first.
    fn decoder_half(&mut self, levels: &[usize; 4]) {
        let mut states = state_channels(levels);
        let mut inputs = levels[3];
        for (level, &width) in levels.iter().rev().enumerate() {
            let name = format!("up_blocks.{level}");
            for index in 0..=BLOCKS_PER_LEVEL {
                let state = states.pop().unwrap_or_default();
                self.block(&name, index, inputs.saturating_add(state), width, level > 0);
                inputs = width;
            }
            if level < 3 {
                self.convolution(&format!("{name}.upsamplers.0.conv"), width, width, 3);
            }
        }
    }

    /// A residual block, and a transformer where the level has them.
    fn block(
        &mut self,
        level: &str,
        index: usize,
        inputs: usize,
        outputs: usize,
        transformer: bool,
    ) {
        self.resnet(&format!("{level}.resnets.{index}"), inputs, outputs);
        if transformer {
            self.transformer(&format!("{level}.attentions.{index}"), outputs);
        }
    }

    fn resnet(&mut self, name: &str, inputs: usize, outputs: usize) {
        self.normalization(&format!("{name}.norm1"), inputs);
        self.convolution(&format!("{name}.conv1"), outputs, inputs, 3);
        self.linear(&format!("{name}.time_emb_proj"), outputs, self.time);
        self.normalization(&format!("{name}.norm2"), outputs);
        self.convolution(&format!("{name}.conv2"), outputs, outputs, 3);
        if inputs != outputs {
            self.convolution(&format!("{name}.conv_shortcut"), outputs, inputs, 1);
        }
    }

    fn transformer(&mut self, name: &str, channels: usize) {
        self.normalization(&format!("{name}.norm"), channels);
        self.convolution(&format!("{name}.proj_in"), channels, channels, 1);
        let block = format!("{name}.transformer_blocks.0");
        for (attention, context) in [("attn1", channels), ("attn2", self.context)] {
            self.weight(&format!("{block}.{attention}.to_q"), &[channels, channels]);
            self.weight(&format!("{block}.{attention}.to_k"), &[channels, context]);
            self.weight(&format!("{block}.{attention}.to_v"), &[channels, context]);
            self.linear(&format!("{block}.{attention}.to_out.0"), channels, channels);
        }
        let inner = channels.saturating_mul(EXPANSION);
        // Values and gates, one after the other.
        self.linear(&format!("{block}.ff.net.0.proj"), inner.saturating_mul(2), channels);
        self.linear(&format!("{block}.ff.net.2"), channels, inner);
        for norm in ["norm1", "norm2", "norm3"] {
            self.normalization(&format!("{block}.{norm}"), channels);
        }
        self.convolution(&format!("{name}.proj_out"), channels, channels, 1);
    }

    /// The encoder of the depth image: between first and last convolution, two for each step in the channels.
    fn hint_embedding(&mut self, config: &ControlNetConfig) {
        let name = "controlnet_cond_embedding";
        let widths = config.hint_embedding_channels;
        self.convolution(&format!("{name}.conv_in"), widths[0], config.hint_channels, 3);
        for (index, pair) in widths.windows(2).enumerate() {
            let (even, odd) = (2 * index, 2 * index + 1);
            self.convolution(&format!("{name}.blocks.{even}"), pair[0], pair[0], 3);
            self.convolution(&format!("{name}.blocks.{odd}"), pair[1], pair[0], 3);
        }
        let finest = config.unet.block_out_channels[0];
        self.convolution(&format!("{name}.conv_out"), finest, widths[3], 3);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn stable_diffusion_1_5() -> ControlNetConfig {
        let unet = UnetConfig {
            in_channels: 4,
            block_out_channels: [320, 640, 1280, 1280],
            heads: 8,
            cross_attention_dim: 768,
            groups: 32,
        };
        ControlNetConfig { unet, hint_channels: 3, hint_embedding_channels: [16, 32, 96, 256] }
    }

    fn count(layout: &Layout) -> usize {
        layout.values().map(|shape| shape.iter().product::<usize>()).sum()
    }

    #[test]
    fn the_published_networks_have_as_many_parameters() {
        let config = stable_diffusion_1_5();
        assert_eq!(count(&unet_layout(&config.unet)), 859_520_964);
        assert_eq!(count(&controlnet_layout(&config)), 361_279_120);
    }

    #[test]
    fn the_published_text_encoder_has_as_many_parameters() {
        let config = TextConfig {
            hidden_size: 768,
            intermediate_size: 3072,
            heads: 12,
            layers: 12,
            vocabulary: 49408,
            positions: 77,
            epsilon: 1e-5,
        };
        assert_eq!(count(&text_encoder_layout(&config)), 123_060_480);
    }

    #[test]
    fn sizes_beyond_any_memory_do_not_overflow() {
        let mut config = stable_diffusion_1_5();
        let most = usize::MAX;
        config.unet.block_out_channels = [most; 4];
        let layout = unet_layout(&config.unet);
        assert_eq!(layout["time_embedding.linear_1.weight"], [most, most]);
        assert_eq!(layout["up_blocks.0.resnets.0.conv1.weight"], [most, most, 3, 3]);
        let feed_forward = "mid_block.attentions.0.transformer_blocks.0.ff.net.0.proj.bias";
        assert_eq!(layout[feed_forward], [most]);
    }
}
