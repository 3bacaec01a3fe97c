//! What can be set about diffusion features, with defaults and named presets.

use std::str::FromStr;

use rare::hint::Percentiles;
use rare::scale::SceneKind;
use rare::{Error, Result};
use serde::{Deserialize, Serialize};

use super::LAYERS;

/// The prompt for rooms and objects (FreeReg's).
pub const INDOOR_PROMPT: &str = "a photo of a room, furniture, household items, best quality";

/// The prompt for streets (FreeReg's).
pub const STREET_PROMPT: &str =
    "a vehicle camera photo of street view, trees, cars, people, house, road, sky, best quality";

/// What the pictures shall not be (FreeReg's negative prompt).
pub const NEGATIVE_PROMPT: &str = "lowres, bad anatomy, bad hands, cropped, worst quality";

/// Largest guidance; far below it the pictures are burnt already.
const MOST_GUIDANCE: f32 = 100.0;

/// Everything that can be set about diffusion features. The default is [`Preset::SingleStep`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DiffusionSettings {
    /// What the pictures show, taken literally; without it [`INDOOR_PROMPT`], or what
    /// [`DiffusionSettings::with_prompt_for`] chose.
    pub prompt: Option<String>,
    /// What guidance leads away from.
    pub negative_prompt: String,
    /// Steps of the whole way from noise to image (the paper: 20), of which only those before the time of the features
    /// are taken. 0: none; the latent is `sqrt(1 - alpha) * noise` with the cumulative `alpha` of `time`, which is a zero
    /// latent (an image without content) noised to `time`.
    pub steps: usize,
    /// Classifier-free guidance (Ho and Salimans, 2022) of the steps: the noise is
    /// `unconditional + guidance * (conditional - unconditional)`. 1 is no guidance and half the cost.
    pub guidance: f32,
    /// The time at which features are read, 0 (image) to 1000 (noise).
    pub time: usize,
    /// Seed of the noise.
    pub seed: u64,
    /// Whether both maps of a view get the same noise. FreeReg draws anew for every map.
    pub shared_noise: bool,
    /// Which pixels decide how bright a depth is painted.
    pub holes: Percentiles,
    /// The layers whose features are read, ascending: 0 is the middle block, 1 to 12 the blocks of the decoder.
    pub layers: Vec<usize>,
    /// The precision of the products.
    pub precision: Precision,
}

/// The precision of the factors of products; sums are in single precision always.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Precision {
    /// Single precision.
    #[default]
    F32,
    /// The upper half of single precision: faster where the processor multiplies it.
    Bf16,
}

/// Settings by name.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Preset {
    /// The paper's: 17 steps of a schedule of 20, guidance 5, features at time 150.
    Paper,
    /// The paper's without guidance: about half of the cost.
    NoGuidance,
    /// 8 steps of a schedule of 10. Its latent has the noise of time 101 as the paper's has, which no shorter schedule
    /// with the paper's time reaches: with 5 steps it is that of time 1.
    FewSteps,
    /// No step: the features of a zero latent noised to time 150, conditional only.
    SingleStep,
}

impl Preset {
    /// All presets, the most expensive first.
    pub const ALL: [Preset; 4] =
        [Preset::Paper, Preset::NoGuidance, Preset::FewSteps, Preset::SingleStep];

    /// The name.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Preset::Paper => "paper",
            Preset::NoGuidance => "no-guidance",
            Preset::FewSteps => "few-steps",
            Preset::SingleStep => "single-step",
        }
    }

    /// What it stands for.
    #[must_use]
    pub fn settings(self) -> DiffusionSettings {
        let paper = DiffusionSettings {
            prompt: None,
            negative_prompt: NEGATIVE_PROMPT.to_owned(),
            steps: 20,
            guidance: 5.0,
            time: 150,
            seed: 0,
            shared_noise: false,
            holes: Percentiles::AllPixels,
            layers: vec![0, 3, 6],
            precision: Precision::F32,
        };
        match self {
            Preset::Paper => paper,
            Preset::NoGuidance => DiffusionSettings { guidance: 1.0, ..paper },
            Preset::FewSteps => DiffusionSettings { steps: 10, ..paper },
            Preset::SingleStep => DiffusionSettings { steps: 0, ..paper },
        }
    }
}

impl FromStr for Preset {
    type Err = Error;

    fn from_str(name: &str) -> Result<Preset> {
        Preset::ALL.into_iter().find(|preset| preset.name() == name).ok_or_else(|| {
            let names = Preset::ALL.map(Preset::name).join(", ");
            Error::invalid(format!("no preset {name:?}: choose one of {names}"))
        })
    }
}

impl Default for DiffusionSettings {
    fn default() -> DiffusionSettings {
        Preset::SingleStep.settings()
    }
}

impl DiffusionSettings {
    /// The same settings with the prompt that suits the scene, unless there is a prompt already.
    #[must_use]
    pub fn with_prompt_for(mut self, scene: SceneKind) -> DiffusionSettings {
        let prompt = match scene {
            SceneKind::Lidar => STREET_PROMPT,
            SceneKind::Indoor | SceneKind::Object => INDOOR_PROMPT,
        };
        self.prompt.get_or_insert_with(|| prompt.to_owned());
        self
    }

    /// The prompt, or [`INDOOR_PROMPT`].
    #[must_use]
    pub fn prompt(&self) -> &str {
        self.prompt.as_deref().unwrap_or(INDOOR_PROMPT)
    }

    /// Whether every step also asks the network for the unconditional noise.
    #[must_use]
    pub fn guided(&self) -> bool {
        self.guidance != 1.0
    }

    /// Makes sure that guidance and layers are possible. Time and steps depend on the noise schedule of the pipeline and
    /// are checked by [`super::Plan::new`], prompts on its vocabulary.
    ///
    /// # Errors
    /// `InvalidInput` with the value and what is possible.
    pub fn validate(&self) -> Result<()> {
        if !(0.0..=MOST_GUIDANCE).contains(&self.guidance) {
            return Err(Error::invalid(format!(
                "guidance {}: it must be 0 to {MOST_GUIDANCE}; 1 is none, the paper has 5",
                self.guidance
            )));
        }
        let ascending = self.layers.is_sorted_by(|one, next| one < next);
        if !ascending || self.layers.last().is_none_or(|&last| last >= LAYERS) {
            return Err(Error::invalid(format!(
                "layers {:?}: name some of 0 to {}, ascending and each once; the paper has 0, 3, 6",
                self.layers,
                LAYERS - 1
            )));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn presets_are_found_by_name_and_valid() {
        for preset in Preset::ALL {
            assert_eq!(preset.name().parse::<Preset>().unwrap(), preset);
            assert_eq!(serde_json::to_string(&preset).unwrap(), format!("{:?}", preset.name()));
            assert!(preset.settings().validate().is_ok());
        }
        let message = "papre".parse::<Preset>().unwrap_err().to_string();
        assert!(message.contains("papre") && message.contains("single-step"), "{message}");
        assert_eq!(DiffusionSettings::default(), Preset::SingleStep.settings());
    }

    #[test]
    fn settings_survive_a_file() {
        let settings = DiffusionSettings {
            prompt: Some("a cave".to_owned()),
            holes: Percentiles::ValidOnly,
            precision: Precision::Bf16,
            ..Preset::Paper.settings()
        };
        let text = serde_json::to_string(&settings).unwrap();
        assert!(text.contains("\"valid-only\"") && text.contains("\"bf16\""), "{text}");
        assert_eq!(serde_json::from_str::<DiffusionSettings>(&text).unwrap(), settings);
        let partial: DiffusionSettings = serde_json::from_str(r#"{"time": 200}"#).unwrap();
        assert_eq!(partial, DiffusionSettings { time: 200, ..DiffusionSettings::default() });
        assert!(serde_json::from_str::<DiffusionSettings>(r#"{"tiem": 200}"#).is_err());
    }

    #[test]
    fn impossible_settings_are_refused() {
        let settings = DiffusionSettings::default();
        for guidance in [-1.0, 101.0, f32::NAN, f32::INFINITY] {
            let message = DiffusionSettings { guidance, ..settings.clone() }.validate();
            assert!(message.unwrap_err().to_string().contains(&format!("guidance {guidance}")));
        }
        for layers in [vec![], vec![3, 0], vec![3, 3], vec![0, 13], vec![usize::MAX]] {
            let named = format!("layers {layers:?}");
            let message = DiffusionSettings { layers, ..settings.clone() }.validate();
            assert!(message.unwrap_err().to_string().contains(&named));
        }
    }

    #[test]
    fn the_scene_chooses_the_prompt_where_nobody_did() {
        let settings = DiffusionSettings::default();
        assert_eq!(settings.clone().with_prompt_for(SceneKind::Lidar).prompt(), STREET_PROMPT);
        assert_eq!(settings.prompt(), INDOOR_PROMPT);
        let own = DiffusionSettings { prompt: Some("a cave".to_owned()), ..settings };
        assert_eq!(own.with_prompt_for(SceneKind::Lidar).prompt(), "a cave");
    }
}
