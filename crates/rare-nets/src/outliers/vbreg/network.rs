//! The network: features and confidences of correspondences, and the attention of all layers.

use rare::random::Random;
use rare::{Correspondence, Result};
use rayon::prelude::*;

use super::super::compatibility::Compatibilities;
use super::super::encoder::{
    CHANNELS, Classifier, LAYERS, Message, centred, linear, normalisation, perceptron, width,
};
use super::beliefs::{self, Belief, Branch};
use crate::Matrix;
use crate::checkpoint::{Layout, Parameters};
use crate::engine::{AlignedRows, Columns, CpuBackend, Head};
use crate::layers::{Linear, Weights, unit_rows};

const PREFIX: &str = "blocks.corr_encoder.blocks.";
const BRANCHES: [&str; 3] = ["Q", "K", "V"];
/// Correspondences whose beliefs are updated at once: so few that all that is in between stays in a cache.
const ROWS: usize = 256;

/// The tensors of VBReg (342, with those that inference does not use), as its checkpoints name them.
#[must_use]
pub fn layout() -> Layout {
    let mut layout = Layout::new();
    layout.insert("sigma".to_owned(), vec![1]);
    layout.insert("sigma_spat".to_owned(), vec![1]);
    linear(&mut layout, &format!("{PREFIX}init_mlp.0"), &[CHANNELS, 6, 1]);
    normalisation(&mut layout, &format!("{PREFIX}init_mlp.1"), CHANNELS);
    linear(&mut layout, &format!("{PREFIX}init_mlp.3"), &[CHANNELS, CHANNELS, 1]);
    linear(&mut layout, &format!("{PREFIX}PointCN_layer_0.0"), &[CHANNELS, CHANNELS, 1]);
    normalisation(&mut layout, &format!("{PREFIX}PointCN_layer_0.1"), CHANNELS);
    for layer in 0..LAYERS {
        let name = layer_name(layer);
        Message::layout(&mut layout, &format!("{name}.message_mlp"));
        for which in ["q", "k", "v"] {
            let shape = [CHANNELS, CHANNELS, 1];
            linear(&mut layout, &format!("{name}.projection_{which}.0"), &shape);
        }
    }
    BRANCHES.iter().for_each(|which| beliefs::layout(&mut layout, PREFIX, which));
    Classifier::layout(&mut layout, "blocks.corr_classifier");
    layout
}

fn layer_name(layer: usize) -> String {
    format!("{PREFIX}NonLocal_layer_{layer}.blocks")
}

/// The encoder and the classifier.
pub(super) struct Network {
    pub(super) cpu: CpuBackend,
    /// Width of the compatibility of features.
    pub(super) sigma: f32,
    /// Width of the compatibility in space, metres.
    pub(super) spatial_sigma: f32,
    input: [Linear; 2],
    branches: [Branch; 3],
    layers: Vec<Layer>,
    classifier: Classifier,
}

/// A layer of attention.
struct Layer {
    /// Of queries, keys and values.
    projections: [Linear; 3],
    message: Message,
}

/// What a layer of attention leaves for the votes, a row for each correspondence.
pub(super) struct Record {
    pub(super) queries: Matrix,
    pub(super) keys: AlignedRows,
    /// The features after it, with unit length.
    pub(super) features: AlignedRows,
}

/// What the network says of correspondences.
pub(super) struct Encoded {
    pub(super) features: Matrix,
    pub(super) confidences: Vec<f32>,
    pub(super) records: Vec<Record>,
}

impl Network {
    pub(super) fn load(parameters: &Parameters, cpu: CpuBackend) -> Result<Network> {
        let layout = layout();
        let weights = Weights::new(parameters, &layout, "VBReg")?;
        let init = |layer: usize| format!("{PREFIX}init_mlp.{layer}");
        let branch = |which| Branch::load(&weights, &cpu, PREFIX, which);
        let [queries, keys, values] = BRANCHES;
        Ok(Network {
            sigma: width(&weights, "sigma")?,
            spatial_sigma: width(&weights, "sigma_spat")?,
            input: [
                weights.normalised_linear(&cpu, &init(0), &init(1))?,
                weights.linear(&cpu, &init(3))?,
            ],
            branches: [branch(queries)?, branch(keys)?, branch(values)?],
            layers: (0..LAYERS)
                .map(|layer| Layer::load(&weights, &cpu, layer))
                .collect::<Result<_>>()?,
            classifier: Classifier::load(&weights, &cpu, "blocks.corr_classifier")?,
            cpu,
        })
    }

    /// Features and confidences of the pairs. With `noise`, the seed of random numbers, states are sampled.
    pub(super) fn encode(
        &self,
        pairs: &[Correspondence],
        compatibilities: &Compatibilities,
        noise: Option<u64>,
    ) -> Result<Encoded> {
        let cpu = &self.cpu;
        let mut features = perceptron(cpu, &self.input, &centred(pairs))?;
        let mut beliefs: Vec<[Belief; 3]> = (0..pairs.len())
            .step_by(ROWS)
            .map(|first| [(); 3].map(|()| Belief::nothing(ROWS.min(pairs.len() - first))))
            .collect();
        let mut records = Vec::with_capacity(LAYERS);
        for (number, layer) in self.layers.iter().enumerate() {
            let noise = noise.map(|seed| Noise { seed, layer: number });
            let [queries, keys, values] = self.projected(layer, &features, &mut beliefs, noise)?;
            let keys = cpu.aligned(Columns::all(&keys), CHANNELS)?;
            let values = &cpu.aligned(Columns::all(&values), CHANNELS)?;
            let head = Head { queries: Columns::all(&queries), keys: &keys, values };
            layer.message.add(cpu, &head, compatibilities, &mut features)?;
            let mut unit = features.clone();
            unit_rows(&mut unit);
            let features = cpu.aligned(Columns::all(&unit), CHANNELS)?;
            records.push(Record { queries, keys, features });
        }
        let confidences = self.classifier.confidences(cpu, &features)?;
        Ok(Encoded { features, confidences, records })
    }

    /// Updates all beliefs by the features, and gives the queries, keys and values of a layer.
    fn projected(
        &self,
        layer: &Layer,
        features: &Matrix,
        beliefs: &mut [[Belief; 3]],
        noise: Option<Noise>,
    ) -> Result<[Matrix; 3]> {
        let parts: Vec<[Matrix; 3]> = beliefs
            .par_iter_mut()
            .enumerate()
            .map(|(block, beliefs)| {
                let first = block * ROWS;
                let features = features.part(first, ROWS.min(features.rows() - first));
                let mut project = |which: usize| {
                    let random = noise.map(|noise| noise.of(which, block));
                    let branch = &self.branches[which];
                    let embedded =
                        branch.step(&self.cpu, &features, &mut beliefs[which], random)?;
                    layer.projections[which].apply(&self.cpu, &embedded)
                };
                Ok([project(0)?, project(1)?, project(2)?])
            })
            .collect::<Result<_>>()?;
        let joined = |which: usize| {
            let mut values = Vec::with_capacity(features.rows() * CHANNELS);
            parts.iter().for_each(|part| values.extend_from_slice(part[which].values()));
            Matrix::new(features.rows(), CHANNELS, values)
        };
        Ok([joined(0)?, joined(1)?, joined(2)?])
    }
}

/// The random numbers of a layer.
#[derive(Debug, Clone, Copy)]
struct Noise {
    seed: u64,
    layer: usize,
}

impl Noise {
    /// Those of one branch and one block of rows.
    fn of(self, which: usize, block: usize) -> Random {
        let stream = (block * LAYERS + self.layer) * BRANCHES.len() + which;
        Random::new(self.seed, stream as u64)
    }
}

impl Layer {
    fn load(weights: &Weights<'_>, cpu: &CpuBackend, layer: usize) -> Result<Layer> {
        let name = layer_name(layer);
        let projection = |which: &str| weights.linear(cpu, &format!("{name}.projection_{which}.0"));
        Ok(Layer {
            projections: [projection("q")?, projection("k")?, projection("v")?],
            message: Message::load(weights, cpu, &format!("{name}.message_mlp"))?,
        })
    }
}
