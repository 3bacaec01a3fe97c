//! The options of `--encoder diffusion`: a table `[diffusion]` in the configuration file.

use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use rare::hint::Percentiles;
use rare_nets::diffusion::{DiffusionSettings, Preset};
use rare_nets::engine::Precision;
use serde::Deserialize;

use super::choice;

#[derive(Debug, Clone, Default, PartialEq, Args, Deserialize)]
#[serde(default, deny_unknown_fields, rename_all = "kebab-case")]
#[command(next_help_heading = "Options of --encoder diffusion")]
pub(crate) struct DiffusionOptions {
    /// How much is computed; the following options change single settings of it [default: single-step; with
    /// --preset paper: paper]
    #[arg(id = "diffusion", long = "diffusion", value_name = "PRESET", value_parser = choice::<Preset>(&["paper", "no-guidance", "few-steps", "single-step"]))]
    pub(crate) preset: Option<Preset>,
    /// Layers whose features are taken, 0 (middle block) to 12 [default: 0,3,6]
    #[arg(long, value_name = "N,N,...", value_delimiter = ',')]
    pub(crate) layers: Option<Vec<usize>>,
    /// What the pictures show [default: by the kind of scene]
    #[arg(long, value_name = "TEXT")]
    pub(crate) prompt: Option<String>,
    /// What they do not show
    #[arg(long, value_name = "TEXT")]
    pub(crate) negative_prompt: Option<String>,
    /// Steps from noise to image; only those before --time are taken, 0 takes none
    #[arg(long, value_name = "N")]
    pub(crate) steps: Option<usize>,
    /// Classifier-free guidance; 1 is none
    #[arg(long, value_name = "FACTOR", allow_negative_numbers = true)]
    pub(crate) guidance: Option<f32>,
    /// The time at which features are read, 0 (image) to 1000 (noise) [default: 150]
    #[arg(long, value_name = "TIME")]
    pub(crate) time: Option<usize>,
    /// Give both maps of a view the same noise (it is drawn with --seed)
    #[arg(long, num_args = 0, default_missing_value = "true")]
    pub(crate) shared_noise: Option<bool>,
    /// Which pixels decide how bright a depth is painted [default: all-pixels]
    #[arg(long, value_name = "PIXELS", value_parser = choice::<Percentiles>(&["all-pixels", "valid-only"]))]
    pub(crate) holes: Option<Percentiles>,
    /// The precision of products; sums are in single precision always [default: f32]
    #[arg(long, value_name = "PRECISION", value_parser = choice::<Precision>(&["f32", "bf16"]))]
    pub(crate) precision: Option<Precision>,
    /// Keep the features of every depth map in this folder and look for them there first
    #[arg(long, value_name = "DIR")]
    pub(crate) cache: Option<PathBuf>,
}

/// The diffusion features with nothing left open but the prompt, which needs the clouds.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Diffusion {
    pub(crate) settings: DiffusionSettings,
    pub(crate) cache: Option<PathBuf>,
}

impl DiffusionOptions {
    /// These options, and where one is open that of `other`.
    pub(super) fn or(self, other: DiffusionOptions) -> DiffusionOptions {
        DiffusionOptions {
            preset: self.preset.or(other.preset),
            layers: self.layers.or(other.layers),
            prompt: self.prompt.or(other.prompt),
            negative_prompt: self.negative_prompt.or(other.negative_prompt),
            steps: self.steps.or(other.steps),
            guidance: self.guidance.or(other.guidance),
            time: self.time.or(other.time),
            shared_noise: self.shared_noise.or(other.shared_noise),
            holes: self.holes.or(other.holes),
            precision: self.precision.or(other.precision),
            cache: self.cache.or(other.cache),
        }
    }

    /// Adds the defaults: those of a preset.
    ///
    /// # Errors
    /// If a value is impossible.
    pub(super) fn resolve(self, paper: bool, seed: u64) -> Result<Diffusion> {
        let default = match self.preset {
            Some(preset) => preset.settings(),
            None if paper => Preset::Paper.settings(),
            None => DiffusionSettings::default(),
        };
        let settings = DiffusionSettings {
            prompt: self.prompt.or(default.prompt),
            negative_prompt: self.negative_prompt.unwrap_or(default.negative_prompt),
            steps: self.steps.unwrap_or(default.steps),
            guidance: self.guidance.unwrap_or(default.guidance),
            time: self.time.unwrap_or(default.time),
            seed,
            shared_noise: self.shared_noise.unwrap_or(default.shared_noise),
            holes: self.holes.unwrap_or(default.holes),
            layers: self.layers.unwrap_or(default.layers),
            precision: self.precision.unwrap_or(default.precision),
        };
        settings.validate()?;
        Ok(Diffusion { settings, cache: self.cache })
    }
}
