//! Features of superpoints and points: a feature pyramid of kernel point convolutions (Qin et al., CVPR 2022, section
//! 3.1).

use rare::Result;

use super::GeoTransformerConfig;
use crate::Matrix;
use crate::backbones::kpconv::{
    ConvolutionBlock, NormalizationKind, Pyramid, ResidualBlock, Unary, upsample,
};
use crate::engine::CpuBackend;
use crate::layers::{Activation, Linear, Weights};

/// Receives what each part of the network computes, under the part's name in the checkpoint.
pub type Watch<'a> = dyn FnMut(&str, &Matrix) + 'a;

/// Encoder and decoder.
pub(super) struct Backbone {
    first: ConvolutionBlock,
    /// The residual blocks of each stage.
    encoder: Vec<Vec<ResidualBlock>>,
    /// From the second coarsest stage up to the third finest.
    decoder: Vec<Unary>,
    last: Linear,
}

/// What the backbone says of both clouds together, the rows of one below those of the other.
pub(super) struct BackboneFeatures {
    /// A row for each superpoint, which are the points of the coarsest stage.
    pub(super) superpoints: Matrix,
    /// A row for each point of the second finest stage.
    pub(super) points: Matrix,
}

impl Backbone {
    pub(super) fn load(
        cpu: &CpuBackend,
        weights: &Weights<'_>,
        config: &GeoTransformerConfig,
    ) -> Result<Backbone> {
        let kind = NormalizationKind::Group(config.groups);
        let sigma = |stage: usize| config.pyramid.sigma(stage);
        let block = |stage: usize, number: usize| {
            let name = format!("backbone.encoder{}_{number}", stage + 1);
            let strided = stage > 0 && number == 1;
            // A strided block starts at the finer stage.
            let sigma = sigma(if strided { stage - 1 } else { stage });
            ResidualBlock::load(cpu, weights, &name, kind, sigma, strided)
        };
        let stages = config.pyramid.stages;
        let numbers = |stage: usize| if stage == 0 { 2..=2 } else { 1..=3 };
        let encoder =
            (0..stages).map(|stage| numbers(stage).map(|number| block(stage, number)).collect());
        let unary = |stage: usize| {
            let name = format!("backbone.decoder{}", stage + 1);
            Unary::load(cpu, weights, &name, kind, Activation::LeakyRelu)
        };
        let name = "backbone.encoder1_1";
        Ok(Backbone {
            first: ConvolutionBlock::load(cpu, weights, name, kind, sigma(0))?,
            encoder: encoder.collect::<Result<_>>()?,
            decoder: (2..stages.saturating_sub(1)).rev().map(unary).collect::<Result<_>>()?,
            last: weights.linear(cpu, "backbone.decoder2.mlp")?,
        })
    }

    /// From ones at the points of the finest stage to features of the coarsest and second finest.
    pub(super) fn apply(
        &self,
        cpu: &CpuBackend,
        pyramid: &Pyramid,
        watch: &mut Watch<'_>,
    ) -> Result<BackboneFeatures> {
        let encoded = self.encode(cpu, pyramid, watch)?;
        let mut decoded: Option<Matrix> = None;
        // From coarse to fine; features of the finest stage are not wanted.
        for (stage, skipped) in encoded.iter().enumerate().skip(1).rev().skip(1) {
            let coarser = decoded.as_ref().or(encoded.last());
            let (Some(coarser), Some(points)) = (coarser, pyramid.stages.get(stage)) else { break };
            let joined = upsample(points, coarser).beside(skipped)?;
            let from_coarsest = encoded.len() - 2 - stage;
            let result = match self.decoder.get(from_coarsest) {
                Some(unary) => unary.apply(cpu, &joined)?,
                None => self.last.apply(cpu, &joined)?,
            };
            watch(&format!("backbone.decoder{}", stage + 1), &result);
            decoded = Some(result);
        }
        let superpoints = encoded.into_iter().next_back();
        let missing = || rare::Error::Internal("a pyramid of fewer than three stages".to_owned());
        Ok(BackboneFeatures {
            superpoints: superpoints.ok_or_else(missing)?,
            points: decoded.ok_or_else(missing)?,
        })
    }

    /// The features of all stages.
    fn encode(
        &self,
        cpu: &CpuBackend,
        pyramid: &Pyramid,
        watch: &mut Watch<'_>,
    ) -> Result<Vec<Matrix>> {
        let points = pyramid.stages.first().map_or(0, |stage| stage.points.len());
        let mut features = self.first.apply(cpu, pyramid, 0, &Matrix::filled(points, 1, 1.0))?;
        watch("backbone.encoder1_1", &features);
        let mut encoded = Vec::new();
        for (stage, blocks) in self.encoder.iter().enumerate() {
            for (index, block) in blocks.iter().enumerate() {
                // The first block of all stages but the finest comes down from the stage before.
                let level = if index == 0 { stage.saturating_sub(1) } else { stage };
                features = block.apply(cpu, pyramid, level, &features)?;
                let number = if stage == 0 { 2 } else { index + 1 };
                watch(&format!("backbone.encoder{}_{number}", stage + 1), &features);
            }
            encoded.push(features.clone());
        }
        Ok(encoded)
    }
}
