//! The text encoder against recorded states of a small one with random weights.

use rare_nets::checkpoint::Parameters;
use rare_nets::diffusion::{TextConfig, TextEncoder};
use rare_nets::engine::{Backend, CpuBackend, Precision, Processor};

use crate::reference_backend::ReferenceBackend;
use crate::shared::{self, Array, Golden};

/// Of the recording, absolute.
const TOLERANCE: f64 = 1e-5;

const WIDTH: usize = 24;

fn config() -> TextConfig {
    TextConfig {
        hidden_size: WIDTH,
        intermediate_size: 96,
        heads: 4,
        layers: 3,
        vocabulary: 49408,
        positions: 77,
        epsilon: 1e-5,
    }
}

fn load<B: Backend>(backend: &B, config: &TextConfig) -> Option<rare::Result<TextEncoder<B>>> {
    let file = shared::path("golden/rare/tiny-pipeline/text_encoder/model.safetensors")?;
    let parameters = Parameters::open_safetensors(&[file]).unwrap();
    Some(TextEncoder::load(backend, config, &parameters))
}

fn prompt(golden: &mut Golden, index: usize) -> Vec<u32> {
    let tokens = golden.array("input_ids").usize();
    tokens[index * 77..][..77].iter().map(|&token| token as u32).collect()
}

fn difference(values: &[f32], golden: &[f64]) -> f64 {
    assert_eq!(values.len(), golden.len());
    assert!(values.iter().all(|value| value.is_finite()));
    let differences = values.iter().zip(golden).map(|(value, golden)| f64::from(*value) - golden);
    differences.fold(0.0, |largest, difference| largest.max(difference.abs()))
}

/// Encodes the five recorded prompts.
fn follows_the_recording<B: Backend>(backend: &B) {
    let Some(mut golden) = Golden::open("rare/s5_text.npz") else { return };
    let Some(encoder) = load(backend, &config()) else { return };
    let encoder = encoder.unwrap();
    let states = golden.array("last_hidden_state");
    assert_eq!(states.shape, [5, 77, WIDTH]);
    for (index, states) in states.values.chunks_exact(77 * WIDTH).enumerate() {
        let encoded = encoder.encode(backend, &prompt(&mut golden, index)).unwrap();
        let difference = difference(&encoded, states);
        assert!(difference < TOLERANCE, "prompt {index}: {difference:.1e}");
    }
}

#[test]
fn the_reference_backend_follows_the_recorded_text() {
    follows_the_recording(&ReferenceBackend::default());
}

#[test]
fn every_processor_follows_the_recorded_text() {
    for processor in Processor::available() {
        follows_the_recording(&CpuBackend::on(processor, Precision::F32));
    }
}

#[test]
fn the_first_prompt_goes_through_the_recorded_states() {
    let Some(mut golden) = Golden::open("rare/s5_text.npz") else { return };
    let backend = ReferenceBackend::default();
    let Some(encoder) = load(&backend, &config()) else { return };
    encoder.unwrap().encode(&backend, &prompt(&mut golden, 0)).unwrap();
    let results = backend.results.into_inner().unwrap();
    let mut trace = |name: &str| golden.array(&format!("trace_{name}"));
    let attended = sum(&trace("embeddings"), &trace("encoder.layers.0.self_attn"));
    let first = sum(&attended, &trace("encoder.layers.0.mlp"));
    // Four results per layer: projections, attention, and the two of the feed-forward layer.
    for (name, state, result) in [
        ("attention", attended, 1),
        ("feed-forward", first, 3),
        ("layer 0", trace("encoder.layers.0"), 3),
        ("layer 2", trace("encoder.layers.2"), 11),
    ] {
        let difference = difference(&results[result].values, &state.values);
        assert!(difference < TOLERANCE, "{name}: {difference:.1e}");
    }
}

fn sum(first: &Array, second: &Array) -> Array {
    let values = first.values.iter().zip(&second.values).map(|(first, second)| first + second);
    Array { shape: first.shape.clone(), values: values.collect() }
}

#[test]
fn prompts_that_do_not_fit_are_refused() {
    let backend = ReferenceBackend::default();
    let Some(encoder) = load(&backend, &config()) else { return };
    let encoder = encoder.unwrap();
    let message = |tokens: &[u32]| encoder.encode(&backend, tokens).unwrap_err().to_string();
    assert!(message(&[0; 76]).contains("76 tokens"));
    assert!(message(&[49408; 77]).contains("token 49408"));
}

#[test]
fn another_configuration_is_refused() {
    let backend = ReferenceBackend::default();
    let message = |config: &TextConfig| Some(load(&backend, config)?.err().unwrap().to_string());
    let Some(deeper) = message(&TextConfig { layers: 4, ..config() }) else { return };
    assert!(deeper.contains("model.safetensors"), "{deeper}");
    assert!(deeper.contains("16 tensors missing (text_model.encoder.layers.3."), "{deeper}");
    let shallower = message(&TextConfig { layers: 2, ..config() }).unwrap();
    assert!(shallower.contains("16 tensors unknown"), "{shallower}");
    let wider = message(&TextConfig { intermediate_size: 97, ..config() }).unwrap();
    assert!(wider.contains("9 tensors of another shape"), "{wider}");
    assert!(wider.contains("fc1.bias [96], expected [97]"), "{wider}");
    let heads = message(&TextConfig { heads: 5, ..config() }).unwrap();
    assert!(heads.contains("24 wide with 5 heads"), "{heads}");
}
