//! The U-Net and the `ControlNet` against recorded runs of small ones with random weights.

use rare_nets::checkpoint::Parameters;
use rare_nets::diffusion::{Control, ControlNet, ControlNetConfig, Extent, Unet, UnetConfig};
use rare_nets::engine::{Backend, CpuBackend, Precision, Processor, Shape};

use crate::reference_backend::{ReferenceBackend, Tensor};
use crate::shared::{self, Array, Golden, relative_difference};

/// Of the recordings, of the largest value of a tensor; single precision differs from double by 1.2e-6.
const TOLERANCE: f64 = 1e-5;

fn unet_config() -> UnetConfig {
    UnetConfig {
        in_channels: 4,
        block_out_channels: [16, 24, 40, 40],
        heads: 8,
        cross_attention_dim: 24,
        groups: 8,
    }
}

fn controlnet_config() -> ControlNetConfig {
    ControlNetConfig {
        unet: unet_config(),
        hint_channels: 3,
        hint_embedding_channels: [16, 32, 96, 256],
    }
}

fn parameters(network: &str) -> Option<Parameters> {
    let file = format!("golden/rare/tiny-pipeline/{network}/diffusion_pytorch_model.safetensors");
    Some(Parameters::open_safetensors(&[shared::path(&file)?]).unwrap())
}

/// Both networks on a backend.
struct Networks<B: Backend> {
    backend: B,
    unet: Unet<B>,
    controlnet: ControlNet<B>,
}

/// What both networks take.
struct Input<T> {
    latents: T,
    /// Embedded.
    hint: T,
    time: f32,
    /// Values of each prompt.
    texts: Vec<Vec<f32>>,
}

impl<B: Backend> Networks<B> {
    fn load(backend: B, extent: Extent) -> Option<Networks<B>> {
        let unet = Unet::load(&backend, &unet_config(), &parameters("unet")?, extent).unwrap();
        let controlnet =
            ControlNet::load(&backend, &controlnet_config(), &parameters("controlnet")?).unwrap();
        Some(Networks { backend, unet, controlnet })
    }

    fn input(
        &self,
        latents: &[&Array],
        hints: &[Array],
        time: f32,
        texts: &[&Array],
    ) -> Input<B::Tensor> {
        let hint = self.backend.upload(shape_of_hints(hints), &hint_values(hints)).unwrap();
        Input {
            latents: upload(&self.backend, latents),
            hint: self.controlnet.embed_hint(&self.backend, &hint).unwrap(),
            time,
            texts: texts.iter().map(|text| text.f32()).collect(),
        }
    }

    fn control(&self, input: &Input<B::Tensor>) -> Control<'_, B> {
        let Networks { backend, controlnet, .. } = self;
        let time = controlnet.timestep(backend, input.time).unwrap();
        let texts = input.texts.iter();
        let contexts: Vec<_> =
            texts.map(|text| controlnet.contexts(backend, text).unwrap()).collect();
        let contexts: Vec<_> = contexts.iter().collect();
        controlnet.run(backend, &input.latents, &input.hint, &time, &contexts).unwrap()
    }

    fn layers(
        &self,
        input: &Input<B::Tensor>,
        control: Option<Control<'_, B>>,
        last: usize,
    ) -> Vec<B::Tensor> {
        let output = self.run(input, control, Extent::UpToLayer(last));
        assert!(output.noise.is_none());
        assert_eq!(output.layers.len(), last + 1);
        output.layers
    }

    fn noise(&self, input: &Input<B::Tensor>, control: Option<Control<'_, B>>) -> Vec<f32> {
        let output = self.run(input, control, Extent::Whole);
        assert!(output.layers.is_empty());
        planes(&self.backend, &output.noise.unwrap())
    }

    fn run(
        &self,
        input: &Input<B::Tensor>,
        control: Option<Control<'_, B>>,
        extent: Extent,
    ) -> rare_nets::diffusion::Output<B::Tensor> {
        let Networks { backend, unet, .. } = self;
        let time = unet.timestep(backend, input.time).unwrap();
        let texts = input.texts.iter();
        let contexts: Vec<_> = texts.map(|text| unet.contexts(backend, text).unwrap()).collect();
        let contexts: Vec<_> = contexts.iter().collect();
        unet.run(backend, &input.latents, &time, &contexts, control, extent).unwrap()
    }

    /// Compares a tensor with a recorded one, image x channel x row x column.
    fn check(&self, name: &str, tensor: &B::Tensor, golden: &Array) {
        let Shape { batch, height, width, channels } = self.backend.shape(tensor);
        assert_eq!(golden.shape, [batch, channels, height, width], "{name}");
        check_values(name, &planes(&self.backend, tensor), &golden.values);
    }
}

fn check_values(name: &str, values: &[f32], golden: &[f64]) {
    let difference = relative_difference(values, golden);
    assert!(difference < TOLERANCE, "{name}: {difference:.1e}");
}

/// Several recorded images, each 1 x channel x row x column, as one tensor.
fn upload<B: Backend>(backend: &B, images: &[&Array]) -> B::Tensor {
    let values: Vec<f32> = images.iter().flat_map(|image| channels_last(image)).collect();
    let [1, channels, height, width] = images[0].shape[..] else { panic!("not one image") };
    backend.upload(Shape { batch: images.len(), height, width, channels }, &values).unwrap()
}

/// From channel, row, column to row, column, channel.
fn channels_last(image: &Array) -> Vec<f32> {
    let area: usize = image.shape[2..].iter().product();
    let pixels = 0..area;
    let values = pixels.flat_map(|pixel| image.values[pixel..].iter().step_by(area));
    values.map(|&value| value as f32).collect()
}

/// The values of a tensor in the order image, channel, row, column.
fn planes<B: Backend>(backend: &B, tensor: &B::Tensor) -> Vec<f32> {
    let Shape { batch, height, width, channels } = backend.shape(tensor);
    let size = height * width * channels;
    let values = backend.download(tensor).unwrap();
    assert_eq!(values.len(), batch * size);
    let images = values.chunks_exact(size);
    let planes = images.flat_map(|image| {
        (0..channels).flat_map(move |channel| image[channel..].iter().step_by(channels))
    });
    planes.copied().collect()
}

fn shape_of_hints(hints: &[Array]) -> Shape {
    let [height, width] = hints[0].shape[..] else { panic!("not a depth image") };
    Shape { batch: hints.len(), height, width, channels: 3 }
}

/// Depth images of 8 bits as three equal channels.
fn hint_values(hints: &[Array]) -> Vec<f32> {
    let values = hints.iter().flat_map(|hint| &hint.values);
    values.flat_map(|&value| [(value / 255.0) as f32; 3]).collect()
}

/// One slice of an array along its first axis.
fn slice(array: &Array, index: usize) -> Array {
    let shape = array.shape[1..].to_vec();
    let size = shape.iter().product::<usize>();
    Array { shape, values: array.values[index * size..][..size].to_vec() }
}

/// Runs the recorded input of one size.
fn forward_input<B: Backend>(networks: &Networks<B>, size: &str) -> Option<Input<B::Tensor>> {
    let mut golden = Golden::open(&format!("rare/s5_forward_{size}_io.npz"))?;
    let (latents, context) = (golden.array("latents"), golden.array("context"));
    let time = golden.array("timestep").values[0] as f32;
    Some(networks.input(&[&latents], &[golden.array("hint_u8")], time, &[&context]))
}

fn follows_the_recording<B: Backend>(backend: B, size: &str) {
    let Some(networks) = Networks::load(backend, Extent::Whole) else { return };
    let Some(input) = forward_input(&networks, size) else { return };
    let open = |part: &str| Golden::open(&format!("rare/s5_forward_{size}_{part}.npz")).unwrap();

    let mut golden = open("residuals");
    let residuals = networks.control(&input).residuals(&networks.backend).unwrap();
    let names = (0..12).map(|index| format!("down_{index}")).chain(["mid".to_owned()]);
    for (name, residual) in names.zip(&residuals) {
        networks.check(&name, residual, &golden.array(&name));
    }
    assert_eq!(residuals.len(), 13);

    let mut golden = open("features");
    let layers = networks.layers(&input, Some(networks.control(&input)), 12);
    for (index, layer) in layers.iter().enumerate() {
        let name = format!("layer_{index}");
        networks.check(&name, layer, &golden.array(&name));
    }
    let alone = networks.layers(&input, None, 0);
    networks.check("middle alone", &alone[0], &golden.array("layer_0_without_mid_residual"));

    let mut golden = open("io");
    let noise = networks.noise(&input, Some(networks.control(&input)));
    check_values("noise", &noise, &golden.array("eps").values);
    let noise = networks.noise(&input, None);
    check_values("noise alone", &noise, &golden.array("eps_without_control").values);
}

#[test]
fn the_reference_backend_follows_the_recording() {
    follows_the_recording(ReferenceBackend::default(), "16x24");
}

/// The two depth images of the recipe, each with the prompt and the negative prompt, as one batch.
fn a_batch_gives_the_recorded_noise<B: Backend>(backend: B) {
    let Some(networks) = Networks::load(backend, Extent::Whole) else { return };
    let Some(mut a) = Golden::open("rare/s5_recipe_a.npz") else { return };
    let mut b = Golden::open("rare/s5_recipe_b.npz").unwrap();
    let step = 10;
    let latents = [slice(&a.array("x"), step), slice(&b.array("x"), step)];
    let input = networks.input(
        &[&latents[0], &latents[1], &latents[0], &latents[1]],
        &[a.array("hint_u8"), b.array("hint_u8")],
        (951 - 50 * step) as f32,
        &[&a.array("cond"), &a.array("uncond")],
    );
    let noise = networks.noise(&input, Some(networks.control(&input)));
    let mut noises = noise.chunks_exact(noise.len() / 4);
    for name in ["eps_cond", "eps_uncond"] {
        for golden in [&mut a, &mut b] {
            let golden = slice(&golden.array(name), step);
            check_values(name, noises.next().unwrap(), &golden.values);
        }
    }
}

#[test]
fn a_batch_gives_the_recorded_noise_on_the_reference_backend() {
    a_batch_gives_the_recorded_noise(ReferenceBackend::default());
}

/// The last pass of the recipe, by a U-Net of which no more is loaded.
fn part_of_the_network_gives_the_recorded_layers<B: Backend>(backend: B) {
    let Some(networks) = Networks::load(backend, Extent::UpToLayer(6)) else { return };
    let Some(mut golden) = Golden::open("rare/s5_recipe_b.npz") else { return };
    let latents = slice(&golden.array("x"), 17);
    let hint = golden.array("hint_u8");
    let input = networks.input(&[&latents], &[hint], 150.0, &[&golden.array("cond")]);
    let layers = networks.layers(&input, Some(networks.control(&input)), 6);
    for index in [0, 3, 4, 6] {
        let name = format!("layer_{index}");
        networks.check(&name, &layers[index], &golden.array(&name));
    }
}

#[test]
fn part_of_the_network_gives_the_recorded_layers_on_the_reference_backend() {
    part_of_the_network_gives_the_recorded_layers(ReferenceBackend::default());
}

#[test]
fn a_run_goes_through_the_recorded_states() {
    let Some(mut golden) = Golden::open("rare/s5_forward_16x24_trace.npz") else { return };
    let networks = Networks::load(ReferenceBackend::default(), Extent::Whole).unwrap();
    let input = forward_input(&networks, "16x24").unwrap();
    networks.backend.results.lock().unwrap().clear();
    networks.noise(&input, None);
    let results = networks.backend.results.lock().unwrap();
    for (name, states) in trace(&mut golden) {
        let nearest = results.iter().map(|result| distance(result, &states));
        let nearest = nearest.fold(f64::INFINITY, f64::min);
        assert!(nearest < TOLERANCE, "{name}: {nearest:.1e}");
    }
}

/// The recorded states that exist as results of an operation: those at the end of a layer, and sums of what is fused.
fn trace(golden: &mut Golden) -> Vec<(String, Vec<f64>)> {
    const FUSED: [&str; 6] = ["norm", "norm1", "norm2", "conv1", "ff", "conv_norm_out"];
    let last = |name: &str| name.rsplit('.').next().unwrap().to_owned();
    let mut states = Vec::new();
    for name in golden.names() {
        let fused = FUSED.contains(&&last(&name)[..]) || last(&name).starts_with("attn");
        if !fused {
            states.push((name.clone(), pixels(&golden.array(&name))));
        }
    }
    assert_eq!(states.len(), 19);
    let resnet = "down_blocks.0.resnets.0";
    let offset = pixels(&golden.array(&format!("{resnet}.time_emb_proj")));
    let mut inner = pixels(&golden.array(&format!("{resnet}.conv1")));
    add(&mut inner, &offset);
    states.push((format!("{resnet}, first half"), inner));
    let transformer = "down_blocks.0.attentions.0";
    let mut tokens = pixels(&golden.array(&format!("{transformer}.proj_in")));
    for part in ["attn1", "attn2", "ff"] {
        let name = format!("{transformer}.transformer_blocks.0.{part}");
        add(&mut tokens, &pixels(&golden.array(&name)));
        states.push((name, tokens.clone()));
    }
    states
}

/// The values pixel by pixel; a sequence of tokens is recorded so.
fn pixels(array: &Array) -> Vec<f64> {
    if array.shape.len() < 4 {
        return array.values.clone();
    }
    channels_last(array).into_iter().map(f64::from).collect()
}

/// Adds `added`, repeated.
fn add(values: &mut [f64], added: &[f64]) {
    for (value, added) in values.iter_mut().zip(added.iter().cycle()) {
        *value += added;
    }
}

fn distance(result: &Tensor, states: &[f64]) -> f64 {
    if result.values.len() != states.len() {
        return f64::INFINITY;
    }
    relative_difference(&result.values, states)
}

fn on_every_processor(test: impl Fn(CpuBackend)) {
    for processor in Processor::available() {
        test(CpuBackend::on(processor, Precision::F32));
    }
}

#[test]
fn every_processor_follows_the_recording() {
    on_every_processor(|cpu| follows_the_recording(cpu, "16x24"));
}

#[test]
fn the_best_processor_follows_the_large_recording() {
    follows_the_recording(CpuBackend::new(Precision::F32).unwrap(), "64x88");
}

#[test]
fn a_batch_gives_the_recorded_noise_on_every_processor() {
    on_every_processor(a_batch_gives_the_recorded_noise);
}

#[test]
fn part_of_the_network_gives_the_recorded_layers_on_every_processor() {
    on_every_processor(part_of_the_network_gives_the_recorded_layers);
}
