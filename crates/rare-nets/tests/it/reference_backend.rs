//! The operations of the engine by their definitions: one loop per sum, in double precision, nothing fused.
//!
//! It proves the networks without the engine, and the engine's operations are tested against it. Shapes that do not fit
//! panic here, where an engine gives an error.

use std::sync::Mutex;

use rare::Result;
use rare_nets::Parameter;
use rare_nets::engine::{Activation, Arrangement, Backend, Convolution, Kernel, Prologue, Shape};
use rayon::prelude::*;

/// The backend, with the results of all its convolutions so far.
#[derive(Default)]
pub(crate) struct ReferenceBackend {
    pub(crate) results: Mutex<Vec<Tensor>>,
}

/// Values in the order image, row, column, channel.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Tensor {
    pub(crate) shape: Shape,
    pub(crate) values: Vec<f32>,
}

/// The weights in the order output, row, column, input.
pub(crate) struct Weight {
    outputs: usize,
    inputs: usize,
    side: usize,
    values: Vec<f64>,
    bias: Vec<f64>,
    arrangement: Arrangement,
}

/// Activations between the steps of one operation.
struct Image {
    shape: Shape,
    values: Vec<f64>,
}

impl Backend for ReferenceBackend {
    type Tensor = Tensor;
    type Weight = Weight;

    fn pack(&self, kernel: &Kernel<'_>) -> Result<Weight> {
        let (inputs, side) = sizes(&kernel.parts[0]);
        let outputs = kernel.parts.iter().map(|part| part.shape[0]).sum();
        let mut values = Vec::new();
        for part in kernel.parts {
            assert_eq!(sizes(part), (inputs, side));
            values.extend(inputs_last(&part.to_f32(), inputs, side));
        }
        let bias = match kernel.bias {
            Some(bias) => bias.iter().map(|&value| f64::from(value)).collect(),
            None => vec![0.0; outputs],
        };
        assert_eq!(bias.len(), outputs);
        let arrangement = kernel.arrangement;
        Ok(Weight { outputs, inputs, side, values, bias, arrangement })
    }

    fn upload(&self, shape: Shape, values: &[f32]) -> Result<Tensor> {
        assert_eq!(shape.values(), values.len());
        Ok(Tensor { shape, values: values.to_vec() })
    }

    fn download(&self, tensor: &Tensor) -> Result<Vec<f32>> {
        Ok(tensor.values.clone())
    }

    fn shape(&self, tensor: &Tensor) -> Shape {
        tensor.shape
    }

    fn convolve(
        &self,
        input: &Tensor,
        weight: &Weight,
        fused: &Convolution<'_, Tensor>,
    ) -> Result<Tensor> {
        let mut image = before(input, &fused.prologue);
        if fused.upsample {
            image = doubled(&image);
        }
        let mut image = convolved(&image, weight, fused.stride, fused.offset);
        if weight.arrangement == Arrangement::Gated {
            image = gated(&image);
        }
        for value in &mut image.values {
            *value = activated(*value, fused.activation);
        }
        let result = with_residual(image, fused.residual);
        self.results.lock().unwrap().push(result.clone());
        Ok(result)
    }

    fn self_attention(
        &self,
        queries_keys_values: &Tensor,
        heads: usize,
        causal: bool,
    ) -> Result<Tensor> {
        let [queries, keys, values] = split(queries_keys_values);
        let images = 0..queries.shape.batch;
        let attended = images
            .map(|image| {
                let part = |tensor: &Tensor| one_image(tensor, image);
                attention(&part(&queries), &part(&keys), &part(&values), heads, causal)
            })
            .collect::<Vec<Vec<f32>>>();
        Ok(Tensor { shape: queries.shape, values: attended.concat() })
    }

    fn cross_attention(
        &self,
        queries: &Tensor,
        contexts: &[&Tensor],
        heads: usize,
    ) -> Result<Tensor> {
        assert_eq!(queries.shape.batch % contexts.len(), 0);
        let share = queries.shape.batch / contexts.len();
        let attended = (0..queries.shape.batch)
            .map(|image| {
                let context = contexts[image / share];
                assert_eq!(context.shape.batch, 1);
                let [keys, values] = split(context);
                attention(&one_image(queries, image), &keys, &values, heads, false)
            })
            .collect::<Vec<Vec<f32>>>();
        Ok(Tensor { shape: queries.shape, values: attended.concat() })
    }

    fn concatenate(&self, first: &Tensor, second: &Tensor) -> Result<Tensor> {
        let shape = first.shape;
        let channels = shape.channels + second.shape.channels;
        assert_eq!(Shape { channels, ..shape }, Shape { channels, ..second.shape });
        let first = first.values.chunks_exact(shape.channels);
        let second = second.values.chunks_exact(second.shape.channels);
        let values = first.zip(second).flat_map(|(first, second)| [first, second].concat());
        Ok(Tensor { shape: Shape { channels, ..shape }, values: values.collect() })
    }
}

/// Inputs and side of a part of a kernel.
fn sizes(part: &Parameter) -> (usize, usize) {
    match part.shape[..] {
        [_, inputs] => (inputs, 1),
        [_, inputs, rows, columns] if rows == columns => (inputs, rows),
        _ => panic!("a kernel of shape {:?}", part.shape),
    }
}

/// From output, input, row, column to output, row, column, input.
fn inputs_last(values: &[f32], inputs: usize, side: usize) -> Vec<f64> {
    let area = side * side;
    values
        .chunks_exact(inputs * area)
        .flat_map(|output| {
            (0..area).flat_map(move |at| (0..inputs).map(move |input| output[input * area + at]))
        })
        .map(f64::from)
        .collect()
}

/// The input of a convolution after its prologue.
fn before(input: &Tensor, prologue: &Prologue<'_>) -> Image {
    let shape = input.shape;
    let mut values: Vec<f64> = input.values.iter().map(|&value| f64::from(value)).collect();
    match *prologue {
        Prologue::None => {}
        Prologue::Silu => values.iter_mut().for_each(|value| *value = silu(*value)),
        Prologue::GroupNormalization { groups, epsilon, scale, shift, silu: then_silu } => {
            assert_eq!(shape.channels % groups, 0);
            let width = shape.channels / groups;
            let image_size = shape.height * shape.width * shape.channels;
            for image in values.chunks_exact_mut(image_size) {
                for group in 0..groups {
                    let member = |index: &usize| index % shape.channels / width == group;
                    let members: Vec<usize> = (0..image_size).filter(member).collect();
                    normalize(image, &members, epsilon);
                }
            }
            scale_and_shift(&mut values, scale, shift);
            if then_silu {
                values.iter_mut().for_each(|value| *value = silu(*value));
            }
        }
        Prologue::LayerNormalization { epsilon, scale, shift } => {
            let members: Vec<usize> = (0..shape.channels).collect();
            for pixel in values.chunks_exact_mut(shape.channels) {
                normalize(pixel, &members, epsilon);
            }
            scale_and_shift(&mut values, scale, shift);
        }
    }
    Image { shape, values }
}

/// Brings the members to mean 0 and variance 1.
fn normalize(values: &mut [f64], members: &[usize], epsilon: f32) {
    let count = members.len() as f64;
    let mean = members.iter().map(|&at| values[at]).sum::<f64>() / count;
    let variance = members.iter().map(|&at| (values[at] - mean).powi(2)).sum::<f64>() / count;
    for &at in members {
        values[at] = (values[at] - mean) / (variance + f64::from(epsilon)).sqrt();
    }
}

fn scale_and_shift(values: &mut [f64], scale: &[f32], shift: &[f32]) {
    for pixel in values.chunks_exact_mut(scale.len()) {
        for ((value, &scale), &shift) in pixel.iter_mut().zip(scale).zip(shift) {
            *value = *value * f64::from(scale) + f64::from(shift);
        }
    }
}

/// Every pixel four times.
fn doubled(image: &Image) -> Image {
    let Shape { batch, height, width, channels } = image.shape;
    let shape = Shape { height: 2 * height, width: 2 * width, ..image.shape };
    let mut values = Vec::new();
    for at in 0..batch {
        for row in 0..2 * height {
            for column in 0..2 * width {
                let pixel = (at * height + row / 2) * width + column / 2;
                values.extend_from_slice(&image.values[pixel * channels..][..channels]);
            }
        }
    }
    Image { shape, values }
}

/// The convolution alone, with bias and offset.
fn convolved(image: &Image, weight: &Weight, stride: usize, offset: Option<&Tensor>) -> Image {
    assert_eq!(image.shape.channels, weight.inputs);
    let shape = Shape {
        height: image.shape.height.div_ceil(stride),
        width: image.shape.width.div_ceil(stride),
        channels: weight.outputs,
        ..image.shape
    };
    let values = (0..shape.pixels())
        .into_par_iter()
        .flat_map_iter(|pixel| {
            let (at, rest) =
                (pixel / (shape.height * shape.width), pixel % (shape.height * shape.width));
            let (row, column) = (rest / shape.width * stride, rest % shape.width * stride);
            (0..shape.channels).map(move |output| {
                let added = offset.map_or(0.0, |offset| f64::from(offset.values[output]));
                product(image, weight, [at, row, column], output) + weight.bias[output] + added
            })
        })
        .collect();
    if let Some(offset) = offset {
        assert_eq!(offset.shape, Shape { batch: 1, height: 1, width: 1, channels: weight.outputs });
    }
    Image { shape, values }
}

/// One output of the kernel centred on the pixel `[image, row, column]`.
fn product(image: &Image, weight: &Weight, centre: [usize; 3], output: usize) -> f64 {
    let Shape { height, width, channels, .. } = image.shape;
    let half = weight.side / 2;
    let mut sum = 0.0;
    for row in 0..weight.side {
        for column in 0..weight.side {
            let (y, x) = (centre[1] + row, centre[2] + column);
            if y < half || x < half || y - half >= height || x - half >= width {
                continue;
            }
            let pixel = (centre[0] * height + y - half) * width + x - half;
            let tap = (output * weight.side + row) * weight.side + column;
            let inputs = &image.values[pixel * channels..][..channels];
            let factors = &weight.values[tap * channels..][..channels];
            sum += inputs.iter().zip(factors).map(|(input, factor)| input * factor).sum::<f64>();
        }
    }
    sum
}

/// The first half of the channels, times the gates in the second half.
fn gated(image: &Image) -> Image {
    let channels = image.shape.channels / 2;
    let values = image.values.chunks_exact(2 * channels).flat_map(|pixel| {
        let (values, gates) = pixel.split_at(channels);
        values.iter().zip(gates).map(|(value, gate)| value * gelu(*gate)).collect::<Vec<f64>>()
    });
    Image { shape: Shape { channels, ..image.shape }, values: values.collect() }
}

fn with_residual(image: Image, residual: Option<&Tensor>) -> Tensor {
    let shape = image.shape;
    let mut values = image.values;
    if let Some(residual) = residual {
        assert_eq!(Shape { batch: 1, ..shape }, Shape { batch: 1, ..residual.shape });
        assert_eq!(shape.batch % residual.shape.batch, 0);
        for (value, &added) in values.iter_mut().zip(residual.values.iter().cycle()) {
            *value += f64::from(added);
        }
    }
    Tensor { shape, values: values.into_iter().map(|value| value as f32).collect() }
}

fn activated(value: f64, activation: Activation) -> f64 {
    match activation {
        Activation::None => value,
        Activation::Silu => silu(value),
        Activation::QuickGelu => value / (1.0 + (-1.702 * value).exp()),
    }
}

fn silu(value: f64) -> f64 {
    value / (1.0 + (-value).exp())
}

fn gelu(value: f64) -> f64 {
    0.5 * value * (1.0 + libm::erf(value / std::f64::consts::SQRT_2))
}

/// Equal parts of the channels.
fn split<const PARTS: usize>(tensor: &Tensor) -> [Tensor; PARTS] {
    assert_eq!(tensor.shape.channels % PARTS, 0);
    let channels = tensor.shape.channels / PARTS;
    let shape = Shape { channels, ..tensor.shape };
    std::array::from_fn(|part| {
        let pixels = tensor.values.chunks_exact(tensor.shape.channels);
        let values = pixels.flat_map(|pixel| &pixel[part * channels..][..channels]).copied();
        Tensor { shape, values: values.collect() }
    })
}

fn one_image(tensor: &Tensor, image: usize) -> Tensor {
    let shape = Shape { batch: 1, ..tensor.shape };
    Tensor { shape, values: tensor.values[image * shape.values()..][..shape.values()].to_vec() }
}

/// Softmax of the scaled products of queries and keys, times the values, for each head.
fn attention(
    queries: &Tensor,
    keys: &Tensor,
    values: &Tensor,
    heads: usize,
    causal: bool,
) -> Vec<f32> {
    let channels = queries.shape.channels;
    assert_eq!((keys.shape.channels, channels % heads), (channels, 0));
    let width = channels / heads;
    let part = |tensor: &Tensor, token: usize, channel: usize| {
        f64::from(tensor.values[token * channels + channel])
    };
    let mut attended = vec![0.0; queries.values.len()];
    for query in 0..queries.shape.pixels() {
        let seen = if causal { query + 1 } else { keys.shape.pixels() };
        for head in 0..heads {
            let own = head * width..(head + 1) * width;
            let score = |key: usize| {
                own.clone().map(|at| part(queries, query, at) * part(keys, key, at)).sum::<f64>()
                    / (width as f64).sqrt()
            };
            let weights = softmax(&(0..seen).map(score).collect::<Vec<f64>>());
            for at in own.clone() {
                let mean = (0..seen).map(|key| weights[key] * part(values, key, at)).sum::<f64>();
                attended[query * channels + at] = mean as f32;
            }
        }
    }
    attended
}

fn softmax(scores: &[f64]) -> Vec<f64> {
    let largest = scores.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let powers: Vec<f64> = scores.iter().map(|score| (score - largest).exp()).collect();
    let sum: f64 = powers.iter().sum();
    powers.iter().map(|power| power / sum).collect()
}
