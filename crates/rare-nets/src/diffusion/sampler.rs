//! From noise to features: the steps of a [`Plan`] (paper section "Depth Diffusion Feature Extraction").
//!
//! Images of equal size go through the networks together, and with guidance each of them twice: first all of them with
//! the prompt, then all of them with the negative prompt. What does not change from step to step is computed once: the
//! prompts' keys and values when the sampler is made, the embedding of the depth images before the first step.
//!
//! Latents are values in the order image, row, column, channel throughout.

mod plan;

use rare::data::LayeredFeatures;
use rare::{Error, FeatureMap, Result};

use super::{Contexts, Control, ControlNet, Extent, Output, Unet};
use crate::engine::{Backend, Shape};

pub use plan::Plan;

/// Both networks on a backend.
pub struct Networks<B: Backend> {
    /// What computes them.
    pub backend: B,
    /// The U-Net, loaded to the end if the plan has steps, otherwise at least to its last layer.
    pub unet: Unet<B>,
    /// The network that is shown the depth images.
    pub controlnet: ControlNet<B>,
    /// Channels of a latent image (SD 1.5: 4).
    pub latent_channels: usize,
}

/// Takes depth images from noise to features.
pub struct Sampler<B: Backend> {
    networks: Networks<B>,
    plan: Plan,
    conditional: Prompt<B::Tensor>,
    unconditional: Option<Prompt<B::Tensor>>,
}

/// A prompt as both networks take it.
struct Prompt<T> {
    unet: Contexts<T>,
    controlnet: Contexts<T>,
}

/// Depth images of one size on the backend, encoded.
pub struct Hints<T> {
    embedding: T,
    /// The sizes of their latents.
    shape: Shape,
}

impl<T> Hints<T> {
    /// The sizes of the latent images that belong to these depth images.
    #[must_use]
    pub fn latents(&self) -> Shape {
        self.shape
    }
}

/// The noise that the networks see in some latents.
#[derive(Debug, Clone, PartialEq)]
pub struct Prediction {
    /// Given the prompt.
    pub conditional: Vec<f32>,
    /// Given the negative prompt; only with guidance.
    pub unconditional: Option<Vec<f32>>,
}

impl Prediction {
    /// Classifier-free guidance (Ho and Salimans, 2022): `unconditional + guidance * (conditional - unconditional)`, or
    /// the conditional noise where there is no other.
    #[must_use]
    pub fn guided(self, guidance: f32) -> Vec<f32> {
        let Some(unconditional) = self.unconditional else { return self.conditional };
        let pairs = self.conditional.iter().zip(unconditional);
        pairs.map(|(&with, without)| without + guidance * (with - without)).collect()
    }
}

impl<B: Backend> Sampler<B> {
    /// Prepares the prompts: what the text encoder says of the prompt, and of the negative prompt (77 x width each),
    /// which is only used where the plan has guidance.
    ///
    /// # Errors
    /// `Internal` if the texts do not fit the networks; what the backend has.
    pub fn new(
        networks: Networks<B>,
        plan: Plan,
        text: &[f32],
        negative_text: &[f32],
    ) -> Result<Sampler<B>> {
        let Networks { backend, unet, controlnet, .. } = &networks;
        let prompt = |text: &[f32]| {
            Ok(Prompt {
                unet: unet.contexts(backend, text)?,
                controlnet: controlnet.contexts(backend, text)?,
            })
        };
        let conditional = prompt(text)?;
        let unconditional = plan.guidance.map(|_| prompt(negative_text)).transpose()?;
        Ok(Sampler { networks, plan, conditional, unconditional })
    }

    /// What is done.
    #[must_use]
    pub fn plan(&self) -> &Plan {
        &self.plan
    }

    /// Encodes depth images of one size: `images x height x width x 3` values in 0 to 1, three equal channels, both sides
    /// multiples of 64.
    ///
    /// # Errors
    /// `Internal` if shape and values do not fit; what the backend has.
    pub fn embed(&self, shape: Shape, values: &[f32]) -> Result<Hints<B::Tensor>> {
        let Networks { backend, controlnet, latent_channels, .. } = &self.networks;
        let embedding = controlnet.embed_hint(backend, &backend.upload(shape, values)?)?;
        let shape = Shape { channels: *latent_channels, ..backend.shape(&embedding) };
        Ok(Hints { embedding, shape })
    }

    /// The features of all layers of the plan for each depth image. `draw` gives normal noise for all of its latents:
    /// first to begin with, then for every step. `report` is told of how many images have passed the networks each time
    /// that some have.
    ///
    /// # Errors
    /// `Internal` if there is too little noise; what the backend has.
    pub fn features(
        &self,
        hints: &Hints<B::Tensor>,
        mut draw: impl FnMut() -> Vec<f32>,
        report: impl Fn(usize),
    ) -> Result<Vec<LayeredFeatures>> {
        let scale = self.plan.noise_scale as f32;
        let mut latents: Vec<f32> = draw().into_iter().map(|value| scale * value).collect();
        for step in &self.plan.steps {
            let prediction = self.predict(&latents, step.time, hints)?;
            let noise = prediction.guided(self.plan.guidance.unwrap_or(1.0));
            latents = step.advance(&latents, &noise, &draw())?;
            report(self.plan.branches() * hints.shape.batch);
        }
        let features = self.read(&latents, hints)?;
        report(hints.shape.batch);
        Ok(features)
    }

    /// The noise that the networks see in latents at a time.
    ///
    /// # Errors
    /// `Internal` if the latents are not those of the depth images; what the backend has.
    pub fn predict(
        &self,
        latents: &[f32],
        time: usize,
        hints: &Hints<B::Tensor>,
    ) -> Result<Prediction> {
        let prompts: Vec<_> = [&self.conditional].into_iter().chain(&self.unconditional).collect();
        let latents = latents.repeat(prompts.len());
        let output = self.run(&latents, time, hints, &prompts, Extent::Whole)?;
        let noise = output.noise.ok_or_else(|| Error::Internal("no noise predicted".to_owned()))?;
        let mut conditional = self.networks.backend.download(&noise)?;
        let unconditional = conditional.split_off(conditional.len() / prompts.len());
        Ok(Prediction {
            conditional,
            unconditional: self.unconditional.is_some().then_some(unconditional),
        })
    }

    /// The features of all layers of the plan for each image, from latents at the end of the steps, with the prompt.
    ///
    /// # Errors
    /// `Internal` if the latents are not those of the depth images; what the backend has.
    pub fn read(&self, latents: &[f32], hints: &Hints<B::Tensor>) -> Result<Vec<LayeredFeatures>> {
        let Plan { time, layers, .. } = &self.plan;
        let extent = Extent::UpToLayer(self.plan.last_layer());
        let output = self.run(latents, *time, hints, &[&self.conditional], extent)?;
        let mut features = vec![LayeredFeatures::new(); hints.shape.batch];
        for &layer in layers {
            let tensor = output.layers.get(layer).ok_or_else(|| {
                Error::Internal(format!("the U-Net gave {} layers", output.layers.len()))
            })?;
            for (features, map) in features.iter_mut().zip(self.maps(tensor)?) {
                features.push(map);
            }
        }
        Ok(features)
    }

    /// Both networks on latents, as many as depth images times prompts.
    fn run(
        &self,
        latents: &[f32],
        time: usize,
        hints: &Hints<B::Tensor>,
        prompts: &[&Prompt<B::Tensor>],
        extent: Extent,
    ) -> Result<Output<B::Tensor>> {
        let Networks { backend, unet, .. } = &self.networks;
        let shape = Shape { batch: hints.shape.batch * prompts.len(), ..hints.shape };
        let latents = backend.upload(shape, latents)?;
        let control = self.control(&latents, time, hints, prompts)?;
        let contexts: Vec<_> = prompts.iter().map(|prompt| &prompt.unet).collect();
        let timestep = unet.timestep(backend, time as f32)?;
        unet.run(backend, &latents, &timestep, &contexts, Some(control), extent)
    }

    fn control(
        &self,
        latents: &B::Tensor,
        time: usize,
        hints: &Hints<B::Tensor>,
        prompts: &[&Prompt<B::Tensor>],
    ) -> Result<Control<'_, B>> {
        let Networks { backend, controlnet, .. } = &self.networks;
        let contexts: Vec<_> = prompts.iter().map(|prompt| &prompt.controlnet).collect();
        let timestep = controlnet.timestep(backend, time as f32)?;
        controlnet.run(backend, latents, &hints.embedding, &timestep, &contexts)
    }

    /// A layer as one feature map per image.
    fn maps(&self, layer: &B::Tensor) -> Result<Vec<FeatureMap>> {
        let backend = &self.networks.backend;
        let Shape { height, width, channels, .. } = backend.shape(layer);
        let values = backend.download(layer)?;
        values
            .chunks((height * width * channels).max(1))
            .map(|image| {
                let planes = (0..channels)
                    .flat_map(|channel| image.iter().skip(channel).step_by(channels))
                    .copied();
                FeatureMap::new(channels, height, width, planes.collect())
            })
            .collect()
    }
}
