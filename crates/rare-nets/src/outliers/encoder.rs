//! Parts that both networks have.

use rare::nalgebra::{Point3, Vector3};
use rare::{Correspondence, Error, Result};

use super::compatibility::Compatibilities;
use crate::Matrix;
use crate::checkpoint::Layout;
use crate::engine::{CpuBackend, Head};
use crate::layers::{Activation, Linear, Weights};

/// Layers of attention.
pub(crate) const LAYERS: usize = 12;
/// Numbers of a feature.
pub(crate) const CHANNELS: usize = 128;
/// Numbers inside the networks of messages.
const MESSAGE: usize = 64;
/// Numbers inside the classifier.
const CLASSIFIER: usize = 32;

/// What the networks see of the pairs: a row of both points for each, less the mean of all (metres).
pub(crate) fn centred(pairs: &[Correspondence]) -> Matrix {
    let mean = |point: fn(&Correspondence) -> Point3<f64>| {
        let sum: Vector3<f64> = pairs.iter().map(|pair| point(pair).coords).sum();
        sum / pairs.len().max(1) as f64
    };
    let (source, target) = (mean(|pair| pair.source), mean(|pair| pair.target));
    let mut matrix = Matrix::filled(pairs.len(), 6, 0.0);
    for (row, pair) in matrix.values_mut().chunks_exact_mut(6).zip(pairs) {
        let (source, target) = (pair.source.coords - source, pair.target.coords - target);
        let numbers = source.iter().chain(target.iter());
        row.iter_mut().zip(numbers).for_each(|(value, &number)| *value = number as f32);
    }
    matrix
}

/// `layers`, one after the other, with an activation after each but the last.
pub(crate) fn perceptron(cpu: &CpuBackend, layers: &[Linear], input: &Matrix) -> Result<Matrix> {
    let mut layers = layers.iter();
    let first = layers.next().ok_or_else(|| Error::Internal("no layers".to_owned()))?;
    layers.try_fold(first.apply(cpu, input)?, |mut hidden, layer| {
        Activation::Relu.apply_to(hidden.values_mut());
        layer.apply(cpu, &hidden)
    })
}

/// The attention of correspondences to each other and the message that each takes from it.
pub(crate) struct Message {
    layers: [Linear; 3],
}

impl Message {
    /// Of the tensors `name.0` to `name.6`.
    pub(crate) fn load(weights: &Weights<'_>, cpu: &CpuBackend, name: &str) -> Result<Message> {
        let normalised = |layer: usize| {
            let next = layer + 1;
            weights.normalised_linear(cpu, &format!("{name}.{layer}"), &format!("{name}.{next}"))
        };
        let last = weights.linear(cpu, &format!("{name}.6"))?;
        Ok(Message { layers: [normalised(0)?, normalised(3)?, last] })
    }

    /// Adds the message to the features.
    pub(crate) fn add(
        &self,
        cpu: &CpuBackend,
        head: &Head<'_>,
        compatibilities: &Compatibilities,
        features: &mut Matrix,
    ) -> Result<()> {
        let attended = cpu.factored_attention(head, compatibilities)?;
        features.add(&perceptron(cpu, &self.layers, &attended)?)
    }

    pub(crate) fn layout(layout: &mut Layout, name: &str) {
        linear(layout, &format!("{name}.0"), &[MESSAGE, CHANNELS, 1]);
        normalisation(layout, &format!("{name}.1"), MESSAGE);
        linear(layout, &format!("{name}.3"), &[MESSAGE, MESSAGE, 1]);
        normalisation(layout, &format!("{name}.4"), MESSAGE);
        linear(layout, &format!("{name}.6"), &[CHANNELS, MESSAGE, 1]);
    }
}

/// Tells how likely a correspondence is right.
pub(crate) struct Classifier {
    layers: [Linear; 3],
}

impl Classifier {
    /// Of the tensors `name.0` to `name.4`.
    pub(crate) fn load(weights: &Weights<'_>, cpu: &CpuBackend, name: &str) -> Result<Classifier> {
        let layer = |layer: usize| weights.linear(cpu, &format!("{name}.{layer}"));
        Ok(Classifier { layers: [layer(0)?, layer(2)?, layer(4)?] })
    }

    /// A number for each row of features; above 0 for what is rather right.
    pub(crate) fn confidences(&self, cpu: &CpuBackend, features: &Matrix) -> Result<Vec<f32>> {
        Ok(perceptron(cpu, &self.layers, features)?.into_values())
    }

    pub(crate) fn layout(layout: &mut Layout, name: &str) {
        linear(layout, &format!("{name}.0"), &[CLASSIFIER, CHANNELS, 1]);
        linear(layout, &format!("{name}.2"), &[CLASSIFIER, CLASSIFIER, 1]);
        linear(layout, &format!("{name}.4"), &[1, CLASSIFIER, 1]);
    }
}

/// A width that is learned (metres, or of features), which divides.
///
/// # Errors
/// `InvalidInput` if it is not positive.
pub(crate) fn width(weights: &Weights<'_>, name: &str) -> Result<f32> {
    let width = weights.scalar(name)?;
    // Its square divides, too.
    if width * width > 0.0 {
        Ok(width)
    } else {
        Err(Error::invalid(format!("{name} is {width}, it must not be 0")))
    }
}

/// A weight and as many biases as outputs.
pub(crate) fn linear(layout: &mut Layout, name: &str, shape: &[usize]) {
    layout.insert(format!("{name}.weight"), shape.to_vec());
    layout.insert(format!("{name}.bias"), shape.iter().take(1).copied().collect());
}

/// A batch normalisation.
pub(crate) fn normalisation(layout: &mut Layout, name: &str, channels: usize) {
    for part in ["weight", "bias", "running_mean", "running_var"] {
        layout.insert(format!("{name}.{part}"), vec![channels]);
    }
    layout.insert(format!("{name}.num_batches_tracked"), Vec::new());
}
