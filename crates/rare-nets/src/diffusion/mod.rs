//! Depth diffusion features: Stable Diffusion 1.5 with a depth `ControlNet` (paper section "Depth Diffusion Feature
//! Extraction").

mod config;
mod controlnet;
mod cost;
mod encoder;
mod layers;
mod layout;
mod noise;
mod pipeline;
mod sampler;
mod schedule;
mod settings;
mod text_encoder;
mod tokenizer;
mod unet;

pub use crate::engine::Precision;
pub use config::{ControlNetConfig, SchedulerConfig, TextConfig, UnetConfig};
pub use controlnet::{Control, ControlNet};
pub use cost::{
    Cost, LatentSize, controlnet_operations, hint_operations, latent_size, unet_operations,
};
pub use encoder::DiffusionEncoder;
pub use layers::{Contexts, Timestep};
pub(crate) use layout::require;
pub use layout::{controlnet_layout, text_encoder_layout, unet_layout};
pub use noise::Noise;
pub use pipeline::{Pipeline, TokenizerFiles};
pub use sampler::{Hints, Networks, Plan, Prediction, Sampler};
pub use schedule::{Schedule, Step, cumulative_alphas};
pub use settings::{DiffusionSettings, INDOOR_PROMPT, NEGATIVE_PROMPT, Preset, STREET_PROMPT};
pub use text_encoder::TextEncoder;
pub use tokenizer::{PROMPT_LENGTH, Tokenizer, Tokens, known_tokens};
pub use unet::{Extent, LAYERS, Output, Unet};
