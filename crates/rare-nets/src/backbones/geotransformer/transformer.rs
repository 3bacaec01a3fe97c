//! The geometric transformer of the superpoints (Qin et al., CVPR 2022, section 3.2).

use rare::Result;

use super::TransformerConfig;
use super::attention::AttentionLayer;
use super::backbone::Watch;
use super::embedding::GeometricEmbedding;
use crate::Matrix;
use crate::backbones::kpconv::Point;
use crate::engine::CpuBackend;
use crate::layers::{Linear, Weights, unit_rows};

/// Layers of attention inside each cloud and between them, in turn.
pub(super) struct Transformer {
    pub(super) embedding: GeometricEmbedding,
    input: Linear,
    layers: Vec<AttentionLayer>,
    output: Linear,
}

impl Transformer {
    pub(super) fn load(
        cpu: &CpuBackend,
        weights: &Weights<'_>,
        config: &TransformerConfig,
    ) -> Result<Transformer> {
        let layer = |number: usize| {
            let name = format!("transformer.transformer.layers.{number}");
            AttentionLayer::load(cpu, weights, &name, config.heads)
        };
        Ok(Transformer {
            embedding: GeometricEmbedding::load(cpu, weights, config)?,
            input: weights.linear(cpu, "transformer.in_proj")?,
            layers: (0..2 * config.blocks).map(layer).collect::<Result<_>>()?,
            output: weights.linear(cpu, "transformer.out_proj")?,
        })
    }

    /// Features of the superpoints of target and source that know of each other, of unit length.
    pub(super) fn apply(
        &self,
        cpu: &CpuBackend,
        points: [&[Point]; 2],
        features: &[Matrix; 2],
        watch: &mut Watch<'_>,
    ) -> Result<[Matrix; 2]> {
        let arrangements =
            [self.embedding.arrangement(points[0])?, self.embedding.arrangement(points[1])?];
        let distance = self.embedding.distances(cpu, &arrangements)?;
        let pairs = self.embedding.of_pairs(&distance);
        let mut target = self.input.apply(cpu, &features[0])?;
        let mut source = self.input.apply(cpu, &features[1])?;
        for (number, layer) in self.layers.iter().enumerate() {
            if number % 2 == 0 {
                target = layer.inside(cpu, &target, pairs, &arrangements[0])?;
                source = layer.inside(cpu, &source, pairs, &arrangements[1])?;
            } else {
                // One after the other: the source sees what the target has become.
                target = layer.between(cpu, &target, &source)?;
                source = layer.between(cpu, &source, &target)?;
            }
            watch(&format!("transformer.layer{number}.ref"), &target);
            watch(&format!("transformer.layer{number}.src"), &source);
        }
        let mut result = [self.output.apply(cpu, &target)?, self.output.apply(cpu, &source)?];
        result.iter_mut().for_each(unit_rows);
        Ok(result)
    }
}
