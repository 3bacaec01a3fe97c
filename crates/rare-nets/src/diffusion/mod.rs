//! Depth diffusion features: Stable Diffusion 1.5 with a depth `ControlNet` (paper section "Depth Diffusion Feature
//! Extraction").

mod config;
mod controlnet;
mod layers;
mod layout;
mod text_encoder;
mod unet;

pub use config::{ControlNetConfig, SchedulerConfig, TextConfig, UnetConfig};
pub use controlnet::{Control, ControlNet};
pub use layers::{Contexts, Timestep};
pub use layout::{
    Differences, Layout, Misshapen, compare, controlnet_layout, text_encoder_layout, unet_layout,
};
pub use text_encoder::TextEncoder;
pub use unet::{Extent, LAYERS, Output, Unet};
mod pipeline;

pub use config::{ControlNetConfig, SchedulerConfig, TextConfig, UnetConfig};
pub use pipeline::{Pipeline, TokenizerFiles};
