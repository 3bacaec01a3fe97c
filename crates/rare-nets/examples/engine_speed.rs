//! Speed of the engine's operations on the shapes of Stable Diffusion 1.5: `engine_speed [f32|bf16] [attention]`.
//!
//! Prints billions of operations per second of CPU time (Linux) over the best of some runs; `RARE_CPU` forces a set of
//! instructions, `RAYON_NUM_THREADS` the number of threads.
#![expect(clippy::print_stdout, reason = "the result")]

use std::error::Error;
use std::fs;

use rare_nets::engine::{
    Arrangement, Backend, Convolution, CpuBackend, Kernel, Precision, Prologue, Shape,
};
use rare_nets::{Parameter, Values};

const RUNS: usize = 5;

fn main() -> Result<(), Box<dyn Error>> {
    let precision = match std::env::args().nth(1).as_deref() {
        Some("bf16") => Precision::Bf16,
        _ => Precision::F32,
    };
    let cpu = CpuBackend::new(precision)?;
    println!("{} {precision:?}", cpu.processor().name());
    if std::env::args().nth(2).as_deref() != Some("attention") {
        convolutions(&cpu)?;
    }
    for (channels, height, width) in [(320, 64, 88), (640, 32, 44), (1280, 16, 22)] {
        attention(&cpu, channels, [height, width])?;
    }
    Ok(())
}

fn convolutions(cpu: &CpuBackend) -> Result<(), Box<dyn Error>> {
    for (channels, height, width) in [(320, 64, 88), (640, 32, 44), (1280, 16, 22), (1280, 8, 11)] {
        convolution(cpu, channels, channels, 3, [height, width])?;
    }
    convolution(cpu, 320, 2560, 1, [64, 88])?;
    convolution(cpu, 320, 320, 1, [64, 88])?;
    convolution(cpu, 1280, 320, 1, [64, 88])?;
    Ok(())
}

fn convolution(
    cpu: &CpuBackend,
    inputs: usize,
    outputs: usize,
    side: usize,
    [height, width]: [usize; 2],
) -> Result<(), Box<dyn Error>> {
    let shape = Shape { batch: 1, height, width, channels: inputs };
    let input = cpu.upload(shape, &values(shape.values()))?;
    let count = outputs * inputs * side * side;
    let half = values(count).into_iter().map(half::f16::from_f32).collect();
    let part = Parameter { shape: vec![outputs, inputs, side, side], values: Values::F16(half) };
    let weight =
        cpu.pack(&Kernel { parts: &[part], bias: None, arrangement: Arrangement::Plain })?;
    let (scale, shift) = (vec![1.0; inputs], vec![0.0; inputs]);
    let prologue = Prologue::GroupNormalization {
        groups: 32,
        epsilon: 1e-5,
        scale: &scale,
        shift: &shift,
        silu: true,
    };
    let fused = Convolution { prologue, ..Convolution::default() };
    let seconds = best(|| cpu.convolve(&input, &weight, &fused).map(drop))?;
    let operations = 2.0 * (count * height * width) as f64;
    let name = format!("{side} x {side} convolution {inputs} -> {outputs}");
    report(&name, [height, width], operations, seconds);
    Ok(())
}

fn attention(
    cpu: &CpuBackend,
    channels: usize,
    [height, width]: [usize; 2],
) -> Result<(), Box<dyn Error>> {
    // Through a product, so that it has the precision of products.
    let shape = Shape { batch: 1, height, width, channels: 3 * channels };
    let input = cpu.upload(shape, &values(shape.values()))?;
    let seconds = best(|| cpu.self_attention(&input, 8, false).map(drop))?;
    let operations = 4.0 * ((height * width).pow(2) * channels) as f64;
    report(&format!("attention {channels} channels"), [height, width], operations, seconds);
    Ok(())
}

fn report(name: &str, [height, width]: [usize; 2], operations: f64, seconds: f64) {
    println!(
        "{name:36} {height:3} x {width:3}: {:8.1} ms {:7.1} GFLOP/s",
        seconds * 1e3,
        operations / seconds / 1e9
    );
}

/// Numbers in [-0.5, 0.5).
fn values(count: usize) -> Vec<f32> {
    let mut random = rare::random::Random::new(1, 2);
    (0..count).map(|_| random.uniform() as f32 - 0.5).collect()
}

fn best(mut run: impl FnMut() -> rare::Result<()>) -> Result<f64, Box<dyn Error>> {
    run()?;
    let mut best = f64::INFINITY;
    for _ in 0..RUNS {
        let before = cpu_seconds()?;
        run()?;
        best = best.min(cpu_seconds()? - before);
    }
    Ok(best)
}

/// CPU time of all threads.
fn cpu_seconds() -> Result<f64, Box<dyn Error>> {
    let mut nanoseconds = 0;
    for task in fs::read_dir("/proc/self/task")? {
        let text = fs::read_to_string(task?.path().join("schedstat"))?;
        nanoseconds += text.split(' ').next().unwrap_or("0").parse::<u64>()?;
    }
    Ok(nanoseconds as f64 * 1e-9)
}
