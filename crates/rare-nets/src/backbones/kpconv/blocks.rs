//! What surrounds the convolutions: linear layers, normalisations and shortcuts.

use rare::Result;
use rayon::prelude::*;

use super::convolution::KernelPointConvolution;
use super::pyramid::Neighbourhood;
use super::{Pyramid, Stage};
use crate::Matrix;
use crate::engine::CpuBackend;
use crate::layers::{Activation, Linear, Weights, group_normalization, instance_normalization};

/// How the layers of a network are normalised, over all points of both clouds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum NormalizationKind {
    /// So many groups of channels, with a factor and a summand for each channel (`GeoTransformer`).
    Group(usize),
    /// Each channel for itself, without parameters (Predator, CoFiNet).
    Instance,
}

/// A normalisation with its parameters.
enum Normalization {
    Group { groups: usize, scale: Vec<f32>, shift: Vec<f32> },
    Instance,
}

impl Normalization {
    /// Reads `name.norm.weight` and `name.norm.bias` if the kind has parameters.
    fn load(weights: &Weights<'_>, name: &str, kind: NormalizationKind) -> Result<Normalization> {
        Ok(match kind {
            NormalizationKind::Instance => Normalization::Instance,
            NormalizationKind::Group(groups) => Normalization::Group {
                groups,
                scale: weights.values(&format!("{name}.norm.weight"))?,
                shift: weights.values(&format!("{name}.norm.bias"))?,
            },
        })
    }

    fn apply(&self, matrix: &mut Matrix, activation: Activation) -> Result<()> {
        match self {
            Normalization::Group { groups, scale, shift } => {
                group_normalization(matrix, *groups, scale, shift, activation)
            }
            Normalization::Instance => {
                instance_normalization(matrix, activation);
                Ok(())
            }
        }
    }
}

/// A linear layer, a normalisation and an activation.
pub(crate) struct Unary {
    linear: Linear,
    normalization: Normalization,
    activation: Activation,
}

impl Unary {
    /// Reads `name.mlp` and the normalisation `name.norm`.
    ///
    /// # Errors
    /// Those of [`Weights::linear`].
    pub(crate) fn load(
        cpu: &CpuBackend,
        weights: &Weights<'_>,
        name: &str,
        kind: NormalizationKind,
        activation: Activation,
    ) -> Result<Unary> {
        Ok(Unary {
            linear: weights.linear(cpu, &format!("{name}.mlp"))?,
            normalization: Normalization::load(weights, &format!("{name}.norm"), kind)?,
            activation,
        })
    }

    /// Applies it to the rows of both clouds.
    ///
    /// # Errors
    /// `Internal` if the rows have another length.
    pub(crate) fn apply(&self, cpu: &CpuBackend, input: &Matrix) -> Result<Matrix> {
        let mut result = self.linear.apply(cpu, input)?;
        self.normalization.apply(&mut result, self.activation)?;
        Ok(result)
    }
}

/// The first layer: a convolution, a normalisation, an activation.
pub(crate) struct ConvolutionBlock {
    convolution: KernelPointConvolution,
    normalization: Normalization,
}

impl ConvolutionBlock {
    /// Reads `name.KPConv` and the normalisation `name.norm`; `sigma` in metres.
    ///
    /// # Errors
    /// Those of [`KernelPointConvolution::load`].
    pub(crate) fn load(
        cpu: &CpuBackend,
        weights: &Weights<'_>,
        name: &str,
        kind: NormalizationKind,
        sigma: f64,
    ) -> Result<ConvolutionBlock> {
        let convolution = format!("{name}.KPConv");
        Ok(ConvolutionBlock {
            convolution: KernelPointConvolution::load(cpu, weights, &convolution, sigma)?,
            normalization: Normalization::load(weights, &format!("{name}.norm"), kind)?,
        })
    }

    /// Applies it to the points of a stage.
    ///
    /// # Errors
    /// `Internal` if the input does not fit.
    pub(crate) fn apply(
        &self,
        cpu: &CpuBackend,
        pyramid: &Pyramid,
        level: usize,
        input: &Matrix,
    ) -> Result<Matrix> {
        let around = pyramid.neighbourhood(level, false)?;
        let mut result = self.convolution.apply(cpu, around, input)?;
        self.normalization.apply(&mut result, Activation::LeakyRelu)?;
        Ok(result)
    }
}

/// A bottleneck around a convolution, and a shortcut (He et al., 2016; Thomas et al., ICCV 2019).
pub(crate) struct ResidualBlock {
    narrow: Option<Unary>,
    convolution: KernelPointConvolution,
    normalization: Normalization,
    widen: Unary,
    shortcut: Option<Unary>,
    strided: bool,
}

impl ResidualBlock {
    /// Reads `name.unary1` if the network has it, `name.KPConv`, the normalisation `name.norm_conv`, `name.unary2` and,
    /// if the network has it, `name.unary_shortcut`; `sigma` in metres. A strided block goes to the next coarser stage;
    /// its `sigma` is that of the finer one.
    ///
    /// # Errors
    /// Those of [`KernelPointConvolution::load`].
    pub(crate) fn load(
        cpu: &CpuBackend,
        weights: &Weights<'_>,
        name: &str,
        kind: NormalizationKind,
        sigma: f64,
        strided: bool,
    ) -> Result<ResidualBlock> {
        let unary = |part: &str, activation: Activation| {
            let name = format!("{name}.{part}");
            let there = weights.has(&format!("{name}.mlp.weight"));
            there.then(|| Unary::load(cpu, weights, &name, kind, activation)).transpose()
        };
        let convolution = format!("{name}.KPConv");
        let widen = format!("{name}.unary2");
        Ok(ResidualBlock {
            narrow: unary("unary1", Activation::LeakyRelu)?,
            convolution: KernelPointConvolution::load(cpu, weights, &convolution, sigma)?,
            normalization: Normalization::load(weights, &format!("{name}.norm_conv"), kind)?,
            widen: Unary::load(cpu, weights, &widen, kind, Activation::None)?,
            shortcut: unary("unary_shortcut", Activation::None)?,
            strided,
        })
    }

    /// Applies it to the points of stage `level`.
    ///
    /// # Errors
    /// `Internal` if the input does not fit.
    pub(crate) fn apply(
        &self,
        cpu: &CpuBackend,
        pyramid: &Pyramid,
        level: usize,
        input: &Matrix,
    ) -> Result<Matrix> {
        let around = pyramid.neighbourhood(level, self.strided)?;
        let narrowed = self.narrow.as_ref().map(|unary| unary.apply(cpu, input)).transpose()?;
        let mut inner = self.convolution.apply(cpu, around, narrowed.as_ref().unwrap_or(input))?;
        drop(narrowed);
        self.normalization.apply(&mut inner, Activation::LeakyRelu)?;
        let mut result = self.widen.apply(cpu, &inner)?;
        let pooled = self.strided.then(|| largest(around, input));
        let skipped = pooled.as_ref().unwrap_or(input);
        match &self.shortcut {
            Some(shortcut) => result.add(&shortcut.apply(cpu, skipped)?)?,
            None => result.add(skipped)?,
        }
        Activation::LeakyRelu.apply_to(result.values_mut());
        Ok(result)
    }
}

/// The largest value of each channel among the neighbours of each query; no neighbour is a row of zeros.
fn largest(around: Neighbourhood<'_>, features: &Matrix) -> Matrix {
    let mut result = Matrix::filled(around.queries.len(), features.columns(), f32::NEG_INFINITY);
    let columns = features.columns().max(1);
    result.values_mut().par_chunks_mut(columns).enumerate().for_each(|(query, row)| {
        for &index in around.neighbours.row(query) {
            let index = index as usize;
            if index >= features.rows() {
                row.iter_mut().for_each(|value| *value = value.max(0.0));
                break;
            }
            row.iter_mut()
                .zip(features.row(index))
                .for_each(|(value, other)| *value = value.max(*other));
        }
    });
    result
}

/// The features of the nearest coarser point for each point of a stage; zeros if none is near.
pub(crate) fn upsample(stage: &Stage, coarser: &Matrix) -> Matrix {
    coarser.gather(stage.upsampling.iter().map(|&index| index as usize))
}
