//! The options that `register`, `refine` and `features` share: one struct for flags and for the configuration file.
//!
//! A flag wins over the file, the file over the default. [`Options::resolve`] decides everything that is left open, so
//! that nothing else in the program has to know a default.

mod diffusion;
mod networks;

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, anyhow, bail};
use clap::Args;
use clap::builder::{PossibleValuesParser, TypedValueParser};
pub(crate) use diffusion::Diffusion;
use diffusion::DiffusionOptions;
pub(crate) use networks::{Backbone, BackboneChoice, InitMethod};
use rare::scale::Profile;
use rare::viewpoints::CameraChoice;
use rare::{Recipe, RefinerConfig};
use rare_nets::backbones::SelectionRule;
use serde::de::value::{Error as ValueError, StringDeserializer};
use serde::de::{DeserializeOwned, IntoDeserializer};
use serde::{Deserialize, Serialize};

#[derive(Debug, Clone, Default, PartialEq, Args, Deserialize)]
#[serde(default, deny_unknown_fields, rename_all = "kebab-case")]
pub(crate) struct Options {
    /// Write the transform (source -> reference) as 4 lines of 4 numbers
    #[arg(long, alias = "out", value_name = "FILE")]
    pub(crate) output: Option<PathBuf>,
    /// Write the transform with all evidence and settings as JSON
    #[arg(long, value_name = "FILE")]
    pub(crate) json: Option<PathBuf>,
    /// Write the source cloud moved into the frame of the reference (.ply .pcd .xyz .npy)
    #[arg(long, value_name = "FILE")]
    pub(crate) save_aligned: Option<PathBuf>,
    /// Write a page (HTML) that shows what was done and whether to believe it; opens in any browser, needs no network
    #[arg(long, value_name = "FILE")]
    pub(crate) report: Option<PathBuf>,
    /// Draw figures of depth maps, features, matches and clouds (PNG, print resolution) into a folder, which is made if
    /// it does not exist
    #[arg(long, value_name = "DIR")]
    pub(crate) figures: Option<PathBuf>,
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
    #[arg(long, value_name = "ENCODER", value_parser = choice::<Encoder>(&["builtin", "recorded", "diffusion"]))]
    pub(crate) encoder: Option<Encoder>,
    /// Recorded features of the depth maps (NPZ), made under the very same initial transform; `refine` only
    #[arg(long, value_name = "FILE")]
    pub(crate) depth_features: Option<PathBuf>,
    /// What describes the clouds in 3D: built-in histograms, or a network, whose own transform is the initial one where
    /// none is given [default: fpfh]
    #[arg(long, value_name = "NETWORK", value_parser = choice::<BackboneChoice>(&["fpfh", "geotransformer", "predator", "cofinet", "fcgf"]))]
    pub(crate) backbone: Option<BackboneChoice>,
    /// Weights of the networks that are used, a checkpoint of their authors or the folder of a diffusion pipeline; may be
    /// given several times, each is recognised by its content
    #[arg(long, value_name = "PATH")]
    #[serde(deserialize_with = "networks::one_or_more")]
    pub(crate) weights: Vec<PathBuf>,
    /// Most 3D keypoints of a cloud [default: 500, streets 1000]
    #[arg(long, value_name = "N")]
    pub(crate) keypoints: Option<usize>,
    /// Which keypoints or correspondences of a network are taken [default: top-score]
    #[arg(long, value_name = "RULE", value_parser = choice::<SelectionRule>(&["top-score", "random"]))]
    pub(crate) keypoint_rule: Option<SelectionRule>,
    /// Most neighbours of a point in a network, stage by stage [default: those of its authors; for streets, which they
    /// never published, by their rule from the clouds]
    #[arg(long, value_name = "N,N,...", value_delimiter = ',')]
    pub(crate) neighbor_limits: Option<Vec<usize>>,
    /// Let VBReg sample its states, as its authors do (with --seed), instead of taking their means
    #[arg(long, num_args = 0, default_missing_value = "true")]
    pub(crate) vbreg_noise: Option<bool>,
    /// How often the clouds are looked at and matched, each time under the transform found before [default: 2; with
    /// --preset paper or --encoder recorded: 1]
    #[arg(long, value_name = "N")]
    pub(crate) rounds: Option<usize>,
    /// Take the first proposal as it is: nothing is compared with the initial transform, nothing is sought elsewhere
    #[arg(long, num_args = 0, default_missing_value = "true")]
    pub(crate) no_verify: Option<bool>,
    /// Do not look for transforms elsewhere when the initial one leads to nothing certain
    #[arg(long, num_args = 0, default_missing_value = "true")]
    pub(crate) no_search: Option<bool>,
    /// Do not align the surfaces at the end
    #[arg(long, num_args = 0, default_missing_value = "true")]
    pub(crate) no_polish: Option<bool>,
    /// A flag of `register` alone; here so that one file serves both commands.
    #[arg(skip)]
    pub(crate) init_method: Option<InitMethod>,
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
    #[command(flatten)]
    pub(crate) diffusion: DiffusionOptions,
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
    Diffusion,
}

/// The options with nothing left open.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Settings {
    pub(crate) preset: Preset,
    pub(crate) refiner: RefinerConfig,
    /// Where the features of depth maps come from.
    pub(crate) encoder: Encoder,
    /// The file of `Encoder::Recorded`.
    pub(crate) depth_features: Option<PathBuf>,
    /// The settings of `Encoder::Diffusion`.
    pub(crate) diffusion: Option<Diffusion>,
    /// The network that describes the clouds.
    pub(crate) backbone: Option<Backbone>,
    /// Weights of the networks, in the order given.
    pub(crate) weights: Vec<PathBuf>,
    /// Whether VBReg samples its states.
    pub(crate) vbreg_noise: bool,
    /// How the initial transform is estimated, if that was said.
    pub(crate) init_method: Option<InitMethod>,
    /// 0: as many as there are cores.
    pub(crate) threads: usize,
    pub(crate) quiet: bool,
    pub(crate) verbose: bool,
    pub(crate) output: Option<PathBuf>,
    pub(crate) json: Option<PathBuf>,
    pub(crate) save_aligned: Option<PathBuf>,
    pub(crate) report: Option<PathBuf>,
    pub(crate) figures: Option<PathBuf>,
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
        let diffusion_named = self.diffusion != DiffusionOptions::default();
        let options = match &self.config {
            Some(file) => {
                let from_file = Options::read(file)?;
                self.or(from_file)
            }
            None => self,
        };
        let encoder = options.encoder()?;
        if diffusion_named && encoder != Encoder::Diffusion {
            bail!(
                "options of diffusion features are given, but not asked for: add --encoder diffusion"
            );
        }
        options.settings(encoder)
    }

    fn settings(self, encoder: Encoder) -> Result<Settings> {
        let refiner = self.refiner(encoder)?;
        let backbone = self.resolve_backbone()?;
        let paper = self.preset == Some(Preset::Paper);
        let diffusion = match encoder {
            Encoder::Diffusion => Some(self.diffusion.resolve(paper, refiner.seed)?),
            Encoder::Builtin | Encoder::Recorded => None,
        };
        Ok(Settings {
            preset: self.preset.unwrap_or_default(),
            refiner,
            encoder,
            depth_features: self.depth_features.filter(|_| encoder == Encoder::Recorded),
            diffusion,
            backbone,
            weights: self.weights,
            vbreg_noise: self.vbreg_noise.unwrap_or(false),
            init_method: self.init_method,
            threads: self.threads.unwrap_or(0),
            quiet: self.quiet.unwrap_or(false),
            verbose: self.verbose.unwrap_or(false),
            output: self.output,
            json: self.json,
            save_aligned: self.save_aligned,
            report: self.report,
            figures: self.figures,
            config: self.config,
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
            report: self.report.or(other.report),
            figures: self.figures.or(other.figures),
            preset: self.preset.or(other.preset),
            profile: self.profile.or(other.profile),
            camera: self.camera.or(other.camera),
            voxel: self.voxel.or(other.voxel),
            encoder: self.encoder.or(other.encoder),
            depth_features: self.depth_features.or(other.depth_features),
            backbone: self.backbone.or(other.backbone),
            weights: if self.weights.is_empty() { other.weights } else { self.weights },
            keypoints: self.keypoints.or(other.keypoints),
            keypoint_rule: self.keypoint_rule.or(other.keypoint_rule),
            neighbor_limits: self.neighbor_limits.or(other.neighbor_limits),
            vbreg_noise: self.vbreg_noise.or(other.vbreg_noise),
            rounds: self.rounds.or(other.rounds),
            no_verify: self.no_verify.or(other.no_verify),
            no_search: self.no_search.or(other.no_search),
            no_polish: self.no_polish.or(other.no_polish),
            init_method: self.init_method.or(other.init_method),
            seed: self.seed.or(other.seed),
            threads: self.threads.or(other.threads),
            quiet: self.quiet.or(other.quiet),
            verbose: self.verbose.or(other.verbose),
            config: self.config.or(other.config),
            diffusion: self.diffusion.or(other.diffusion),
        }
    }

    /// Where the features of depth maps come from.
    fn encoder(&self) -> Result<Encoder> {
        match (self.encoder, &self.depth_features) {
            (Some(encoder @ (Encoder::Builtin | Encoder::Diffusion)), Some(file)) => bail!(
                "--encoder {} does not use --depth-features {}: leave out one of them",
                encoder.name(),
                file.display()
            ),
            (Some(Encoder::Recorded), None) => {
                bail!("--encoder recorded needs the recorded features: add --depth-features FILE")
            }
            (None, Some(_)) => Ok(Encoder::Recorded),
            (encoder, _) => Ok(encoder.unwrap_or(Encoder::Builtin)),
        }
    }

    fn refiner(&self, encoder: Encoder) -> Result<RefinerConfig> {
        let paper = self.preset == Some(Preset::Paper);
        let recipe = if paper { Recipe::paper() } else { Recipe::default() };
        let recipe = match encoder {
            Encoder::Builtin => recipe,
            // The features belong to the views under the initial transform; other rounds and transforms have others.
            Encoder::Recorded => Recipe { rounds: 1, search: false, ..recipe },
            Encoder::Diffusion => recipe.for_network(),
        };
        Ok(RefinerConfig {
            profile: self.profile.unwrap_or_default(),
            camera: self.camera.unwrap_or_default(),
            voxel: self.voxel,
            seed: self.seed.unwrap_or(0),
            recipe: Recipe {
                rounds: self.rounds(encoder, recipe.rounds)?,
                keypoints: self.keypoints.or(recipe.keypoints),
                ..self.without_steps(&recipe)
            },
        })
    }

    /// The recipe without the steps that are switched off. A search is worth nothing where nothing is compared.
    fn without_steps(&self, recipe: &Recipe) -> Recipe {
        let kept = |off: Option<bool>| !off.unwrap_or(false);
        let verify = recipe.verify && kept(self.no_verify);
        Recipe {
            verify,
            search: recipe.search && verify && kept(self.no_search),
            polish: recipe.polish && kept(self.no_polish),
            ..recipe.clone()
        }
    }

    fn rounds(&self, encoder: Encoder, default: usize) -> Result<usize> {
        match self.rounds {
            Some(0) => bail!("--rounds 0: at least one is needed to look at the clouds"),
            Some(rounds @ 2..) if encoder == Encoder::Recorded => bail!(
                "--rounds {rounds}: recorded features belong to the views of one round: leave it out"
            ),
            rounds => Ok(rounds.unwrap_or(default)),
        }
    }
}

impl Encoder {
    /// The name that options have for it.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Encoder::Builtin => "builtin",
            Encoder::Recorded => "recorded",
            Encoder::Diffusion => "diffusion",
        }
    }
}
