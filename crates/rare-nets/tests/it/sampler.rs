//! The way from noise to features, against a recorded run of small networks with random weights.

use std::sync::atomic::{AtomicUsize, Ordering};

use rare_nets::checkpoint::Parameters;
use rare_nets::diffusion::{
    ControlNet, ControlNetConfig, DiffusionSettings, Hints, Networks, Plan, Prediction, Preset,
    Sampler, Schedule, SchedulerConfig, Unet, UnetConfig,
};
use rare_nets::engine::{Backend, CpuBackend, Precision, Shape};

use crate::reference_backend::ReferenceBackend;
use crate::shared::{self, Array, Golden, relative_difference};

/// Of the largest value, for one pass or step; single precision differs from double by 1.2e-6.
const STEP_TOLERANCE: f64 = 1e-5;

/// Of the largest value, after all steps one after the other; single precision differs from double by 2.7e-6.
const CHAIN_TOLERANCE: f64 = 2e-5;

fn scheduler() -> SchedulerConfig {
    SchedulerConfig { beta_start: 0.00085, beta_end: 0.012, training_steps: 1000, offset: 1 }
}

fn unet_config() -> UnetConfig {
    UnetConfig {
        in_channels: 4,
        block_out_channels: [16, 24, 40, 40],
        heads: 8,
        cross_attention_dim: 24,
        groups: 8,
    }
}

/// What was recorded of two depth images, in the order image, row, column, channel.
struct Recording {
    files: [Golden; 2],
}

impl Recording {
    fn open() -> Option<Recording> {
        let open = |name: &str| Golden::open(&format!("rare/s5_recipe_{name}.npz"));
        Some(Recording { files: [open("a")?, open("b")?] })
    }

    fn arrays(&mut self, name: &str) -> [Array; 2] {
        self.files.each_mut().map(|file| file.array(name))
    }

    /// The values of both images at one index, or of an array that has none.
    fn at(&mut self, name: &str, index: Option<usize>) -> Vec<f64> {
        let pixels = |array: Array| {
            let area: usize = array.shape[array.shape.len() - 2..].iter().product();
            let size = area * array.shape[array.shape.len() - 3];
            let image = array.values[index.unwrap_or(0) * size..][..size].to_vec();
            (0..area)
                .flat_map(|pixel| image[pixel..].iter().step_by(area).copied())
                .collect::<Vec<f64>>()
        };
        self.arrays(name).map(pixels).concat()
    }

    fn f32(&mut self, name: &str, index: Option<usize>) -> Vec<f32> {
        self.at(name, index).into_iter().map(|value| value as f32).collect()
    }
}

fn parameters(network: &str) -> Parameters {
    let file = format!("golden/rare/tiny-pipeline/{network}/diffusion_pytorch_model.safetensors");
    Parameters::open_safetensors(&[shared::path(&file).unwrap()]).unwrap()
}

/// The paper's settings with the layers that were recorded.
fn plan() -> Plan {
    let settings = DiffusionSettings { layers: vec![0, 3, 4, 6], ..Preset::Paper.settings() };
    Plan::new(&settings, &scheduler()).unwrap()
}

/// A sampler of the small networks with the recorded texts.
fn sampler<B: Backend>(backend: B, plan: Plan, recording: &mut Recording) -> Sampler<B> {
    let config = ControlNetConfig {
        unet: unet_config(),
        hint_channels: 3,
        hint_embedding_channels: [16, 32, 96, 256],
    };
    let networks = Networks {
        unet: Unet::load(&backend, &unet_config(), &parameters("unet"), plan.extent()).unwrap(),
        controlnet: ControlNet::load(&backend, &config, &parameters("controlnet")).unwrap(),
        latent_channels: 4,
        backend,
    };
    let [text, same_text] = recording.arrays("cond");
    let [negative_text, _] = recording.arrays("uncond");
    assert_eq!(text, same_text);
    Sampler::new(networks, plan, &text.f32(), &negative_text.f32()).unwrap()
}

fn hints<B: Backend>(sampler: &Sampler<B>, recording: &mut Recording) -> Hints<B::Tensor> {
    let [a, b] = recording.arrays("hint_u8");
    let pixels = a.values.iter().chain(&b.values);
    let values: Vec<f32> = pixels.flat_map(|&value| [(value / 255.0) as f32; 3]).collect();
    let shape = Shape { batch: 2, height: a.shape[0], width: a.shape[1], channels: 3 };
    sampler.embed(shape, &values).unwrap()
}

fn check(what: &str, values: &[f32], golden: &[f64], tolerance: f64) {
    let difference = relative_difference(values, golden);
    assert!(difference < tolerance, "{what}: {difference:.1e}");
}

#[test]
fn every_step_follows_the_recording() {
    let Some(mut recording) = Recording::open() else { return };
    let schedule = Schedule::new(&scheduler(), 20).unwrap();
    for (index, step) in schedule.steps.iter().enumerate() {
        let mut stored = |name| recording.f32(name, Some(index));
        let (latents, noise) = (stored("x"), stored("noise"));
        let prediction = Prediction {
            conditional: stored("eps_cond"),
            unconditional: Some(stored("eps_uncond")),
        };
        let guided = prediction.guided(5.0);
        let denoised = latents.iter().zip(&guided);
        let denoised: Vec<f32> = denoised
            .map(|(&latent, &noise)| step.denoised(f64::from(latent), f64::from(noise)) as f32)
            .collect();
        let golden = recording.at("pred_x0", Some(index));
        check(&format!("image of step {index}"), &denoised, &golden, STEP_TOLERANCE);
        let next = step.advance(&latents, &guided, &noise).unwrap();
        let golden = recording.at("x", Some(index + 1));
        check(&format!("step {index}"), &next, &golden, STEP_TOLERANCE);
    }
}

fn predictions_and_features_follow_the_recording<B: Backend>(backend: B) {
    let Some(mut recording) = Recording::open() else { return };
    let sampler = sampler(backend, plan(), &mut recording);
    let hints = hints(&sampler, &mut recording);
    for (index, time) in [(0, 951), (10, 451), (19, 1)] {
        let latents = recording.f32("x", Some(index));
        let prediction = sampler.predict(&latents, time, &hints).unwrap();
        let unconditional = prediction.unconditional.unwrap();
        for (name, noise) in [("eps_cond", prediction.conditional), ("eps_uncond", unconditional)] {
            let golden = recording.at(name, Some(index));
            check(&format!("{name} {index}"), &noise, &golden, STEP_TOLERANCE);
        }
    }
    let latents = recording.f32("x", Some(17));
    let features = sampler.read(&latents, &hints).unwrap();
    check_features(&mut recording, &features, STEP_TOLERANCE);
}

fn check_features(recording: &mut Recording, features: &[Vec<rare::FeatureMap>], tolerance: f64) {
    assert_eq!(features.len(), 2);
    for (at, name) in ["layer_0", "layer_3", "layer_4", "layer_6"].iter().enumerate() {
        for (golden, layers) in recording.arrays(name).iter().zip(features) {
            let map = &layers[at];
            assert_eq!(golden.shape, [1, map.channels(), map.height(), map.width()]);
            check(name, map.values(), &golden.values, tolerance);
        }
    }
}

/// The seventeen steps one after the other, and the features at their end.
#[test]
fn all_steps_together_follow_the_recording() {
    let Some(mut recording) = Recording::open() else { return };
    let sampler = sampler(cpu(), plan(), &mut recording);
    let hints = hints(&sampler, &mut recording);
    let mut noise = vec![recording.f32("x_T", None)];
    noise.extend((0..17).map(|index| recording.f32("noise", Some(index))));
    let mut noise = noise.into_iter();
    let passes = AtomicUsize::new(0);
    let report = |count| {
        passes.fetch_add(count, Ordering::Relaxed);
    };
    let features = sampler.features(&hints, || noise.next().unwrap(), report).unwrap();
    check_features(&mut recording, &features, CHAIN_TOLERANCE);
    assert_eq!(noise.next(), None, "noise is left");
    assert_eq!(passes.into_inner(), 2 * 35);
}

/// All twenty steps, of which the features need seventeen.
#[test]
fn the_last_image_is_the_recorded_one() {
    let Some(mut recording) = Recording::open() else { return };
    let sampler = sampler(cpu(), plan(), &mut recording);
    let hints = hints(&sampler, &mut recording);
    let mut latents = recording.f32("x_T", None);
    for (index, step) in Schedule::new(&scheduler(), 20).unwrap().steps.iter().enumerate() {
        let noise = sampler.predict(&latents, step.time, &hints).unwrap().guided(5.0);
        let drawn = recording.f32("noise", Some(index));
        latents = step.advance(&latents, &noise, &drawn).unwrap();
        let golden = recording.at("x", Some(index + 1));
        check(&format!("after step {index}"), &latents, &golden, CHAIN_TOLERANCE);
    }
}

#[test]
fn predictions_and_features_follow_the_recording_on_the_reference_backend() {
    predictions_and_features_follow_the_recording(ReferenceBackend::default());
}

/// In single precision.
fn cpu() -> CpuBackend {
    CpuBackend::new(Precision::F32).unwrap()
}

#[test]
fn predictions_and_features_follow_the_recording_on_the_processor() {
    predictions_and_features_follow_the_recording(cpu());
}
