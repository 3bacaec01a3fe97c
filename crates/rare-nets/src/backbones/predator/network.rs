//! The network, and what it computes on the way.

use rare::{Error, Result};

use super::PredatorConfig;
use super::edge_convolution::{EdgeConvolutions, Graph};
use super::layout::{GRAPHS, layout};
use super::overlap_attention::cross_scores;
use crate::Matrix;
use crate::backbones::hourglass::{Decoder, Encoder, MessagePassing, Turns, halves};
use crate::backbones::kpconv::Pyramid;
use crate::checkpoint::Parameters;
use crate::engine::{CpuBackend, Precision};
use crate::layers::{Linear, Weights, unit_rows};

/// The network with its weights (Huang et al.: Predator, CVPR 2021).
pub struct Predator {
    pub(super) config: PredatorConfig,
    cpu: CpuBackend,
    encoder: Encoder,
    bottleneck: Linear,
    graphs: [EdgeConvolutions; 2],
    attention: MessagePassing,
    coarse_features: Linear,
    coarse_scores: Linear,
    epsilon: f32,
    decoder: Decoder,
}

/// What the network computes of a pair of clouds. Matrices have a row for each point, those of the source first; pairs of
/// matrices are source and target.
#[derive(Debug, Clone, PartialEq)]
pub struct Output {
    /// Features of the stages but the coarsest, the finest first.
    pub encoded: Vec<Matrix>,
    /// Features of the coarse points before they look at each other.
    pub bottleneck: Matrix,
    /// Features of the coarse points after each of the three layers: graph, attention, graph.
    pub attended: [[Matrix; 2]; 3],
    /// Neighbours of each coarse point in the graphs of both clouds.
    pub degrees: [usize; 2],
    /// Features of the coarse points.
    pub coarse_features: [Matrix; 2],
    /// How much each coarse point speaks for an overlap, one column.
    pub coarse_scores: [Matrix; 2],
    /// What the decoder gives: features, overlap and saliency before they are brought into their range.
    pub decoded: Matrix,
    /// The features of all points, of unit length.
    pub features: Matrix,
    /// How likely each point lies where the clouds overlap, 0 to 1.
    pub overlap: Vec<f32>,
    /// How likely each point can be matched, 0 to 1.
    pub saliency: Vec<f32>,
}

/// Features of coarse points step by step, and the degrees of the graphs.
struct Attended {
    steps: [[Matrix; 2]; 3],
    degrees: [usize; 2],
}

impl Predator {
    /// Takes the weights under their official names.
    ///
    /// # Errors
    /// `InvalidInput` if they are not the weights of this network or are damaged; `Io`, `Unsupported` as the file has it.
    pub fn load(parameters: &Parameters, config: PredatorConfig) -> Result<Predator> {
        let layout = layout(&config);
        let network = format!("Predator for {}", config.name);
        let weights = Weights::new(parameters, &layout, &network)?;
        let cpu = CpuBackend::new(Precision::F32)?;
        let [first, between, second] = GRAPHS;
        let (sizes, pyramid) = (config.encoder(), &config.pyramid);
        Ok(Predator {
            encoder: Encoder::read(&cpu, &weights, "encoder_blocks", &sizes, pyramid)?,
            bottleneck: weights.linear(&cpu, "bottle")?,
            graphs: [
                EdgeConvolutions::read(&cpu, &weights, first)?,
                EdgeConvolutions::read(&cpu, &weights, second)?,
            ],
            attention: MessagePassing::read(&cpu, &weights, between, config.heads)?,
            coarse_features: weights.linear(&cpu, "proj_gnn")?,
            coarse_scores: weights.linear(&cpu, "proj_score")?,
            epsilon: weights.scalar("epsilon")?,
            decoder: Decoder::read(&cpu, &weights, "decoder_blocks", &config.decoder())?,
            config,
            cpu,
        })
    }

    /// Its settings.
    #[must_use]
    pub fn config(&self) -> &PredatorConfig {
        &self.config
    }

    /// Features and scores of the points of a pyramid, whose first cloud is the source.
    ///
    /// # Errors
    /// `InvalidInput` if a cloud has a single coarse point; `Internal` if the pyramid has not the stages of the network.
    pub fn run(&self, pyramid: &Pyramid) -> Result<Output> {
        let cpu = &self.cpu;
        let encoded = self.encoder.apply(cpu, pyramid)?;
        let bottleneck = self.bottleneck.apply(cpu, &encoded.coarsest)?;
        let Attended { steps, degrees } = self.attend(pyramid, &bottleneck)?;
        let [.., last] = &steps;
        let project = |layer: &Linear, [source, target]: &[Matrix; 2]| {
            Ok::<_, Error>([layer.apply(cpu, source)?, layer.apply(cpu, target)?])
        };
        let coarse_features = project(&self.coarse_features, last)?;
        let coarse_scores = project(&self.coarse_scores, &coarse_features)?;
        let crossed = cross_scores(cpu, &coarse_features, &coarse_scores, self.epsilon)?;
        let scores = stacked(&coarse_scores)?.beside(&stacked(&crossed)?)?;
        let coarse = scores.beside(&stacked(&coarse_features)?)?;
        let decoded = self.decoder.apply(cpu, pyramid, encoded.skipped.clone(), coarse)?;
        let (features, overlap, saliency) = split(&decoded, self.config.features)?;
        Ok(Output {
            encoded: encoded.skipped,
            bottleneck,
            attended: steps,
            degrees,
            coarse_features,
            coarse_scores,
            decoded,
            features,
            overlap,
            saliency,
        })
    }

    /// What coarse points learn from their own cloud, from the other, and from their own again.
    fn attend(&self, pyramid: &Pyramid, bottleneck: &Matrix) -> Result<Attended> {
        let Some(coarsest) = pyramid.stages.last() else {
            return Err(Error::Internal("a pyramid without stages".to_owned()));
        };
        let [source, target] = coarsest.clouds();
        let graphs = [source, target].map(|points| Graph::new(points, self.config.neighbours));
        if graphs.iter().any(|graph| graph.degree() == 0) {
            return Err(Error::invalid(format!(
                "Predator needs at least 2 coarse points in each cloud ({} m apart), and here are {} and {}: \
                 the clouds are too small for the model, or their unit is not the metre",
                self.config.pyramid.voxel(self.config.pyramid.stages.saturating_sub(1)),
                source.len(),
                target.len()
            )));
        }
        let cpu = &self.cpu;
        let [first, second] = &self.graphs;
        let within = |layer: &EdgeConvolutions, [source, target]: &[Matrix; 2]| {
            Ok::<_, Error>([
                layer.apply(cpu, &graphs[0], source)?,
                layer.apply(cpu, &graphs[1], target)?,
            ])
        };
        let alone = within(first, &halves(bottleneck, coarsest.lengths))?;
        let mut together = alone.clone();
        self.attention.update(cpu, &mut together, 1, Turns::Other)?;
        let again = within(second, &together)?;
        let degrees = graphs.map(|graph| graph.degree());
        Ok(Attended { steps: [alone, together, again], degrees })
    }
}

fn stacked([source, target]: &[Matrix; 2]) -> Result<Matrix> {
    source.clone().stacked(target)
}

/// Features of unit length, overlap and saliency.
fn split(decoded: &Matrix, length: usize) -> Result<(Matrix, Vec<f32>, Vec<f32>)> {
    let rows = (0..decoded.rows()).map(|row| decoded.row(row).split_at(length));
    let values = rows.clone().flat_map(|(feature, _)| feature).copied().collect();
    let mut features = Matrix::new(decoded.rows(), length, values)?;
    unit_rows(&mut features);
    let scores = rows.map(|(_, scores)| match scores {
        [overlap, saliency] => [probability(*overlap), probability(*saliency)],
        _ => [0.0; 2],
    });
    let (overlap, saliency) = scores.map(|[overlap, saliency]| (overlap, saliency)).unzip();
    Ok((features, overlap, saliency))
}

/// The logistic function; what is not finite is worth nothing.
fn probability(value: f32) -> f32 {
    let probability = 1.0 / (1.0 + (-value).exp());
    if value.is_finite() { probability.clamp(0.0, 1.0) } else { 0.0 }
}
