//! The sizes of the networks, as the `config.json` of a pipeline folder gives them.

/// The U-Net of Stable Diffusion 1.x.
#[derive(Debug, Clone, PartialEq)]
pub struct UnetConfig {
    /// Channels of the latent image.
    pub in_channels: usize,
    /// Channels of each level, the finest first (SD 1.5: 320, 640, 1280, 1280).
    pub block_out_channels: [usize; 4],
    /// Number of attention heads at every level (`attention_head_dim` in the file means that number).
    pub heads: usize,
    /// Width of the text context (SD 1.5: 768).
    pub cross_attention_dim: usize,
    /// Groups of every group normalisation (SD 1.5: 32).
    pub groups: usize,
}

/// The `ControlNet`: the encoder half of the same U-Net, and an encoder of the depth image.
#[derive(Debug, Clone, PartialEq)]
pub struct ControlNetConfig {
    /// The half that it shares with the U-Net.
    pub unet: UnetConfig,
    /// Channels of the depth image (3 equal ones).
    pub hint_channels: usize,
    /// Channels of the encoder of the depth image (16, 32, 96, 256).
    pub hint_embedding_channels: [usize; 4],
}

/// The CLIP text encoder.
#[derive(Debug, Clone, PartialEq)]
pub struct TextConfig {
    /// Width (SD 1.5: 768).
    pub hidden_size: usize,
    /// Width of the layer between (SD 1.5: 3072).
    pub intermediate_size: usize,
    /// Attention heads (SD 1.5: 12).
    pub heads: usize,
    /// Layers (SD 1.5: 12).
    pub layers: usize,
    /// Number of tokens that exist (49408).
    pub vocabulary: usize,
    /// Length of a prompt (77).
    pub positions: usize,
    /// Added to the variance in layer normalisations.
    pub epsilon: f32,
}

/// The noise schedule.
#[derive(Debug, Clone, PartialEq)]
pub struct SchedulerConfig {
    /// First beta (0.00085); betas are squares of equally spaced roots ("scaled linear").
    pub beta_start: f64,
    /// Last beta (0.012).
    pub beta_end: f64,
    /// Number of training timesteps (1000).
    pub training_steps: usize,
    /// Offset of the sampled timesteps (1).
    pub offset: usize,
}
