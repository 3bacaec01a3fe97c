//! The options that `register` and `refine` share: one struct for flags and for the configuration file.
//!
//! A flag wins over the file, the file over the default. [`Options::resolve`] decides everything that is left open, so
//! that nothing else in the program has to know a default.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, anyhow, bail};
use clap::Args;
use clap::builder::{PossibleValuesParser, TypedValueParser};
use rare::scale::Profile;
use rare::viewpoints::CameraChoice;
use rare::{InitialMethod, Recipe, RefinerConfig};
use serde::de::value::{Error as ValueError, StringDeserializer};
use serde::de::{DeserializeOwned, IntoDeserializer};
use serde::{Deserialize, Serialize};

#[derive(Debug, Clone, Default, PartialEq, Args, Deserialize)]
#[serde(default, deny_unknown_fields, rename_all = "kebab-case")]
pub(crate) struct Options {
    /// Write the transform (source -> reference) as 4 lines of 4 numbers
    #[arg(long, value_name = "FILE")]
    pub(crate) output: Option<PathBuf>,
    /// Write the transform with all evidence and settings as JSON
    #[arg(long, value_name = "FILE")]
    pub(crate) json: Option<PathBuf>,
    /// Write the source cloud moved into the frame of the reference (.ply .pcd .xyz .npy)
    #[arg(long, value_name = "FILE")]
    pub(crate) save_aligned: Option<PathBuf>,
    /// The most accurate method, or the paper's recipe unchanged [default: default]
    #[arg(long, value_name = "PRESET", value_parser = choice::<Preset>(&["default", "paper"]))]
    pub(crate) preset: Option<Preset>,
    /// What kind of scans these are; auto looks at the clouds [default: auto]
    #[arg(long, value_name = "PROFILE", value_parser = choice::<Profile>(&["auto", "indoor", "lidar", "object"]))]
    pub(crate) profile: Option<Profile>,
    /// From where the clouds are looked at; auto follows the kind of scene [default: auto; --preset paper sees
    /// lidar scans through kitti]
    #[arg(long, value_name = "CAMERA", value_parser = choice::<CameraChoice>(&["auto", "sensor", "kitti", "ring", "overlap"]))]
    pub(crate) camera: Option<CameraChoice>,
    /// Voxel size in metres; all other lengths are multiples of it [default: indoor 0.05, lidar 0.3, otherwise from
    /// the clouds]
    #[arg(long, value_name = "METRES", allow_negative_numbers = true)]
    pub(crate) voxel: Option<f64>,
    /// Where the features of depth maps come from [default: builtin; with --depth-features: recorded]
    #[arg(long, value_name = "ENCODER", value_parser = choice::<Encoder>(&["builtin", "recorded"]))]
    pub(crate) encoder: Option<Encoder>,
    /// Recorded features of the depth maps (NPZ), made under the very same initial transform; `refine` only
    #[arg(long, value_name = "FILE")]
    pub(crate) depth_features: Option<PathBuf>,
    /// A flag of `register` alone; here so that one file serves both commands.
    #[arg(skip)]
    pub(crate) init_method: Option<InitialMethod>,
    /// Seed of all random choices; the same seed gives the same result [default: 0]
    #[arg(long, value_name = "N")]
    pub(crate) seed: Option<u64>,
    /// Number of threads; the result does not depend on it [default: 0, all cores]
    #[arg(long, value_name = "N")]
    pub(crate) threads: Option<usize>,
    /// Print nothing but the transform and errors
    #[arg(short, long, num_args = 0, default_missing_value = "true", conflicts_with = "verbose")]
    pub(crate) quiet: Option<bool>,
    /// Print the evidence by set of correspondences and the time by step as well
    #[arg(short, long, num_args = 0, default_missing_value = "true")]
    pub(crate) verbose: Option<bool>,
    /// Take options from a TOML file (keys are the names of these flags, `preset = "paper"`); flags win over it
    #[arg(long, value_name = "FILE.toml")]
    #[serde(skip)]
    pub(crate) config: Option<PathBuf>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum Preset {
    #[default]
    Default,
    Paper,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum Encoder {
    Builtin,
    Recorded,
}

/// The options with nothing left open.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Settings {
    pub(crate) preset: Preset,
    pub(crate) refiner: RefinerConfig,
    /// Recorded features of the depth maps; without them the built-in features are used.
    pub(crate) depth_features: Option<PathBuf>,
    pub(crate) init_method: InitialMethod,
    /// 0: as many as there are cores.
    pub(crate) threads: usize,
    pub(crate) quiet: bool,
    pub(crate) verbose: bool,
    pub(crate) output: Option<PathBuf>,
    pub(crate) json: Option<PathBuf>,
    pub(crate) save_aligned: Option<PathBuf>,
    pub(crate) config: Option<PathBuf>,
}

/// Reads one of a type's names, so that flags and files know the same words.
pub(crate) fn choice<T>(names: &'static [&'static str]) -> impl TypedValueParser<Value = T>
where
    T: DeserializeOwned + Clone + Send + Sync + 'static,
{
    PossibleValuesParser::new(names).try_map(|name| {
        let name: StringDeserializer<ValueError> = name.into_deserializer();
        T::deserialize(name)
    })
}

impl Options {
    /// Adds the file's options and the defaults.
    ///
    /// # Errors
    /// If the file cannot be read or has an unknown key, or if options contradict each other.
    pub(crate) fn resolve(self) -> Result<Settings> {
        let options = match &self.config {
            Some(file) => {
                let from_file = Options::read(file)?;
                self.or(from_file)
            }
            None => self,
        };
        let recorded = options.recorded()?;
        Ok(Settings {
            preset: options.preset.unwrap_or_default(),
            refiner: options.refiner(recorded),
            depth_features: options.depth_features.filter(|_| recorded),
            init_method: options.init_method.unwrap_or_default(),
            threads: options.threads.unwrap_or(0),
            quiet: options.quiet.unwrap_or(false),
            verbose: options.verbose.unwrap_or(false),
            output: options.output,
            json: options.json,
            save_aligned: options.save_aligned,
            config: options.config,
        })
    }

    fn read(file: &Path) -> Result<Options> {
        let text = fs::read_to_string(file).with_context(|| file.display().to_string())?;
        toml::from_str(&text).map_err(|error| {
            let before = error.span().and_then(|span| text.get(..span.start)).unwrap_or_default();
            let line = before.matches('\n').count() + 1;
            let message = error.message().replace('\n', ", ");
            anyhow!("{}: line {line}: {message}", file.display())
        })
    }

    /// These options, and where one is open that of `other`.
    fn or(self, other: Options) -> Options {
        Options {
            output: self.output.or(other.output),
            json: self.json.or(other.json),
            save_aligned: self.save_aligned.or(other.save_aligned),
            preset: self.preset.or(other.preset),
            profile: self.profile.or(other.profile),
            camera: self.camera.or(other.camera),
            voxel: self.voxel.or(other.voxel),
            encoder: self.encoder.or(other.encoder),
            depth_features: self.depth_features.or(other.depth_features),
            init_method: self.init_method.or(other.init_method),
            seed: self.seed.or(other.seed),
            threads: self.threads.or(other.threads),
            quiet: self.quiet.or(other.quiet),
            verbose: self.verbose.or(other.verbose),
            config: self.config.or(other.config),
        }
    }

    /// Whether recorded features are used.
    fn recorded(&self) -> Result<bool> {
        match (self.encoder, &self.depth_features) {
            (Some(Encoder::Builtin), Some(file)) => bail!(
                "--encoder builtin does not use --depth-features {}: leave out one of them",
                file.display()
            ),
            (Some(Encoder::Recorded), None) => {
                bail!("--encoder recorded needs the recorded features: add --depth-features FILE")
            }
            (_, file) => Ok(file.is_some()),
        }
    }

    fn refiner(&self, recorded: bool) -> RefinerConfig {
        let paper = self.preset == Some(Preset::Paper);
        let mut recipe = if paper { Recipe::paper() } else { Recipe::default() };
        if recorded {
            // The features belong to the views under the initial transform, a second round has others.
            recipe.rounds = 1;
        }
        let profile = self.profile.unwrap_or_default();
        RefinerConfig {
            profile,
            camera: self.camera.unwrap_or_default(),
            voxel: self.voxel,
            seed: self.seed.unwrap_or(0),
            recipe,
        }
    }
}

impl Settings {
    /// Where the features of depth maps come from.
    pub(crate) fn encoder(&self) -> Encoder {
        if self.depth_features.is_some() { Encoder::Recorded } else { Encoder::Builtin }
    }
}
