//! The network, and what it computes on the way.

use rare::{Error, Result};

use super::CoFiNetConfig;
use super::coarse::{CoarsePair, coarse_pairs};
use super::fine::{FineMatching, FinePair, Sides};
use super::layout::{COARSE, layout};
use super::patches::Patches;
use crate::Matrix;
use crate::backbones::hourglass::{Decoder, Encoder, MessagePassing, Turns, halves};
use crate::backbones::kpconv::Pyramid;
use crate::checkpoint::Parameters;
use crate::engine::{CpuBackend, Precision, log_transport};
use crate::layers::{Linear, Weights, products};

/// The network with its weights (Yu et al.: `CoFiNet`, `NeurIPS` 2021).
pub struct CoFiNet {
    pub(super) config: CoFiNetConfig,
    cpu: CpuBackend,
    encoder: Encoder,
    bottleneck: Linear,
    attentions: [MessagePassing; 3],
    last: Linear,
    bin: f32,
    decoder: Decoder,
    fine: FineMatching,
}

/// What the network computes of a pair of clouds. Matrices have a row for each point, those of the source first; pairs of
/// matrices are source and target.
#[derive(Debug, Clone, PartialEq)]
pub struct Output {
    /// Features of the stages but the coarsest, the finest first.
    pub encoded: Vec<Matrix>,
    /// Features of the coarse points before the attention.
    pub bottleneck: Matrix,
    /// Features of the coarse points after each of the three attentions.
    pub attended: [[Matrix; 2]; 3],
    /// Features by which the coarse points are matched, and from which those of the fine points are made.
    pub coarse_features: [Matrix; 2],
    /// Features of the fine points.
    pub fine_features: Matrix,
    /// How sure it is of each pair of coarse points.
    pub coarse_confidences: Matrix,
    /// The coarse points that belong together.
    pub coarse_pairs: Vec<CoarsePair>,
    /// How many of them there would be without `CoFiNetConfig::most_pairs`.
    pub coarse_pairs_found: usize,
    /// The fine points around each coarse one.
    pub patches: [Patches; 2],
    /// For each coarse pair the logarithms of the confidences of all pairs of fine points, with slack.
    pub fine_scores: Vec<Matrix>,
    /// The fine points that belong together.
    pub fine_pairs: Vec<FinePair>,
}

impl CoFiNet {
    /// Takes the weights under their official names.
    ///
    /// # Errors
    /// `InvalidInput` if they are not the weights of this network or are damaged; `Io`, `Unsupported` as the file has it.
    pub fn load(parameters: &Parameters, config: CoFiNetConfig) -> Result<CoFiNet> {
        let layout = layout(&config);
        let network = format!("CoFiNet for {}", config.name);
        let weights = Weights::new(parameters, &layout, &network)?;
        let cpu = CpuBackend::new(Precision::F32)?;
        let attention = |name| MessagePassing::read(&cpu, &weights, name, config.heads);
        let [first, second, third] = COARSE;
        let (encoder, decoder) = ("encoder.encoder_blocks", "decoder.decoder_blocks");
        Ok(CoFiNet {
            encoder: Encoder::read(&cpu, &weights, encoder, &config.encoder(), &config.pyramid)?,
            bottleneck: weights.linear(&cpu, "encoder.bottle")?,
            attentions: [attention(first)?, attention(second)?, attention(third)?],
            last: weights.linear(&cpu, "final_proj")?,
            bin: weights.scalar("bin_score")?,
            decoder: Decoder::read(&cpu, &weights, decoder, &config.decoder())?,
            fine: FineMatching::read(&cpu, &weights, &config)?,
            config,
            cpu,
        })
    }

    /// Its settings.
    #[must_use]
    pub fn config(&self) -> &CoFiNetConfig {
        &self.config
    }

    /// Matches the two clouds of a pyramid, of which the first is the source.
    ///
    /// # Errors
    /// `Internal` if the pyramid has not the stages of the network.
    pub fn run(&self, pyramid: &Pyramid) -> Result<Output> {
        let cpu = &self.cpu;
        let (Some(finest), Some(coarsest)) = (pyramid.stages.first(), pyramid.stages.last()) else {
            return Err(Error::Internal("a pyramid without stages".to_owned()));
        };
        let encoded = self.encoder.apply(cpu, pyramid)?;
        let bottleneck = self.bottleneck.apply(cpu, &encoded.coarsest)?;
        let attended = self.attend(halves(&bottleneck, coarsest.lengths))?;
        let [.., [of_source, of_target]] = &attended;
        let coarse_features = [self.last.apply(cpu, of_source)?, self.last.apply(cpu, of_target)?];
        let together = coarse_features[0].clone().stacked(&coarse_features[1])?;
        let fine_features = self.decoder.apply(cpu, pyramid, encoded.skipped.clone(), together)?;
        let coarse_confidences = self.coarse_confidences(&coarse_features)?;
        let kept = coarse_pairs(&coarse_confidences, &self.config);
        let patches = [0, 1].map(|cloud| {
            Patches::new(finest.clouds()[cloud], coarsest.clouds()[cloud], self.config.patch)
        });
        let sides = halves(&fine_features, finest.lengths);
        let sides = Sides { features: sides.each_ref(), patches: patches.each_ref() };
        let matched = self.fine.apply(cpu, &sides, &kept.pairs)?;
        let fine_pairs = matched.iter().flat_map(|matched| &matched.pairs).copied().collect();
        Ok(Output {
            encoded: encoded.skipped,
            bottleneck,
            attended,
            coarse_features,
            fine_features,
            coarse_confidences,
            coarse_pairs: kept.pairs,
            coarse_pairs_found: kept.found,
            patches,
            fine_scores: matched.into_iter().map(|matched| matched.scores).collect(),
            fine_pairs,
        })
    }

    /// What the coarse points learn from each other.
    fn attend(&self, mut clouds: [Matrix; 2]) -> Result<[[Matrix; 2]; 3]> {
        let mut step = |attention: &MessagePassing, turns| {
            attention.update(&self.cpu, &mut clouds, 1, turns)?;
            Ok(clouds.clone())
        };
        let [first, second, third] = &self.attentions;
        Ok([step(first, Turns::Own)?, step(second, Turns::Other)?, step(third, Turns::Own)?])
    }

    /// The plan of optimal transport between the coarse points, without what finds no partner.
    fn coarse_confidences(&self, [source, target]: &[Matrix; 2]) -> Result<Matrix> {
        let mut scores = products(&self.cpu, source, target)?;
        let factor = 1.0 / (source.columns() as f32).sqrt();
        scores.values_mut().iter_mut().for_each(|score| *score *= factor);
        let iterations = self.config.iterations;
        let plan = log_transport(self.cpu.processor(), &scores, self.bin, iterations);
        let rows = (0..source.rows()).map(|row| plan.row(row).iter().take(target.rows()));
        let values = rows.flatten().map(|value| value.exp()).collect();
        Matrix::new(source.rows(), target.rows(), values)
    }
}
