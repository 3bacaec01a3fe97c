//! Group and layer normalisation, as a factor and a summand that are applied when the next product's operand is made.

use rayon::prelude::*;

use super::backend::Prologue;
use super::simd::{LANES, Processor, Simd, Vectorized};
use super::tensor::{Tensor, Values};
use super::vectors::load_values;

/// What is done to each value before the activation.
pub(super) enum Affine<'a> {
    /// Nothing.
    None,
    /// A factor and a summand per channel of each image.
    Images { channels: usize, factors: Vec<f32>, summands: Vec<f32> },
    /// Each pixel is normalised over its channels.
    Pixels { epsilon: f32, scale: &'a [f32], shift: &'a [f32] },
}

/// The same for one image.
#[derive(Clone, Copy)]
pub(super) enum ImageAffine<'a> {
    None,
    Channels { factors: &'a [f32], summands: &'a [f32] },
    Pixels { epsilon: f32, scale: &'a [f32], shift: &'a [f32] },
}

impl Affine<'_> {
    pub(super) fn of_image(&self, image: usize) -> ImageAffine<'_> {
        match self {
            Affine::None => ImageAffine::None,
            Affine::Images { channels, factors, summands } => {
                let range = image * channels..(image + 1) * channels;
                ImageAffine::Channels {
                    factors: &factors[range.clone()],
                    summands: &summands[range],
                }
            }
            Affine::Pixels { epsilon, scale, shift } => {
                ImageAffine::Pixels { epsilon: *epsilon, scale, shift }
            }
        }
    }
}

/// What the prologue does to this input.
pub(super) fn affine<'a>(
    processor: Processor,
    prologue: &Prologue<'a>,
    input: &Tensor,
) -> Affine<'a> {
    match *prologue {
        Prologue::None | Prologue::Silu => Affine::None,
        Prologue::LayerNormalization { epsilon, scale, shift } => {
            Affine::Pixels { epsilon, scale, shift }
        }
        Prologue::GroupNormalization { groups, epsilon, scale, shift, .. } => {
            let channels = input.shape.channels;
            let (mut factors, mut summands) = (Vec::new(), Vec::new());
            for image in 0..input.shape.batch {
                let moments = channel_moments(processor, input, image);
                for group in 0..groups {
                    let of_group = group * channels / groups..(group + 1) * channels / groups;
                    let (mean, deviation) = moments.of(of_group.clone(), f64::from(epsilon));
                    for channel in of_group {
                        let factor = f64::from(scale[channel]) / deviation;
                        factors.push(factor as f32);
                        summands.push((f64::from(shift[channel]) - mean * factor) as f32);
                    }
                }
            }
            Affine::Images { channels, factors, summands }
        }
    }
}

/// Pixels that are summed in single precision before the sum is added up in double precision.
const CHUNK: usize = 128;

/// Sums of one image, relative to its first pixel so that a large mean does not drown the variance.
struct Moments {
    pixels: f64,
    origin: Vec<f64>,
    sums: Vec<f64>,
    squares: Vec<f64>,
}

impl Moments {
    /// Mean and square root of variance and epsilon over some channels.
    fn of(&self, channels: std::ops::Range<usize>, epsilon: f64) -> (f64, f64) {
        let count = self.pixels * channels.len() as f64;
        let total: f64 =
            channels.clone().map(|c| self.sums[c] + self.pixels * self.origin[c]).sum();
        let mean = total / count;
        // sum (x - mean)^2 with x = origin + d: sum d^2 - 2 (mean - origin) sum d + n (mean - origin)^2.
        let spread = |c: usize| {
            let shift = mean - self.origin[c];
            self.squares[c] - 2.0 * shift * self.sums[c] + self.pixels * shift * shift
        };
        let variance = channels.map(spread).sum::<f64>().max(0.0) / count;
        (mean, (variance + epsilon).sqrt())
    }
}

fn channel_moments(processor: Processor, input: &Tensor, image: usize) -> Moments {
    let channels = input.shape.channels;
    let pixels = input.shape.height * input.shape.width;
    let first = image * pixels;
    let origin = vec_of(input.values(first * channels, channels));
    let partial = |chunk: usize| {
        let start = chunk * CHUNK;
        let count = CHUNK.min(pixels - start);
        let values = input.values((first + start) * channels, count * channels);
        processor.run(ChannelSums { values, origin: &origin })
    };
    let chunks: Vec<_> = (0..pixels.div_ceil(CHUNK)).into_par_iter().map(partial).collect();
    let (mut sums, mut squares) = (vec![0.0; channels], vec![0.0; channels]);
    for (chunk_sums, chunk_squares) in &chunks {
        for channel in 0..channels {
            sums[channel] += f64::from(chunk_sums[channel]);
            squares[channel] += f64::from(chunk_squares[channel]);
        }
    }
    let origin = origin.into_iter().map(f64::from).collect();
    Moments { pixels: pixels as f64, origin, sums, squares }
}

fn vec_of(values: Values<'_>) -> Vec<f32> {
    match values {
        Values::F32(values) => values.to_vec(),
        Values::Bf16(values) => values.iter().map(|value| value.to_f32()).collect(),
    }
}

/// Sums and sums of squares of each channel over some pixels, relative to `origin`.
struct ChannelSums<'a> {
    values: Values<'a>,
    origin: &'a [f32],
}

impl Vectorized for ChannelSums<'_> {
    type Output = (Vec<f32>, Vec<f32>);

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> (Vec<f32>, Vec<f32>) {
        let channels = self.origin.len();
        let padded = channels.next_multiple_of(LANES);
        let (mut sums, mut squares) = (vec![0.0; padded], vec![0.0; padded]);
        for pixel in 0..self.values.len() / channels {
            let sums = sums.as_chunks_mut::<LANES>().0;
            let squares = squares.as_chunks_mut::<LANES>().0;
            for (group, (sum, square)) in sums.iter_mut().zip(squares).enumerate() {
                let channel = group * LANES;
                // Beyond the last channel the next pixel is read, and never looked at.
                let value = load_values(simd, self.values, pixel * channels + channel);
                let value = simd.sub(value, super::vectors::load(simd, self.origin, channel));
                simd.store(simd.add(simd.load(sum), value), sum);
                simd.store(simd.mul_add(value, value, simd.load(square)), square);
            }
        }
        (sums, squares)
    }
}

/// Mean of a pixel's channels, and the inverse of the root of variance and epsilon.
#[inline(always)]
pub(super) fn pixel_moments<S: Simd>(simd: S, pixel: Values<'_>, epsilon: f32) -> (f32, f32) {
    let count = pixel.len();
    let mut sum = simd.splat(0.0);
    for channel in (0..count).step_by(LANES) {
        sum = simd.add(sum, load_values(simd, pixel, channel));
    }
    let mean = simd.sum(sum) / count as f32;
    let mut squares = simd.splat(0.0);
    let whole = count - count % LANES;
    for channel in (0..whole).step_by(LANES) {
        let deviation = simd.sub(load_values(simd, pixel, channel), simd.splat(mean));
        squares = simd.mul_add(deviation, deviation, squares);
    }
    // Beyond the last channel zero is read, whose deviation is not zero: it would drown that of the pixel.
    let mut rest = [0.0; LANES];
    simd.store(load_values(simd, pixel, whole), &mut rest);
    let rest = rest[..count - whole].iter().map(|value| (value - mean) * (value - mean));
    let squares = simd.sum(squares) + rest.sum::<f32>();
    (mean, 1.0 / (squares / count as f32 + epsilon).sqrt())
}
