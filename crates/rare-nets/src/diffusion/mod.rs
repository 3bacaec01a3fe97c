//! Depth diffusion features: Stable Diffusion 1.5 with a depth `ControlNet` (paper section "Depth Diffusion Feature
//! Extraction").

mod config;

pub use config::{ControlNetConfig, SchedulerConfig, TextConfig, UnetConfig};
