//! Depth diffusion features: Stable Diffusion 1.5 with a depth `ControlNet` (paper section "Depth Diffusion Feature
//! Extraction").

mod config;
mod noise;
mod sampler;
mod schedule;
mod settings;
mod tokenizer;

pub use config::{ControlNetConfig, SchedulerConfig, TextConfig, UnetConfig};
pub use noise::Noise;
pub use sampler::Plan;
pub use schedule::{Schedule, Step, cumulative_alphas};
pub use settings::{
    DiffusionSettings, INDOOR_PROMPT, LAYERS, NEGATIVE_PROMPT, Precision, Preset, STREET_PROMPT,
};
pub use tokenizer::{PROMPT_LENGTH, Tokenizer, Tokens, known_tokens};
