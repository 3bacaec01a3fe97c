//! Counting operations and values: each tensor of a network's layout is used once per pixel of the level that its name
//! tells.

use crate::checkpoint::Layout;
use crate::diffusion::layout::BLOCKS_PER_LEVEL;
use crate::diffusion::{
    ControlNetConfig, Extent, LAYERS, PROMPT_LENGTH, UnetConfig, controlnet_layout, unet_layout,
};

/// Rows and columns of a latent image.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct LatentSize {
    /// Rows.
    pub height: usize,
    /// Columns.
    pub width: usize,
}

impl LatentSize {
    /// Number of pixels.
    #[must_use]
    pub fn pixels(self) -> usize {
        self.height.saturating_mul(self.width)
    }

    /// Pixels at a level of the U-Net: 0 is the latent image, each next one has a quarter of them.
    fn at(self, level: usize) -> f64 {
        self.pixels() as f64 / 4_f64.powi(level as i32)
    }
}

/// The coarsest of the four levels of the U-Net.
const COARSEST: usize = 3;

/// The tensors that are used once per depth image.
const HINT: &str = "controlnet_cond_embedding.";

/// Operations of one pass of one image through the U-Net.
#[must_use]
pub fn unet_operations(config: &UnetConfig, size: LatentSize, extent: Extent) -> f64 {
    operations(&unet_layout(config), size, extent)
}

/// Operations of one pass of one image through the `ControlNet`, of which a U-Net run to `extent` asks for its last
/// residuals only. The encoding of the depth image is not among them.
#[must_use]
pub fn controlnet_operations(config: &ControlNetConfig, size: LatentSize, extent: Extent) -> f64 {
    operations(&controlnet_layout(config), size, extent)
}

/// Operations of the encoding of one depth image.
#[must_use]
pub fn hint_operations(config: &ControlNetConfig, size: LatentSize) -> f64 {
    let layout = controlnet_layout(config);
    let kernels = layout.iter().filter_map(|(name, shape)| {
        let part = name.strip_prefix(HINT)?.strip_suffix(".weight")?;
        // 512 x 704 pixels for 64 x 88; blocks 1, 3 and 5 halve both sides.
        let halved = match part.strip_prefix("blocks.") {
            Some(block) => block.parse::<usize>().ok()?.div_ceil(2),
            None if part == "conv_in" => 0,
            None => COARSEST,
        };
        Some(
            2.0 * values(shape) * size.at(0) * 4_f64.powi((COARSEST - halved.min(COARSEST)) as i32),
        )
    });
    kernels.sum()
}

/// Number of values of the tensors that are loaded for `extent`.
pub(super) fn stored_values(layout: &Layout, extent: Extent) -> f64 {
    // All residuals of a ControlNet are loaded, whether asked for or not.
    let loaded = |name: &str| name.starts_with("controlnet_") || is_used(name, extent);
    layout.iter().filter(|(name, _)| loaded(name)).map(|(_, shape)| values(shape)).sum()
}

/// Number of values of activations at the peak, for `images` images at once: the hidden states of both networks that
/// wait for the decoder half, and the transformer of the finest level with its input, tokens, and the fourfold inner
/// layer.
pub(super) fn working_values(channels: &[usize; 4], size: LatentSize, images: usize) -> f64 {
    let channels = channels.map(|channels| channels as f64);
    let mut states = channels[0] * size.at(0);
    for (level, channels) in channels.iter().enumerate() {
        let downsampled = if level < COARSEST { size.at(level + 1) } else { size.at(level) };
        states += channels * (2.0 * size.at(level) + downsampled);
    }
    images as f64 * (2.0 * states + 6.0 * channels[0] * size.at(0))
}

fn operations(layout: &Layout, size: LatentSize, extent: Extent) -> f64 {
    let per_tensor = layout.iter().map(|(name, shape)| {
        let once = shape.len() < 2 || name.starts_with(HINT) || name.contains("time_emb");
        // The keys and values of the prompts are computed beforehand.
        let prepared = name.ends_with("attn2.to_k.weight") || name.ends_with("attn2.to_v.weight");
        if once || prepared || !is_used(name, extent) {
            return 0.0;
        }
        let pixels = size.at(level(name));
        2.0 * pixels * (values(shape) + products_of_attention(name, shape, pixels))
    });
    per_tensor.sum()
}

/// Products per query of an attention, counted at the tensor that makes the queries: with every key, and every value.
fn products_of_attention(name: &str, shape: &[usize], pixels: f64) -> f64 {
    let channels = shape.first().map_or(0.0, |&channels| channels as f64);
    if name.ends_with("attn1.to_q.weight") {
        2.0 * pixels * channels
    } else if name.ends_with("attn2.to_q.weight") {
        2.0 * PROMPT_LENGTH as f64 * channels
    } else {
        0.0
    }
}

/// The level on which a tensor is used.
fn level(name: &str) -> usize {
    let (block, rest) = name.split_once('.').unwrap_or((name, ""));
    let (index, part) = rest.split_once('.').unwrap_or((rest, ""));
    let index = index.parse().unwrap_or(0_usize);
    let level = match block {
        "down_blocks" => index + usize::from(part.starts_with("downsamplers")),
        "mid_block" | "controlnet_mid_block" => COARSEST,
        "up_blocks" => COARSEST.saturating_sub(index + usize::from(part.starts_with("upsamplers"))),
        // Three states per level, of which the first comes from the level before.
        "controlnet_down_blocks" => index / 3,
        _ => 0,
    };
    level.min(COARSEST)
}

/// Whether a tensor is used by a run to `extent`.
fn is_used(name: &str, extent: Extent) -> bool {
    let Extent::UpToLayer(blocks) = extent else { return true };
    let parts: Vec<&str> = name.split('.').collect();
    let number = |at: usize| parts.get(at).and_then(|part| part.parse().ok()).unwrap_or(0_usize);
    match parts.first().copied() {
        Some("up_blocks") => {
            // The upsampling belongs to the last block of its level.
            let upsampling = parts.get(2) == Some(&"upsamplers");
            let within = if upsampling { BLOCKS_PER_LEVEL } else { number(3) };
            (BLOCKS_PER_LEVEL + 1) * number(1) + within < blocks
        }
        // The decoder half takes the residuals from the last on.
        Some("controlnet_down_blocks") => number(1) + blocks >= LAYERS - 1,
        Some("conv_norm_out" | "conv_out") => false,
        _ => true,
    }
}

fn values(shape: &[usize]) -> f64 {
    shape.iter().map(|&size| size as f64).product()
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: LatentSize = LatentSize { height: 64, width: 88 };

    fn config() -> ControlNetConfig {
        let unet = UnetConfig {
            in_channels: 4,
            block_out_channels: [320, 640, 1280, 1280],
            heads: 8,
            cross_attention_dim: 768,
            groups: 32,
        };
        ControlNetConfig { unet, hint_channels: 3, hint_embedding_channels: [16, 32, 96, 256] }
    }

    /// Against a counter of operations over the original networks.
    #[test]
    fn operations_are_those_of_stable_diffusion() {
        let giga = |extent| {
            let controlnet =
                controlnet_operations(&config(), SIZE, extent) + hint_operations(&config(), SIZE);
            let unet = unet_operations(&config().unet, SIZE, extent);
            (controlnet / 1e9, (controlnet + unet) / 1e9)
        };
        let (controlnet, both) = giga(Extent::Whole);
        assert!((controlnet / 414.0 - 1.0).abs() < 0.02, "{controlnet}");
        assert!((both / 1581.0 - 1.0).abs() < 0.02, "{both}");
        let (_, both) = giga(Extent::UpToLayer(6));
        assert!((both / 1043.0 - 1.0).abs() < 0.02, "{both}");
    }

    #[test]
    fn all_values_are_stored_unless_a_layer_is_the_last() {
        let layout = unet_layout(&config().unet);
        assert_eq!(stored_values(&layout, Extent::Whole), 859_520_964.0);
        let layer = |layer| stored_values(&layout, Extent::UpToLayer(layer));
        assert!((0..12).all(|index| layer(index) < layer(index + 1)));
        let head = 2 * 320 + 4 * 320 * 9 + 4;
        assert_eq!(layer(12), 859_520_964.0 - f64::from(head));
        let layout = controlnet_layout(&config());
        assert_eq!(stored_values(&layout, Extent::UpToLayer(0)), 361_279_120.0);
    }

    #[test]
    fn working_values_are_those_of_the_states() {
        // The shapes of the thirteen residuals, channels x pixels.
        let states =
            3 * 320 * 5632 + (320 + 2 * 640) * 1408 + (640 + 2 * 1280) * 352 + 4 * 1280 * 88;
        let inner = 6 * 320 * 5632;
        let values = working_values(&config().unet.block_out_channels, SIZE, 3);
        assert_eq!(values, f64::from(3 * (2 * states + inner)));
    }

    #[test]
    fn layers_cost_more_and_more() {
        let cost = |layer| {
            let extent = Extent::UpToLayer(layer);
            unet_operations(&config().unet, SIZE, extent)
                + controlnet_operations(&config(), SIZE, extent)
        };
        assert!((0..12).all(|layer| cost(layer) < cost(layer + 1)));
        let whole = unet_operations(&config().unet, SIZE, Extent::Whole);
        assert!(whole > unet_operations(&config().unet, SIZE, Extent::UpToLayer(12)));
    }
}
