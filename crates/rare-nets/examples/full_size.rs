//! The networks at full size against recorded features: `full_size FOLDER [f32|bf16] [RUNS] [MAPS]`.
//!
//! FOLDER holds `unet/` and `controlnet/` in the diffusers layout and `golden.safetensors` with the input (`x`, `ctx`,
//! `hint`; timestep 150) and what another implementation made of it (`layer_0`, `layer_3`, `layer_6`). Prints the
//! relative difference of each layer (L2), then the time of loading and of runs to layer 6 with the same image MAPS
//! times in a batch, wall and CPU (Linux).
#![expect(clippy::print_stdout, reason = "the result")]

use std::error::Error;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::Instant;

use rare_nets::checkpoint::Parameters;
use rare_nets::diffusion::{ControlNet, ControlNetConfig, Extent, Unet, UnetConfig};
use rare_nets::engine::{Backend, CpuBackend, Precision, Shape, Tensor};

const LAYER: usize = 6;

type Outcome<T> = Result<T, Box<dyn Error>>;

fn main() -> Outcome<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let folder = PathBuf::from(arguments.first().ok_or("which folder?")?);
    let precision = match arguments.get(1).map(String::as_str) {
        Some("bf16") => Precision::Bf16,
        _ => Precision::F32,
    };
    let runs: usize = arguments.get(2).map_or(Ok(3), |text| text.parse())?;
    let maps: usize = arguments.get(3).map_or(Ok(1), |text| text.parse())?;
    let mut clock = Clock::start()?;
    let networks = Networks::load(&folder, precision)?;
    println!("{} {precision:?}, load: {}", networks.cpu.processor().name(), clock.lap()?);
    let golden = Parameters::open_safetensors(&[folder.join("golden.safetensors")])?;
    let input = Input::read(&networks, &golden, maps)?;
    for run in 0..=runs {
        clock.lap()?;
        let layers = networks.run(&input)?;
        let time = clock.lap()?;
        if run == 0 {
            compare(&networks.cpu, &layers, &golden)?;
        } else {
            println!("run {run}, {maps} maps: {time}");
        }
    }
    let status = fs::read_to_string("/proc/self/status")?;
    println!("{}", status.lines().find(|line| line.starts_with("VmHWM")).unwrap_or_default());
    Ok(())
}

struct Networks {
    cpu: CpuBackend,
    unet: Unet<CpuBackend>,
    controlnet: ControlNet<CpuBackend>,
}

/// What one run needs.
struct Input {
    latents: Tensor,
    hint: Tensor,
    text: Vec<f32>,
}

impl Networks {
    fn load(folder: &Path, precision: Precision) -> Outcome<Networks> {
        let cpu = CpuBackend::new(precision)?;
        let open = |network: &str| {
            let file = folder.join(network).join("diffusion_pytorch_model.safetensors");
            Parameters::open_safetensors(&[file])
        };
        let parameters = open("unet")?;
        let config = config(&parameters)?;
        let unet = Unet::load(&cpu, &config, &parameters, Extent::UpToLayer(LAYER))?;
        let config = ControlNetConfig {
            unet: config,
            hint_channels: 3,
            hint_embedding_channels: [16, 32, 96, 256],
        };
        let controlnet = ControlNet::load(&cpu, &config, &open("controlnet")?)?;
        Ok(Networks { cpu, unet, controlnet })
    }

    fn run(&self, input: &Input) -> Outcome<Vec<Tensor>> {
        let Networks { cpu, unet, controlnet } = self;
        let hint = controlnet.embed_hint(cpu, &input.hint)?;
        let time = controlnet.timestep(cpu, 150.0)?;
        let context = controlnet.contexts(cpu, &input.text)?;
        let control = controlnet.run(cpu, &input.latents, &hint, &time, &[&context])?;
        let time = unet.timestep(cpu, 150.0)?;
        let context = unet.contexts(cpu, &input.text)?;
        let extent = Extent::UpToLayer(LAYER);
        Ok(unet.run(cpu, &input.latents, &time, &[&context], Some(control), extent)?.layers)
    }
}

/// From the shapes of the weights.
fn config(parameters: &Parameters) -> Outcome<UnetConfig> {
    let width = |name: &str, axis: usize| {
        let shape = parameters.shape(name).ok_or_else(|| format!("no tensor {name}"))?;
        shape.get(axis).copied().ok_or_else(|| format!("{name} has shape {shape:?}"))
    };
    let channels = |level: usize| width(&format!("down_blocks.{level}.resnets.1.conv2.bias"), 0);
    let text = "down_blocks.0.attentions.0.transformer_blocks.0.attn2.to_k.weight";
    Ok(UnetConfig {
        in_channels: width("conv_in.weight", 1)?,
        block_out_channels: [channels(0)?, channels(1)?, channels(2)?, channels(3)?],
        heads: 8,
        cross_attention_dim: width(text, 1)?,
        groups: 32,
    })
}

impl Input {
    fn read(networks: &Networks, golden: &Parameters, maps: usize) -> Outcome<Input> {
        let (shape, text) = array(golden, "ctx")?;
        let text = text[..text.len() / shape[0]].to_vec();
        let repeated = |name: &str| -> Outcome<Tensor> {
            let (shape, values) = channels_last(golden, name)?;
            let shape = Shape { batch: maps, ..shape };
            Ok(networks.cpu.upload(shape, &values.repeat(maps))?)
        };
        Ok(Input { latents: repeated("x")?, hint: repeated("hint")?, text })
    }
}

fn array(golden: &Parameters, name: &str) -> Outcome<(Vec<usize>, Vec<f32>)> {
    let shape = golden.shape(name).ok_or_else(|| format!("no tensor {name}"))?.to_vec();
    let values = golden.read(name, &shape)?.to_f32();
    Ok((shape, values))
}

/// A recorded image, pixel by pixel.
fn channels_last(golden: &Parameters, name: &str) -> Outcome<(Shape, Vec<f32>)> {
    let (shape, values) = array(golden, name)?;
    let [batch, channels, height, width] = shape[..] else {
        return Err(format!("{name} has shape {shape:?}").into());
    };
    let pixels = height * width;
    let at = |index: usize| values[index % channels * pixels + index / channels];
    let shape = Shape { batch, height, width, channels };
    Ok((shape, (0..channels * pixels).map(at).collect()))
}

fn compare(cpu: &CpuBackend, layers: &[Tensor], golden: &Parameters) -> Outcome<()> {
    for (index, layer) in layers.iter().enumerate() {
        let name = format!("layer_{index}");
        if golden.shape(&name).is_none() {
            continue;
        }
        let (_, expected) = channels_last(golden, &name)?;
        let values = cpu.download(layer)?;
        let square = |value: f64| value * value;
        let difference: f64 =
            values.iter().zip(&expected).map(|(a, b)| square(f64::from(a - b))).sum();
        let norm: f64 = expected.iter().map(|&value| square(f64::from(value))).sum();
        println!("{name}: relative difference {:.2e}", (difference / norm).sqrt());
    }
    Ok(())
}

/// Wall and CPU time since the last lap.
struct Clock {
    wall: Instant,
    cpu: f64,
}

impl Clock {
    fn start() -> Outcome<Clock> {
        Ok(Clock { wall: Instant::now(), cpu: cpu_seconds()? })
    }

    fn lap(&mut self) -> Outcome<String> {
        let now = Clock::start()?;
        let (wall, cpu) = (now.wall.duration_since(self.wall).as_secs_f64(), now.cpu - self.cpu);
        *self = now;
        Ok(format!("wall {wall:.2} s, CPU {cpu:.2} s"))
    }
}

/// CPU time of all threads.
fn cpu_seconds() -> Outcome<f64> {
    let mut nanoseconds = 0;
    for task in fs::read_dir("/proc/self/task")? {
        let text = fs::read_to_string(task?.path().join("schedstat"))?;
        nanoseconds += text.split(' ').next().unwrap_or("0").parse::<u64>()?;
    }
    Ok(nanoseconds as f64 * 1e-9)
}
