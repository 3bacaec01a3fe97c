//! The shapes through the networks, and what is loaded and computed of them, without any arithmetic.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::Write;
use std::path::Path;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use rare::Result;
use rare_nets::Parameter;
use rare_nets::checkpoint::Parameters;
use rare_nets::checkpoint::{Differences, Layout, Misshapen, compare};
use rare_nets::diffusion::{
    Control, ControlNet, ControlNetConfig, Extent, LAYERS, Unet, UnetConfig, controlnet_layout,
    unet_layout,
};
use rare_nets::engine::{Arrangement, Backend, Convolution, Kernel, Prologue, Shape};
use serde_json::{Value, json};

use crate::shared;

/// The published networks have ten times the channels.
const REDUCTION: u64 = 10;

fn config() -> ControlNetConfig {
    let unet = UnetConfig {
        in_channels: 4,
        block_out_channels: [32, 64, 128, 128],
        heads: 8,
        cross_attention_dim: 24,
        groups: 32,
    };
    ControlNetConfig { unet, hint_channels: 3, hint_embedding_channels: [16, 32, 96, 256] }
}

/// Computes shapes, and counts.
#[derive(Default)]
struct ShapeBackend {
    packed: AtomicUsize,
    convolved: AtomicUsize,
    /// How often each kind of normalisation ran, by its name and epsilon.
    normalized: Mutex<BTreeMap<String, usize>>,
}

/// Inputs and outputs of a kernel.
struct Sizes {
    inputs: usize,
    outputs: usize,
}

impl Backend for ShapeBackend {
    type Tensor = Shape;
    type Weight = Sizes;

    fn pack(&self, kernel: &Kernel<'_>) -> Result<Sizes> {
        self.packed.fetch_add(1, Ordering::Relaxed);
        let outputs = |part: &Parameter| part.shape[0];
        let outputs: usize = kernel.parts.iter().map(outputs).sum();
        let halves = if kernel.arrangement == Arrangement::Gated { 2 } else { 1 };
        Ok(Sizes { inputs: kernel.parts[0].shape[1], outputs: outputs / halves })
    }

    fn upload(&self, shape: Shape, values: &[f32]) -> Result<Shape> {
        assert_eq!(shape.values(), values.len());
        Ok(shape)
    }

    fn download(&self, tensor: &Shape) -> Result<Vec<f32>> {
        Ok(vec![0.0; tensor.values()])
    }

    fn shape(&self, tensor: &Shape) -> Shape {
        *tensor
    }

    fn convolve(
        &self,
        input: &Shape,
        weight: &Sizes,
        fused: &Convolution<'_, Shape>,
    ) -> Result<Shape> {
        self.convolved.fetch_add(1, Ordering::Relaxed);
        assert_eq!(input.channels, weight.inputs);
        if let Some(name) = normalization(&fused.prologue) {
            *self.normalized.lock().unwrap().entry(name).or_default() += 1;
        }
        let size =
            |length: usize| (length * if fused.upsample { 2 } else { 1 }).div_ceil(fused.stride);
        let (height, width) = (size(input.height), size(input.width));
        let result = Shape { batch: input.batch, height, width, channels: weight.outputs };
        if let Some(residual) = fused.residual {
            assert_eq!(*residual, Shape { batch: residual.batch, ..result });
        }
        Ok(result)
    }

    fn self_attention(&self, joint: &Shape, heads: usize, _: bool) -> Result<Shape> {
        assert_eq!(joint.channels % (3 * heads), 0);
        Ok(Shape { channels: joint.channels / 3, ..*joint })
    }

    fn cross_attention(&self, queries: &Shape, contexts: &[&Shape], _: usize) -> Result<Shape> {
        assert!(contexts.iter().all(|context| context.channels == 2 * queries.channels));
        Ok(*queries)
    }

    fn concatenate(&self, first: &Shape, second: &Shape) -> Result<Shape> {
        let joint = Shape { channels: first.channels + second.channels, ..*first };
        assert_eq!(joint, Shape { channels: joint.channels, ..*second });
        Ok(joint)
    }
}

fn normalization(prologue: &Prologue<'_>) -> Option<String> {
    match prologue {
        Prologue::None | Prologue::Silu => None,
        Prologue::GroupNormalization { groups, epsilon, silu, .. } => {
            Some(format!("{groups} groups, {epsilon:e}, silu {silu}"))
        }
        Prologue::LayerNormalization { epsilon, .. } => Some(format!("layer, {epsilon:e}")),
    }
}

/// Writes a file of zeros with the tensors of a layout, and opens it.
fn zeros(folder: &Path, layout: &Layout) -> Parameters {
    let path = folder.join("zeros.safetensors");
    let mut header = BTreeMap::new();
    let mut length = 0;
    for (name, shape) in layout {
        let end = length + 2 * shape.iter().product::<usize>();
        let entry = json!({"dtype": "F16", "shape": shape, "data_offsets": [length, end]});
        header.insert(name, entry);
        length = end;
    }
    let header = serde_json::to_vec(&header).unwrap();
    let mut file = File::create(&path).unwrap();
    file.write_all(&(header.len() as u64).to_le_bytes()).unwrap();
    file.write_all(&header).unwrap();
    file.set_len((8 + header.len() + length) as u64).unwrap();
    Parameters::open_safetensors(&[path]).unwrap()
}

fn load_unet(backend: &ShapeBackend, extent: Extent) -> Unet<ShapeBackend> {
    let folder = tempfile::tempdir().unwrap();
    let parameters = zeros(folder.path(), &unet_layout(&config().unet));
    Unet::load(backend, &config().unet, &parameters, extent).unwrap()
}

fn load_controlnet(backend: &ShapeBackend) -> ControlNet<ShapeBackend> {
    let folder = tempfile::tempdir().unwrap();
    let parameters = zeros(folder.path(), &controlnet_layout(&config()));
    ControlNet::load(backend, &config(), &parameters).unwrap()
}

fn latents(batch: usize, height: usize, width: usize) -> Shape {
    Shape { batch, height, width, channels: 4 }
}

fn run_controlnet<'a>(
    backend: &ShapeBackend,
    network: &'a ControlNet<ShapeBackend>,
    latents: Shape,
) -> Control<'a, ShapeBackend> {
    let Shape { height, width, .. } = latents;
    let hint = Shape { batch: 1, height: 8 * height, width: 8 * width, channels: 3 };
    let hint = network.embed_hint(backend, &hint).unwrap();
    let time = network.timestep(backend, 150.0).unwrap();
    let context = network.contexts(backend, &[0.0; 77 * 24]).unwrap();
    network.run(backend, &latents, &hint, &time, &[&context]).unwrap()
}

fn run_unet(
    backend: &ShapeBackend,
    network: &Unet<ShapeBackend>,
    latents: Shape,
    control: Option<Control<'_, ShapeBackend>>,
    extent: Extent,
) -> Result<rare_nets::diffusion::Output<Shape>> {
    let time = network.timestep(backend, 150.0).unwrap();
    let context = network.contexts(backend, &[0.0; 77 * 24]).unwrap();
    network.run(backend, &latents, &time, &[&context], control, extent)
}

/// Compares shapes with recorded ones, channels x height x width.
fn check(shapes: &[Shape], golden: &Value) {
    let golden: Vec<[u64; 3]> = serde_json::from_value(golden.clone()).unwrap();
    let shapes = shapes.iter().map(|shape| {
        let Shape { height, width, channels, .. } = *shape;
        [REDUCTION * channels as u64, height as u64, width as u64]
    });
    assert_eq!(shapes.collect::<Vec<[u64; 3]>>(), golden);
}

#[test]
fn layers_and_residuals_have_the_published_shapes() {
    let Some(path) = shared::path("golden/rare/s5_sd15_shapes.json") else { return };
    let golden: Value = serde_json::from_slice(&fs::read(path).unwrap()).unwrap();
    let backend = ShapeBackend::default();
    let unet = load_unet(&backend, Extent::UpToLayer(12));
    let controlnet = load_controlnet(&backend);
    for (name, width) in [("3DMatch 512x704", 88), ("KITTI 512x1280", 160)] {
        let latents = latents(2, 64, width);
        let control = || run_controlnet(&backend, &controlnet, latents);
        let extent = Extent::UpToLayer(12);
        let output = run_unet(&backend, &unet, latents, Some(control()), extent).unwrap();
        check(&output.layers, &golden[name]["layers"]);
        check(&control().residuals(&backend).unwrap(), &golden[name]["control_residuals"]);
    }
}

#[test]
fn normalizations_have_the_published_epsilons() {
    // They are too small to show in the recordings.
    let backend = ShapeBackend::default();
    let unet = load_unet(&backend, Extent::Whole);
    run_unet(&backend, &unet, latents(1, 8, 8), None, Extent::Whole).unwrap();
    let normalized = backend.normalized.into_inner().unwrap();
    let (residual, transformer) = ("32 groups, 1e-5, silu true", "32 groups, 1e-6, silu false");
    let expected = [(residual, 2 * 22 + 1), (transformer, 16), ("layer, 1e-5", 3 * 16)];
    let expected = expected.map(|(name, count)| (name.to_owned(), count));
    assert_eq!(normalized, BTreeMap::from(expected));
}

#[test]
fn no_more_is_loaded_and_computed_than_the_last_layer_needs() {
    let loaded = |extent| {
        let backend = ShapeBackend::default();
        load_unet(&backend, extent);
        backend.packed.into_inner()
    };
    let backend = ShapeBackend::default();
    let unet = load_unet(&backend, Extent::Whole);
    let controlnet = load_controlnet(&backend);
    let computed = |extent| {
        let control = run_controlnet(&backend, &controlnet, latents(1, 8, 8));
        let before = backend.convolved.load(Ordering::Relaxed);
        run_unet(&backend, &unet, latents(1, 8, 8), Some(control), extent).unwrap();
        backend.convolved.load(Ordering::Relaxed) - before
    };
    let extents = (0..LAYERS).map(Extent::UpToLayer).chain([Extent::Whole]);
    let counts: Vec<_> = extents.map(|extent| (loaded(extent), computed(extent))).collect();
    for pair in counts.windows(2) {
        let ((loaded, computed), (more_loaded, more_computed)) = (pair[0], pair[1]);
        assert!(loaded < more_loaded && computed < more_computed, "{counts:?}");
    }
}

#[test]
fn what_cannot_be_run_is_refused() {
    let backend = ShapeBackend::default();
    let unet = load_unet(&backend, Extent::UpToLayer(3));
    let message = |latents, extent| {
        run_unet(&backend, &unet, latents, None, extent).err().unwrap().to_string()
    };
    assert!(message(latents(1, 8, 8), Extent::Whole).contains("UpToLayer(3)"));
    assert!(message(latents(1, 8, 8), Extent::UpToLayer(4)).contains("UpToLayer(4)"));
    for latents in [latents(1, 12, 8), latents(1, 8, 12), latents(0, 8, 8), latents(1, 0, 8)] {
        assert!(message(latents, Extent::UpToLayer(0)).contains("multiples of 8"));
    }
    let three = Shape { channels: 3, ..latents(1, 8, 8) };
    assert!(message(three, Extent::UpToLayer(0)).contains("channels: 3"));
}

#[test]
fn conditions_of_another_network_are_refused() {
    let backend = ShapeBackend::default();
    let unet = load_unet(&backend, Extent::Whole);
    let controlnet = load_controlnet(&backend);
    let text = [0.0; 77 * 24];
    let time = unet.timestep(&backend, 1.0).unwrap();
    let context = unet.contexts(&backend, &text).unwrap();
    let other_time = controlnet.timestep(&backend, 1.0).unwrap();
    let other_context = controlnet.contexts(&backend, &text).unwrap();
    for (time, context) in [(&other_time, &context), (&time, &other_context)] {
        let latents = latents(1, 8, 8);
        let refused = unet.run(&backend, &latents, time, &[context], None, Extent::Whole);
        assert!(refused.err().unwrap().to_string().contains("a smaller network"));
    }
}

#[test]
fn depth_images_that_do_not_fit_are_refused() {
    let backend = ShapeBackend::default();
    let controlnet = load_controlnet(&backend);
    for (height, channels) in [(65, 3), (0, 3), (64, 1)] {
        let hint = Shape { batch: 1, height, width: 64, channels };
        let message = controlnet.embed_hint(&backend, &hint).unwrap_err().to_string();
        assert!(message.contains("multiples of 8"), "{message}");
    }
}

#[test]
fn configurations_that_no_network_has_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let parameters = zeros(folder.path(), &Layout::new());
    let sd = config().unet;
    for (config, what) in [
        (UnetConfig { groups: 48, ..sd.clone() }, "32 channels in 48 groups"),
        (UnetConfig { groups: 0, ..sd.clone() }, "in 0 groups"),
        (UnetConfig { heads: 5, ..sd.clone() }, "in 5 heads"),
        (UnetConfig { heads: 0, ..sd.clone() }, "in 0 heads"),
        (UnetConfig { in_channels: 0, ..sd.clone() }, "0 latent channels"),
        (UnetConfig { cross_attention_dim: 0, ..sd.clone() }, "text of width 0"),
        (UnetConfig { block_out_channels: [0; 4], ..sd.clone() }, "a level of 0 channels"),
    ] {
        let refused = Unet::load(&ShapeBackend::default(), &config, &parameters, Extent::Whole);
        let message = refused.err().unwrap().to_string();
        assert!(message.contains(what), "{message}");
    }
    let backend = ShapeBackend::default();
    let beyond = Unet::load(&backend, &sd, &parameters, Extent::UpToLayer(13));
    assert!(beyond.err().unwrap().to_string().contains("no layer 13"));
}

#[test]
fn differences_from_the_layout_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let layout = unet_layout(&config().unet);
    let mut other = layout.clone();
    other.remove("conv_out.bias");
    other.insert("class_embedding.weight".to_owned(), vec![2, 2]);
    other.insert("conv_in.weight".to_owned(), vec![32, 9, 3, 3]);
    other.insert("text_model.embeddings.position_ids".to_owned(), vec![1, 77]);
    let parameters = zeros(folder.path(), &other);
    let expected = Differences {
        missing: vec!["conv_out.bias".to_owned()],
        surplus: vec!["class_embedding.weight".to_owned()],
        misshapen: vec![Misshapen {
            name: "conv_in.weight".to_owned(),
            expected: vec![32, 4, 3, 3],
            found: vec![32, 9, 3, 3],
        }],
    };
    assert_eq!(compare(&layout, &parameters), expected);
    let refused = Unet::load(&ShapeBackend::default(), &config().unet, &parameters, Extent::Whole);
    let message = refused.err().unwrap().to_string();
    for part in [
        "zeros.safetensors: not the weights of the U-Net",
        "1 tensor missing (conv_out.bias)",
        "1 tensor unknown (class_embedding.weight)",
        "1 tensor of another shape (conv_in.weight [32, 9, 3, 3], expected [32, 4, 3, 3])",
    ] {
        assert!(message.contains(part), "{message}");
    }
}
