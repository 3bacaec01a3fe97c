//! The embedding of the time of diffusion (Ho, Jain, Abbeel, 2020).

use rare::Result;

use super::Loader;
use crate::engine::{Activation, Backend, Convolution, Shape};

/// The longest wavelength of the embedding, over 2 pi.
const LONGEST: f64 = 10_000.0;

/// Cosines and sines of the time, then two linear layers.
pub(crate) struct TimeEmbedding<B: Backend> {
    channels: usize,
    linear1: B::Weight,
    linear2: B::Weight,
}

impl<B: Backend> TimeEmbedding<B> {
    /// Takes the number of cosines and sines together, which is even.
    pub(crate) fn load(loader: &Loader<'_, B>, channels: usize) -> Result<TimeEmbedding<B>> {
        Ok(TimeEmbedding {
            channels,
            linear1: loader.kernel("time_embedding.linear_1")?,
            linear2: loader.kernel("time_embedding.linear_2")?,
        })
    }

    /// The embedding of a time (in training steps): one pixel.
    pub(crate) fn run(&self, backend: &B, time: f32) -> Result<B::Tensor> {
        let values = waves(time, self.channels);
        let shape = Shape { batch: 1, height: 1, width: 1, channels: values.len() };
        let waves = backend.upload(shape, &values)?;
        let fused = Convolution {
            activation: Activation::Silu,
            intermediate: true,
            ..Convolution::default()
        };
        let inner = backend.convolve(&waves, &self.linear1, &fused)?;
        backend.convolve(&inner, &self.linear2, &Convolution::default())
    }
}

/// Cosines, then sines, of the time at frequencies that fall from 1 geometrically.
fn waves(time: f32, channels: usize) -> Vec<f32> {
    let half = channels / 2;
    let angle = |index: usize| {
        let frequency = libm::exp(-libm::log(LONGEST) * index as f64 / half as f64);
        f64::from(time) * frequency
    };
    let cosines = (0..half).map(|index| libm::cos(angle(index)) as f32);
    let sines = (0..half).map(|index| libm::sin(angle(index)) as f32);
    cosines.chain(sines).collect()
}
