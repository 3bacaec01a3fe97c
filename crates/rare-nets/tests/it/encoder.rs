//! Depth maps to features by small networks with random weights.

use std::sync::{Arc, Mutex};

use rare::data::{Intrinsics, LayeredFeatures};
use rare::encode::DepthEncoder;
use rare::{DepthMap, FeatureMap, Result};
use rare_nets::diffusion::{
    Cost, DiffusionEncoder, DiffusionSettings, Extent, Pipeline, Plan, Preset,
    controlnet_operations, hint_operations, latent_size, unet_operations,
};
use rare_nets::engine::{CpuBackend, Precision};

use crate::shared;

/// The small networks with one head instead of eight, since attention takes nearly all of their time.
fn pipeline() -> Option<Pipeline> {
    let mut pipeline = Pipeline::open(&shared::path("golden/rare/tiny-pipeline")?).unwrap();
    pipeline.unet_config.heads = 1;
    pipeline.controlnet_config.unet.heads = 1;
    Some(pipeline)
}

fn load(pipeline: &Pipeline, settings: &DiffusionSettings) -> Result<DiffusionEncoder<CpuBackend>> {
    DiffusionEncoder::load(CpuBackend::new(settings.precision)?, pipeline, settings)
}

fn encode(
    pipeline: &Pipeline,
    settings: &DiffusionSettings,
    maps: &[DepthMap],
) -> Vec<LayeredFeatures> {
    load(pipeline, settings).unwrap().encode(maps).unwrap()
}

/// A slope with a step whose place depends on `variant`.
fn map(width: usize, height: usize, variant: usize) -> DepthMap {
    let intrinsics = Intrinsics { width, height, ..Intrinsics::indoor() };
    let depth = |pixel: usize| {
        let (u, v) = (pixel % width, pixel / width);
        let step = if u > (variant + 1) * width / 8 { 0.8 } else { 0.0 };
        1.0 + v as f32 / height as f32 + step
    };
    DepthMap::new(intrinsics, (0..width * height).map(depth).collect()).unwrap()
}

/// Of all values, relative to the largest.
fn difference(one: &FeatureMap, other: &FeatureMap) -> f32 {
    let largest = one.values().iter().fold(0.0_f32, |largest, value| largest.max(value.abs()));
    let pairs = one.values().iter().zip(other.values());
    pairs.fold(0.0_f32, |largest, (one, other)| largest.max((one - other).abs())) / largest
}

#[test]
fn maps_of_mixed_sizes_come_back_in_their_order() {
    let Some(pipeline) = pipeline() else { return };
    let settings = DiffusionSettings { shared_noise: true, ..DiffusionSettings::default() };
    let maps = [map(160, 120, 0), map(120, 120, 1), map(160, 120, 2), map(120, 120, 3)];
    let features = encode(&pipeline, &settings, &maps);
    let shapes = |layers: &LayeredFeatures| -> Vec<_> {
        layers.iter().map(|map| (map.channels(), map.height(), map.width())).collect()
    };
    // 512 x 704 and 512 x 512 pixels, an eighth of them in latents, and of these the layers 0, 3, 6.
    for (layers, width) in features.iter().zip([11, 8, 11, 8]) {
        let level = |halved: usize| (40, 8 << halved, width << halved);
        assert_eq!(shapes(layers), [level(0), level(1), level(2)]);
    }
    // Both maps of a view share their noise, so a map is encoded the same at both places.
    let swapped = encode(&pipeline, &settings, &[maps[1].clone(), maps[0].clone()]);
    assert_eq!(swapped, [features[1].clone(), features[0].clone()]);
    assert!(load(&pipeline, &settings).unwrap().encode(&[]).unwrap().is_empty());
}

/// What a cache does not know is encoded by itself, with the noise of its place, and in the order that is asked for.
#[test]
fn some_maps_are_encoded_as_among_all() {
    let Some(pipeline) = pipeline() else { return };
    let settings = DiffusionSettings { layers: vec![3], ..DiffusionSettings::default() };
    let maps = [map(64, 64, 0), map(64, 64, 1), map(64, 64, 2), map(64, 64, 3)];
    let all = encode(&pipeline, &settings, &maps);
    let encoder = load(&pipeline, &settings).unwrap();
    let some = encoder.encode_at(&[(3, &maps[3]), (1, &maps[1])]).unwrap();
    assert!(some == [all[3].clone(), all[1].clone()]);
}

#[test]
fn noise_depends_on_seed_view_and_cloud() {
    let Some(pipeline) = pipeline() else { return };
    let settings = DiffusionSettings { layers: vec![3], ..DiffusionSettings::default() };
    let maps = vec![map(64, 64, 0); 4];
    let own = encode(&pipeline, &settings, &maps);
    for (at, layers) in own.iter().enumerate() {
        assert!(own[..at].iter().all(|other| other != layers));
    }
    let shared = DiffusionSettings { shared_noise: true, ..settings.clone() };
    let shared = encode(&pipeline, &shared, &maps);
    assert_eq!((&shared[0], &shared[2]), (&own[0], &own[2]));
    assert_eq!((&shared[1], &shared[3]), (&own[0], &own[2]));
    let other = encode(&pipeline, &DiffusionSettings { seed: 1, ..settings }, &maps[..1]);
    assert!(own.iter().all(|own| *own != other[0]));
}

#[test]
fn progress_is_told_until_all_passes_are_done() {
    let Some(pipeline) = pipeline() else { return };
    let told = Arc::new(Mutex::new(Vec::new()));
    let listener = Arc::clone(&told);
    let settings = DiffusionSettings { steps: 2, layers: vec![0], ..Preset::Paper.settings() };
    let encoder = load(&pipeline, &settings)
        .unwrap()
        .with_progress(move |done, total| listener.lock().unwrap().push((done, total)));
    // Two steps with two branches each, then the features.
    assert_eq!(encoder.plan().passes(), 5);
    encoder.encode(&[map(64, 64, 0), map(64, 64, 1)]).unwrap();
    assert_eq!(*told.lock().unwrap(), [(4, 10), (8, 10), (10, 10)]);
}

#[test]
fn settings_change_the_features() {
    let Some(pipeline) = pipeline() else { return };
    let base = DiffusionSettings { steps: 1, layers: vec![0, 6], ..Preset::Paper.settings() };
    let maps = [map(64, 64, 0)];
    let encoded = |settings: &DiffusionSettings| encode(&pipeline, settings, &maps).remove(0);
    let features = encoded(&base);
    let differs = |settings: DiffusionSettings| {
        let other = encoded(&settings);
        assert!(difference(&features[0], &other[0]) > 1e-3, "{settings:?}");
    };
    differs(DiffusionSettings { prompt: Some("a photo of a cat".to_owned()), ..base.clone() });
    differs(DiffusionSettings { negative_prompt: String::new(), ..base.clone() });
    differs(DiffusionSettings { guidance: 2.0, ..base.clone() });
    differs(DiffusionSettings { guidance: 1.0, ..base.clone() });
    differs(DiffusionSettings { steps: 0, ..base.clone() });
    // The layers asked for are those of any other choice.
    let more = encoded(&DiffusionSettings { layers: (0..13).collect(), ..base.clone() });
    assert_eq!([&more[0], &more[6]], [&features[0], &features[1]]);
    let rough = encoded(&DiffusionSettings { precision: Precision::Bf16, ..base });
    let apart = difference(&features[1], &rough[1]);
    assert!(apart > 1e-4 && apart < 0.1, "{apart}");
}

#[test]
fn prompts_that_are_too_long_are_refused() {
    let Some(pipeline) = pipeline() else { return };
    let long = "word ".repeat(76);
    let default = DiffusionSettings::default;
    for settings in [
        DiffusionSettings { prompt: Some(long.clone()), ..default() },
        DiffusionSettings { negative_prompt: long, ..default() },
    ] {
        let message = load(&pipeline, &settings).map(drop).unwrap_err().to_string();
        assert!(message.contains("78 tokens"), "{message}");
    }
}

#[test]
fn parts_of_other_models_are_refused() {
    let Some(mut pipeline) = pipeline() else { return };
    pipeline.text_config.vocabulary = 1000;
    let refused = |pipeline: &Pipeline| {
        let loaded = load(pipeline, &DiffusionSettings::default());
        loaded.map(drop).unwrap_err().to_string()
    };
    assert!(refused(&pipeline).contains("1000 tokens"), "{}", refused(&pipeline));
    pipeline.text_config.vocabulary = 49408;
    pipeline.text_config.positions = 50;
    assert!(refused(&pipeline).contains("takes 50"), "{}", refused(&pipeline));
}

#[test]
fn the_cost_counts_passes_maps_and_weights() {
    let Some(pipeline) = pipeline() else { return };
    let cost = |preset: Preset, precision, maps| {
        let plan = Plan::new(&preset.settings(), &pipeline.scheduler).unwrap();
        let size = latent_size(&Intrinsics::indoor()).unwrap();
        Cost::estimate(&pipeline, &plan, precision, &vec![size; maps]).unwrap()
    };
    let single = cost(Preset::SingleStep, Precision::F32, 1);
    let size = latent_size(&Intrinsics::indoor()).unwrap();
    let pass = |extent| {
        unet_operations(&pipeline.unet_config, size, extent)
            + controlnet_operations(&pipeline.controlnet_config, size, extent)
    };
    let hint = hint_operations(&pipeline.controlnet_config, size);
    assert_eq!(single.operations, hint + pass(Extent::UpToLayer(6)));
    let paper = cost(Preset::Paper, Precision::F32, 1);
    let expected = hint + 34.0 * pass(Extent::Whole) + pass(Extent::UpToLayer(6));
    assert!((paper.operations / expected - 1.0).abs() < 1e-12);
    // The whole networks: of the size of their files but for the headers.
    let files = pipeline.unet.files().iter().chain(pipeline.controlnet.files());
    let bytes: u64 = files.map(|file| std::fs::metadata(file).unwrap().len()).sum();
    assert!((paper.weight_bytes as f64 / bytes as f64 - 1.0).abs() < 0.03);
    assert!(single.weight_bytes < paper.weight_bytes);
    let rough = cost(Preset::Paper, Precision::Bf16, 1);
    assert_eq!(2 * rough.weight_bytes, paper.weight_bytes);
    let four = cost(Preset::SingleStep, Precision::F32, 4);
    assert_eq!(four.operations, 4.0 * single.operations);
    assert!(four.other_bytes > single.other_bytes && paper.other_bytes > single.other_bytes);
    assert_eq!(cost(Preset::Paper, Precision::F32, 0).operations, 0.0);
}
