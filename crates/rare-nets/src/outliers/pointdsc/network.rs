//! The network: features and confidences of correspondences.

use rare::{Correspondence, Result};

use super::super::compatibility::Compatibilities;
use super::super::encoder::{
    CHANNELS, Classifier, LAYERS, Message, centred, linear, normalisation, width,
};
use crate::Matrix;
use crate::checkpoint::{Layout, Parameters};
use crate::engine::{Columns, CpuBackend, Head};
use crate::layers::{Activation, Linear, Weights};

/// The tensors of PointDSC (358, with those that inference does not use), as its checkpoints name them.
#[must_use]
pub fn layout() -> Layout {
    let mut layout = Layout::new();
    layout.insert("sigma".to_owned(), vec![1]);
    layout.insert("sigma_spat".to_owned(), vec![1]);
    linear(&mut layout, "encoder.layer0", &[CHANNELS, 6, 1]);
    for layer in 0..LAYERS {
        let (point, non_local) = (point_name(layer), non_local_name(layer));
        linear(&mut layout, &format!("{point}.0"), &[CHANNELS, CHANNELS, 1]);
        normalisation(&mut layout, &format!("{point}.1"), CHANNELS);
        Message::layout(&mut layout, &format!("{non_local}.fc_message"));
        for projection in projections(layer) {
            linear(&mut layout, &projection, &[CHANNELS, CHANNELS, 1]);
        }
    }
    Classifier::layout(&mut layout, "classification");
    layout
}

fn point_name(layer: usize) -> String {
    format!("encoder.blocks.PointCN_layer_{layer}")
}

fn non_local_name(layer: usize) -> String {
    format!("encoder.blocks.NonLocal_layer_{layer}")
}

fn projections(layer: usize) -> [String; 3] {
    ["q", "k", "v"].map(|which| format!("{}.projection_{which}", non_local_name(layer)))
}

/// The encoder and the classifier.
pub(super) struct Network {
    pub(super) cpu: CpuBackend,
    /// Width of the compatibility of features.
    pub(super) sigma: f32,
    /// Width of the compatibility in space, metres.
    pub(super) spatial_sigma: f32,
    input: Linear,
    layers: Vec<Layer>,
    classifier: Classifier,
}

/// A layer of the encoder.
struct Layer {
    point: Linear,
    /// Queries, keys and values.
    projection: Linear,
    message: Message,
}

impl Network {
    pub(super) fn load(parameters: &Parameters, cpu: CpuBackend) -> Result<Network> {
        let layout = layout();
        let weights = Weights::new(parameters, &layout, "PointDSC")?;
        Ok(Network {
            sigma: width(&weights, "sigma")?,
            spatial_sigma: width(&weights, "sigma_spat")?,
            input: weights.linear(&cpu, "encoder.layer0")?,
            layers: (0..LAYERS)
                .map(|layer| Layer::load(&weights, &cpu, layer))
                .collect::<Result<_>>()?,
            classifier: Classifier::load(&weights, &cpu, "classification")?,
            cpu,
        })
    }

    /// Features and confidences of the pairs. `watch` is called with 0 and the features at first, then with the number
    /// of each layer (from 1 on) and those after it.
    pub(super) fn encode(
        &self,
        pairs: &[Correspondence],
        compatibilities: &Compatibilities,
        mut watch: impl FnMut(usize, &Matrix),
    ) -> Result<(Matrix, Vec<f32>)> {
        let cpu = &self.cpu;
        let mut features = self.input.apply(cpu, &centred(pairs))?;
        watch(0, &features);
        for (layer, number) in self.layers.iter().zip(1..) {
            features = layer.apply(cpu, &features, compatibilities)?;
            watch(number, &features);
        }
        let confidences = self.classifier.confidences(cpu, &features)?;
        Ok((features, confidences))
    }
}

impl Layer {
    fn load(weights: &Weights<'_>, cpu: &CpuBackend, layer: usize) -> Result<Layer> {
        let (point, non_local) = (point_name(layer), non_local_name(layer));
        Ok(Layer {
            point: weights.normalised_linear(cpu, &format!("{point}.0"), &format!("{point}.1"))?,
            projection: weights.stacked_linear(cpu, &projections(layer))?,
            message: Message::load(weights, cpu, &format!("{non_local}.fc_message"))?,
        })
    }

    fn apply(
        &self,
        cpu: &CpuBackend,
        features: &Matrix,
        compatibilities: &Compatibilities,
    ) -> Result<Matrix> {
        let mut features = self.point.apply(cpu, features)?;
        Activation::Relu.apply_to(features.values_mut());
        let projected = self.projection.apply(cpu, &features)?;
        let third = |part: usize| Columns { matrix: &projected, first: part * CHANNELS };
        let keys = &cpu.aligned(third(1), CHANNELS)?;
        let values = &cpu.aligned(third(2), CHANNELS)?;
        let head = Head { queries: third(0), keys, values };
        self.message.add(cpu, &head, compatibilities, &mut features)?;
        Ok(features)
    }
}
