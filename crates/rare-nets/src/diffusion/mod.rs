//! Depth diffusion features: Stable Diffusion 1.5 with a depth `ControlNet` (paper section "Depth Diffusion Feature
//! Extraction").

mod config;
mod pipeline;

pub use config::{ControlNetConfig, SchedulerConfig, TextConfig, UnetConfig};
pub use pipeline::{Pipeline, TokenizerFiles};
