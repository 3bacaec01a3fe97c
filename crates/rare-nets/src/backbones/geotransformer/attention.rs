//! A layer of attention and the layers after it (Vaswani et al., 2017; Qin et al., CVPR 2022, equations 4 and 5).

use rare::Result;
use rayon::prelude::*;

use super::embedding::Arrangement;
use crate::Matrix;
use crate::engine::{CpuBackend, PairEmbedding};
use crate::layers::{Activation, Linear, Weights, layer_normalization, products};

/// Attention with several heads, each a range of channels, then a network of two layers; each is added to its input and
/// normalised.
pub(super) struct AttentionLayer {
    heads: usize,
    query: Linear,
    key: Linear,
    value: Linear,
    /// For each head the layer that takes its queries to the embedding of pairs; none between clouds.
    relative: Vec<Linear>,
    merge: Linear,
    merged: Affine,
    expand: Linear,
    squeeze: Linear,
    squeezed: Affine,
}

/// Factor and summand of the channels of a normalisation.
struct Affine {
    scale: Vec<f32>,
    shift: Vec<f32>,
}

impl AttentionLayer {
    pub(super) fn load(
        cpu: &CpuBackend,
        weights: &Weights<'_>,
        name: &str,
        heads: usize,
    ) -> Result<AttentionLayer> {
        let linear = |part: &str| weights.linear(cpu, &format!("{name}.{part}"));
        let affine = |part: &str| {
            let values = |which: &str| weights.values(&format!("{name}.{part}.{which}"));
            Ok::<_, rare::Error>(Affine { scale: values("weight")?, shift: values("bias")? })
        };
        Ok(AttentionLayer {
            heads: heads.max(1),
            query: linear("attention.attention.proj_q")?,
            key: linear("attention.attention.proj_k")?,
            value: linear("attention.attention.proj_v")?,
            relative: relative(cpu, weights, name, heads.max(1))?,
            merge: linear("attention.linear")?,
            merged: affine("attention.norm")?,
            expand: linear("output.expand")?,
            squeeze: linear("output.squeeze")?,
            squeezed: affine("output.norm")?,
        })
    }

    /// Superpoints of a cloud attend to each other and their arrangement.
    pub(super) fn inside(
        &self,
        cpu: &CpuBackend,
        features: &Matrix,
        pairs: PairEmbedding<'_>,
        arrangement: &Arrangement,
    ) -> Result<Matrix> {
        self.layer(cpu, features, features, Some((pairs, arrangement)))
    }

    /// Superpoints of a cloud attend to those of the other.
    pub(super) fn between(
        &self,
        cpu: &CpuBackend,
        features: &Matrix,
        other: &Matrix,
    ) -> Result<Matrix> {
        self.layer(cpu, features, other, None)
    }

    fn layer(
        &self,
        cpu: &CpuBackend,
        features: &Matrix,
        other: &Matrix,
        pairs: Option<(PairEmbedding<'_>, &Arrangement)>,
    ) -> Result<Matrix> {
        let mut hidden = self.merge.apply(cpu, &self.attend(cpu, features, other, pairs)?)?;
        hidden.add(features)?;
        layer_normalization(&mut hidden, &self.merged.scale, &self.merged.shift);
        let mut expanded = self.expand.apply(cpu, &hidden)?;
        Activation::Relu.apply_to(expanded.values_mut());
        let mut result = self.squeeze.apply(cpu, &expanded)?;
        result.add(&hidden)?;
        layer_normalization(&mut result, &self.squeezed.scale, &self.squeezed.shift);
        Ok(result)
    }

    fn attend(
        &self,
        cpu: &CpuBackend,
        features: &Matrix,
        other: &Matrix,
        pairs: Option<(PairEmbedding<'_>, &Arrangement)>,
    ) -> Result<Matrix> {
        let queries = self.query.apply(cpu, features)?;
        let (keys, values) = (self.key.apply(cpu, other)?, self.value.apply(cpu, other)?);
        let relative = match pairs {
            Some((pairs, arrangement)) => Some(self.relative(cpu, &queries, pairs, arrangement)?),
            None => None,
        };
        let width = queries.columns() / self.heads;
        let mut attended = Matrix::filled(queries.rows(), 0, 0.0);
        for head in 0..self.heads {
            let part = |matrix: &Matrix| matrix.columns_from(head * width, width);
            let mut scores = products(cpu, &part(&queries), &part(&keys))?;
            if let Some(relative) = &relative {
                scores.add(&relative.columns_from(head * scores.columns(), scores.columns()))?;
            }
            softmax(&mut scores, 1.0 / (width.max(1) as f32).sqrt());
            let messages = products(cpu, &scores, &part(&values).transposed())?;
            attended = attended.beside(&messages)?;
        }
        Ok(attended)
    }

    /// For each superpoint, head by head, the inner products of its query with the embeddings of its pairs.
    ///
    /// A linear layer of the embedding is an inner product with the query taken through the layer's transpose: for each
    /// superpoint instead of for each pair. The layer's bias adds the same to all scores of a row, which the softmax
    /// takes away.
    fn relative(
        &self,
        cpu: &CpuBackend,
        queries: &Matrix,
        pairs: PairEmbedding<'_>,
        arrangement: &Arrangement,
    ) -> Result<Matrix> {
        let width = queries.columns() / self.heads;
        let through = |(head, layer): (usize, &Linear)| {
            layer.apply(cpu, &queries.columns_from(head * width, width))
        };
        let through: Vec<Matrix> =
            self.relative.iter().enumerate().map(through).collect::<Result<_>>()?;
        let row = |from: usize| {
            let (distances, angles) = arrangement.row(from);
            let queries: Vec<&[f32]> = through.iter().map(|head| head.row(from)).collect();
            pairs.products(cpu.processor(), distances, angles, &queries)
        };
        let rows: Vec<Vec<f32>> = (0..arrangement.count()).into_par_iter().map(row).collect();
        Ok(Matrix::from_rows(through.len() * arrangement.count(), rows.concat()))
    }
}

/// The transposes of the parts of `proj_p` that belong to each head, if there is such a layer.
fn relative(
    cpu: &CpuBackend,
    weights: &Weights<'_>,
    name: &str,
    heads: usize,
) -> Result<Vec<Linear>> {
    let name = format!("{name}.attention.attention.proj_p.weight");
    if !weights.has(&name) {
        return Ok(Vec::new());
    }
    let weight = weights.matrix(&name)?;
    let width = weight.rows() / heads;
    let head = |head: usize| Linear::new(cpu, weight.part(head * width, width).transposed(), None);
    (0..heads).map(head).collect()
}

/// Scaled scores become shares, row by row.
fn softmax(scores: &mut Matrix, scale: f32) {
    let columns = scores.columns().max(1);
    scores.values_mut().par_chunks_mut(columns).for_each(|row| {
        let largest = row.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        let mut sum = 0.0;
        for value in row.iter_mut() {
            *value = ((*value - largest) * scale).exp();
            sum += *value;
        }
        row.iter_mut().for_each(|value| *value /= sum);
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_of_a_row_add_up_to_one() {
        let mut scores = Matrix::new(2, 3, vec![0.0, 2.0_f32.ln(), 0.0, 1e4, 0.0, -1e4]).unwrap();
        softmax(&mut scores, 1.0);
        for (found, expected) in scores.values().iter().zip([0.25, 0.5, 0.25, 1.0, 0.0, 0.0]) {
            assert!((found - expected).abs() < 1e-6, "{found} {expected}");
        }
    }
}
