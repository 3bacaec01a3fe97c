//! Depth maps to features by Stable Diffusion and a `ControlNet`, as the geometry wants them (paper section "Depth
//! Diffusion Feature Extraction").

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicUsize, Ordering};

use rare::data::LayeredFeatures;
use rare::encode::DepthEncoder;
use rare::hint::{GrayImage, hint};
use rare::{DepthMap, Error, Result};

use super::{
    ControlNet, DiffusionSettings, Networks, Noise, PROMPT_LENGTH, Pipeline, Plan, Sampler,
    TextEncoder, Tokenizer, Tokens, Unet, known_tokens,
};
use crate::engine::{Backend, Shape};

/// Sides of a depth image are multiples of this: its latent image has an eighth of them, which the U-Net halves thrice.
const MULTIPLE: usize = 64;

/// Encodes depth maps on a backend.
pub struct DiffusionEncoder<B: Backend> {
    sampler: Sampler<B>,
    settings: DiffusionSettings,
    progress: Option<Progress>,
}

/// Is told how many passes of a map through the networks are done, and how many there are.
type Progress = Box<dyn Fn(usize, usize) + Send + Sync>;

impl<B: Backend> DiffusionEncoder<B> {
    /// Loads the networks of a pipeline, as much of them as the settings need, and encodes the prompts.
    ///
    /// # Errors
    /// `InvalidInput` if the settings are impossible, a prompt has more than 77 tokens, or a file of the pipeline is
    /// damaged or does not fit the others; `Io` if one cannot be read; what the backend has.
    pub fn load(
        backend: B,
        pipeline: &Pipeline,
        settings: &DiffusionSettings,
    ) -> Result<DiffusionEncoder<B>> {
        let plan = Plan::new(settings, &pipeline.scheduler)?;
        let [text, negative_text] = encode_texts(&backend, pipeline, settings)?;
        let networks = Networks {
            unet: Unet::load(&backend, &pipeline.unet_config, &pipeline.unet, plan.extent())?,
            controlnet: ControlNet::load(
                &backend,
                &pipeline.controlnet_config,
                &pipeline.controlnet,
            )?,
            latent_channels: pipeline.unet_config.in_channels,
            backend,
        };
        let sampler = Sampler::new(networks, plan, &text, &negative_text)?;
        Ok(DiffusionEncoder { sampler, settings: settings.clone(), progress: None })
    }

    /// Calls `progress` with the number of passes through the networks that are done and the number of all, each time
    /// that some are. A pass is one of one map; they come in batches.
    #[must_use]
    pub fn with_progress(
        mut self,
        progress: impl Fn(usize, usize) + Send + Sync + 'static,
    ) -> DiffusionEncoder<B> {
        self.progress = Some(Box::new(progress));
        self
    }

    /// What is done with each map.
    #[must_use]
    pub fn plan(&self) -> &Plan {
        self.sampler.plan()
    }

    /// Encodes the maps of the numbers `indices`, whose depth images have one size.
    fn encode_batch(
        &self,
        images: &[(usize, GrayImage)],
        report: impl Fn(usize),
    ) -> Result<Vec<LayeredFeatures>> {
        let hints = self.sampler.embed(shape(images)?, &values(images))?;
        let DiffusionSettings { seed, shared_noise, .. } = self.settings;
        let mut noise: Vec<Noise> = images
            .iter()
            .map(|(index, _)| Noise::new(seed, index / 2, index % 2, shared_noise))
            .collect();
        let count = Shape { batch: 1, ..hints.latents() }.values();
        let draw = || noise.iter_mut().flat_map(|noise| noise.take(count)).collect();
        self.sampler.features(&hints, draw, report)
    }
}

/// Depth images of one size.
#[derive(Default)]
struct Batch {
    /// Where each stands among those that were asked for.
    places: Vec<usize>,
    /// With the numbers of their maps.
    images: Vec<(usize, GrayImage)>,
}

impl<B: Backend> DepthEncoder for DiffusionEncoder<B> {
    /// Map `i` is that of cloud `i mod 2` in view `i / 2`, which decides its noise. Maps of any sizes may be mixed.
    fn encode_at(&self, maps: &[(usize, &DepthMap)]) -> Result<Vec<LayeredFeatures>> {
        let mut batches: BTreeMap<(usize, usize), Batch> = BTreeMap::new();
        for (place, &(index, map)) in maps.iter().enumerate() {
            let image = hint(map, self.settings.holes)?;
            let batch = batches.entry((image.height(), image.width())).or_default();
            batch.places.push(place);
            batch.images.push((index, image));
        }
        let total = maps.len() * self.plan().passes();
        let done = AtomicUsize::new(0);
        let report = |passes| {
            let done = done.fetch_add(passes, Ordering::Relaxed) + passes;
            if let Some(progress) = &self.progress {
                progress(done, total);
            }
        };
        let mut encoded = BTreeMap::new();
        for Batch { places, images } in batches.into_values() {
            let features = self.encode_batch(&images, report)?;
            encoded.extend(places.into_iter().zip(features));
        }
        Ok(encoded.into_values().collect())
    }
}

/// The sizes of depth images as the `ControlNet` takes them.
fn shape(images: &[(usize, GrayImage)]) -> Result<Shape> {
    let (height, width) =
        images.first().map_or((0, 0), |(_, image)| (image.height(), image.width()));
    if !height.is_multiple_of(MULTIPLE) || !width.is_multiple_of(MULTIPLE) {
        return Err(Error::invalid(format!(
            "a depth image of {width} x {height} pixels: its sides must be multiples of {MULTIPLE}"
        )));
    }
    Ok(Shape { batch: images.len(), height, width, channels: 3 })
}

/// Three equal channels in 0 to 1, pixel by pixel.
fn values(images: &[(usize, GrayImage)]) -> Vec<f32> {
    let pixels = images.iter().flat_map(|(_, image)| image.values());
    pixels.flat_map(|&value| [f32::from(value) / 255.0; 3]).collect()
}

/// What the text encoder says of the prompt and the negative prompt, 77 x width each. The text encoder is dropped
/// afterwards.
fn encode_texts<B: Backend>(
    backend: &B,
    pipeline: &Pipeline,
    settings: &DiffusionSettings,
) -> Result<[Vec<f32>; 2]> {
    let prompt = tokens(pipeline, settings.prompt())?;
    let negative = tokens(pipeline, &settings.negative_prompt)?;
    let encoder = TextEncoder::load(backend, &pipeline.text_config, &pipeline.text_encoder)?;
    Ok([encoder.encode(backend, &prompt.ids)?, encoder.encode(backend, &negative.ids)?])
}

/// The tokens of a prompt, without the files of the vocabulary where they are known.
fn tokens(pipeline: &Pipeline, prompt: &str) -> Result<Tokens> {
    let config = &pipeline.text_config;
    let tokens = match known_tokens(prompt) {
        Some(tokens) => tokens,
        None => {
            let files = pipeline.tokenizer.as_ref().ok_or_else(|| {
                Error::invalid(format!(
                    "the prompt {prompt:?} needs the files vocab.json and merges.txt of CLIP's tokenizer beside the weights: put them there, or leave the prompts at their defaults"
                ))
            })?;
            Tokenizer::open(&files.vocabulary, &files.merges)?.encode(prompt)?.complete()?
        }
    };
    let largest = tokens.ids.iter().max().map_or(0, |&id| id as usize);
    if largest >= config.vocabulary || config.positions != PROMPT_LENGTH {
        return Err(Error::invalid(format!(
            "the text encoder knows {} tokens and takes {} of them, the prompt has token {largest} and is {PROMPT_LENGTH} long: take text encoder and tokenizer of the same Stable Diffusion 1.x",
            config.vocabulary, config.positions
        )));
    }
    Ok(tokens)
}
