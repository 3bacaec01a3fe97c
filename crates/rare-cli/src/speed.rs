//! How fast this machine is at what networks mostly do.

use std::time::Instant;

use rare_nets::engine::{Arrangement, Backend, Convolution, Kernel, Shape};
use rare_nets::{Parameter, Values};

/// Channels in and out, and the sides of the image: a layer in the middle of the networks, 0.05 s on two cores.
const CHANNELS: usize = 320;
const SIDE: usize = 32;

/// Floating-point operations per second in one 3 x 3 convolution, measured now: an estimate of what the whole networks
/// reach.
///
/// # Errors
/// What the backend has.
pub(crate) fn measured(backend: &impl Backend) -> rare::Result<f64> {
    let weight = Parameter {
        shape: vec![CHANNELS, CHANNELS, 3, 3],
        values: Values::F32(vec![0.01; CHANNELS * CHANNELS * 9]),
    };
    let kernel = Kernel { parts: &[weight], bias: None, arrangement: Arrangement::Plain };
    let weight = backend.pack(&kernel)?;
    let shape = Shape { batch: 1, height: SIDE, width: SIDE, channels: CHANNELS };
    let image = backend.upload(shape, &vec![0.5; shape.values()])?;
    // The first one wakes the threads.
    backend.convolve(&image, &weight, &Convolution::default())?;
    let clock = Instant::now();
    let result = backend.convolve(&image, &weight, &Convolution::default())?;
    backend.download(&result)?;
    let operations = 2 * 9 * CHANNELS * shape.values();
    Ok(operations as f64 / clock.elapsed().as_secs_f64().max(1e-6))
}
