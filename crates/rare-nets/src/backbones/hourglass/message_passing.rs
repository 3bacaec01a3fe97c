//! Attention between points, and what it changes (Sarlin et al.: `SuperGlue`, CVPR 2020).

use rare::{Error, Result};

use crate::Matrix;
use crate::checkpoint::Layout;
use crate::engine::{Backend, CpuBackend, Shape};
use crate::layers::{Activation, Linear, Weights, instance_normalization};

/// Attention of points to others, whose message goes through two layers and is added to the features of the points.
///
/// The published weights deal channels out to heads by turns: channel `c * heads + h` is number `c` of head `h`. The engine
/// wants the channels of a head side by side, so the weights are put into that order when they are read.
pub(in crate::backbones) struct MessagePassing {
    queries: Linear,
    /// Keys, then values.
    context: Linear,
    merge: Linear,
    widen: Linear,
    narrow: Linear,
    channels: usize,
    heads: usize,
}

/// Which cloud looks where.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::backbones) enum Turns {
    /// Each at itself.
    Own,
    /// The first at the second, then the second at the first, which has changed by then.
    Other,
}

impl MessagePassing {
    /// Adds the tensors of a layer `name` on so many channels.
    pub(in crate::backbones) fn add_to(layout: &mut Layout, name: &str, channels: usize) {
        for part in ["attn.proj.0", "attn.proj.1", "attn.proj.2", "attn.merge"] {
            pointwise(layout, &format!("{name}.{part}"), [channels, channels]);
        }
        pointwise(layout, &format!("{name}.mlp.0"), [2 * channels, 2 * channels]);
        pointwise(layout, &format!("{name}.mlp.3"), [2 * channels, channels]);
    }

    /// Reads the layer `name`.
    ///
    /// # Errors
    /// Those of [`Weights::values`]; `Internal` if the heads do not divide the channels.
    pub(in crate::backbones) fn read(
        cpu: &CpuBackend,
        weights: &Weights<'_>,
        name: &str,
        heads: usize,
    ) -> Result<MessagePassing> {
        let merge = weights.matrix(&format!("{name}.attn.merge.weight"))?;
        let channels = merge.rows();
        if heads == 0 || !channels.is_multiple_of(heads) {
            return Err(Error::Internal(format!(
                "{heads} heads do not divide {channels} channels"
            )));
        }
        let order =
            || (0..channels).map(|at| at % (channels / heads) * heads + at * heads / channels);
        let projection = |part: usize| -> Result<(Matrix, Vec<f32>)> {
            let name = format!("{name}.attn.proj.{part}");
            let bias = Matrix::new(channels, 1, weights.values(&format!("{name}.bias"))?)?;
            let weight = weights.matrix(&format!("{name}.weight"))?.gather(order());
            Ok((weight, bias.gather(order()).into_values()))
        };
        let [queries, keys, values] = [projection(0)?, projection(1)?, projection(2)?];
        let context_bias = [keys.1, values.1].concat();
        let merge = merge.transposed().gather(order()).transposed();
        let merge_bias = weights.values(&format!("{name}.attn.merge.bias"))?;
        Ok(MessagePassing {
            queries: Linear::new(cpu, queries.0, Some(&queries.1))?,
            context: Linear::new(cpu, keys.0.stacked(&values.0)?, Some(&context_bias))?,
            merge: Linear::new(cpu, merge, Some(&merge_bias))?,
            widen: weights.linear(cpu, &format!("{name}.mlp.0"))?,
            narrow: weights.linear(cpu, &format!("{name}.mlp.3"))?,
            channels,
            heads,
        })
    }

    /// Updates the features of two clouds. Each is made of `groups` equally large groups of points, and a group sees only
    /// its counterpart.
    ///
    /// # Errors
    /// `Internal` if the sizes do not fit.
    pub(in crate::backbones) fn update(
        &self,
        cpu: &CpuBackend,
        clouds: &mut [Matrix; 2],
        groups: usize,
        turns: Turns,
    ) -> Result<()> {
        let [first, second] = clouds;
        match turns {
            Turns::Own => {
                first.add(&self.change(cpu, first, first, groups)?)?;
                second.add(&self.change(cpu, second, second, groups)?)
            }
            Turns::Other => {
                first.add(&self.change(cpu, first, second, groups)?)?;
                second.add(&self.change(cpu, second, first, groups)?)
            }
        }
    }

    /// What is added to `features` when they look at `others`.
    fn change(
        &self,
        cpu: &CpuBackend,
        features: &Matrix,
        others: &Matrix,
        groups: usize,
    ) -> Result<Matrix> {
        let message = self.merge.apply(cpu, &self.attend(cpu, features, others, groups)?)?;
        let mut hidden = self.widen.apply(cpu, &features.beside(&message)?)?;
        normalise_groups(&mut hidden, groups)?;
        self.narrow.apply(cpu, &hidden)
    }

    fn attend(
        &self,
        cpu: &CpuBackend,
        features: &Matrix,
        others: &Matrix,
        groups: usize,
    ) -> Result<Matrix> {
        let queries = self.queries.apply(cpu, features)?;
        let context = self.context.apply(cpu, others)?;
        let sequence = |batch: usize, rows: usize, channels: usize| {
            let width = rows.checked_div(batch).unwrap_or_default();
            Shape { batch, height: 1, width, channels }
        };
        let shape = sequence(groups, queries.rows(), self.channels);
        let queries = cpu.upload(shape, queries.values())?;
        let each = context.rows().checked_div(groups).unwrap_or_default();
        let context = (0..groups)
            .map(|group| {
                let part = context.part(group * each, each);
                cpu.upload(sequence(1, each, 2 * self.channels), part.values())
            })
            .collect::<Result<Vec<_>>>()?;
        let context: Vec<_> = context.iter().collect();
        let message = cpu.cross_attention(&queries, &context, self.heads)?;
        Matrix::new(features.rows(), self.channels, cpu.download(&message)?)
    }
}

/// Normalises the channels of each group of rows for itself, then drops what is negative.
fn normalise_groups(matrix: &mut Matrix, groups: usize) -> Result<()> {
    if groups == 1 {
        instance_normalization(matrix, Activation::Relu);
        return Ok(());
    }
    let each = matrix.rows().checked_div(groups).unwrap_or_default();
    let columns = matrix.columns();
    for rows in matrix.values_mut().chunks_exact_mut((each * columns).max(1)) {
        let mut group = Matrix::new(each, columns, rows.to_vec())?;
        instance_normalization(&mut group, Activation::Relu);
        rows.copy_from_slice(group.values());
    }
    Ok(())
}

/// Adds a linear layer with bias that the file writes as a convolution of sequences.
pub(in crate::backbones) fn pointwise(
    layout: &mut Layout,
    name: &str,
    [inputs, outputs]: [usize; 2],
) {
    layout.insert(format!("{name}.weight"), vec![outputs, inputs, 1]);
    layout.insert(format!("{name}.bias"), vec![outputs]);
}
