//! Sparse convolutions with the batch normalisation behind them folded in.

use rare::{Error, Result};
use rayon::prelude::*;

use super::coordinates::CoordinateMap;
use super::kernel_map::{KernelMap, offsets, shifted};
use crate::Matrix;
use crate::engine::CpuBackend;
use crate::layers::{Linear, Weights};

/// Added to variances.
const EPSILON: f64 = 1e-5;

/// A kernel, `offsets x inputs x outputs`, and a summand per output.
struct Kernel {
    values: Vec<f32>,
    inputs: usize,
    outputs: usize,
    bias: Vec<f32>,
}

impl Kernel {
    /// The kernel `convolution.kernel` and the normalisation `normalization.bn` (Ioffe and Szegedy, 2015) with the moments
    /// of the training, which is a factor and a summand per output: the factor goes into the kernel.
    fn read(weights: &Weights<'_>, convolution: &str, normalization: &str) -> Result<Kernel> {
        let name = format!("{convolution}.kernel");
        let [_, inputs, outputs] = *weights.shape(&name)? else {
            return Err(Error::Internal(format!("{name} is no kernel")));
        };
        let affine = affine(weights, normalization)?;
        let mut values = weights.values(&name)?;
        for row in values.chunks_exact_mut(outputs.max(1)) {
            row.iter_mut().zip(&affine).for_each(|(value, (factor, _))| *value *= factor);
        }
        let bias = affine.into_iter().map(|(_, summand)| summand).collect();
        Ok(Kernel { values, inputs, outputs, bias })
    }
}

/// The factor and the summand of each channel.
fn affine(weights: &Weights<'_>, name: &str) -> Result<Vec<(f32, f32)>> {
    let read = |part: &str| weights.values(&format!("{name}.bn.{part}"));
    let (scale, shift) = (read("weight")?, read("bias")?);
    let (mean, variance) = (read("running_mean")?, read("running_var")?);
    if let Some(bad) = variance.iter().find(|value| **value < 0.0) {
        return Err(Error::invalid(format!(
            "{name}.bn.running_var holds {bad}, and no variance is negative: the weights are damaged"
        )));
    }
    let channels = scale.iter().zip(&shift).zip(mean.iter().zip(&variance));
    let affine = channels.map(|((&scale, &shift), (&mean, &variance))| {
        let factor = f64::from(scale) / (f64::from(variance) + EPSILON).sqrt();
        (factor as f32, (f64::from(shift) - f64::from(mean) * factor) as f32)
    });
    Ok(affine.collect())
}

/// A convolution of features: one linear layer for each offset.
pub(super) struct SparseConvolution {
    layers: Vec<Linear>,
    bias: Vec<f32>,
}

impl SparseConvolution {
    /// Reads the kernel and the normalisation.
    pub(super) fn read(
        cpu: &CpuBackend,
        weights: &Weights<'_>,
        convolution: &str,
        normalization: &str,
    ) -> Result<SparseConvolution> {
        let kernel = Kernel::read(weights, convolution, normalization)?;
        let layers = kernel
            .values
            .chunks_exact((kernel.inputs * kernel.outputs).max(1))
            .map(|part| {
                let part = Matrix::new(kernel.inputs, kernel.outputs, part.to_vec())?;
                Linear::new(cpu, part.transposed(), None)
            })
            .collect::<Result<_>>()?;
        Ok(SparseConvolution { layers, bias: kernel.bias })
    }

    /// Gathers the inputs of each offset, multiplies, and adds the products to the outputs, one offset after the other.
    pub(super) fn apply(
        &self,
        cpu: &CpuBackend,
        input: &Matrix,
        map: &KernelMap,
    ) -> Result<Matrix> {
        let mut output = rows_of(&self.bias, map.outputs)?;
        for (layer, pairs) in self.layers.iter().zip(&map.pairs) {
            let inputs = input.gather(pairs.iter().map(|&[from, _]| from as usize));
            scatter(&layer.apply(cpu, &inputs)?, pairs, &mut output);
        }
        Ok(output)
    }
}

/// The convolution of a cloud whose voxels all have the feature 1.
///
/// The product with 1 is the kernel itself, so its rows are added up where a voxel is found.
pub(super) struct FirstConvolution {
    kernel: Matrix,
    bias: Vec<f32>,
    side: usize,
}

impl FirstConvolution {
    /// Reads the kernel, of `side` offsets along an edge, and the normalisation.
    pub(super) fn read(
        weights: &Weights<'_>,
        convolution: &str,
        normalization: &str,
        side: usize,
    ) -> Result<FirstConvolution> {
        let Kernel { values, inputs, outputs, bias } =
            Kernel::read(weights, convolution, normalization)?;
        let rows = inputs * side * side * side;
        Ok(FirstConvolution { kernel: Matrix::new(rows, outputs, values)?, bias, side })
    }

    /// Features of the voxels.
    pub(super) fn apply(&self, voxels: &CoordinateMap) -> Result<Matrix> {
        let offsets = offsets(self.side, voxels.stride());
        let mut output = rows_of(&self.bias, voxels.len())?;
        let rows = output.values_mut().par_chunks_mut(self.bias.len().max(1));
        rows.zip(voxels.coordinates()).for_each(|(row, &at)| {
            for (index, &offset) in offsets.iter().enumerate() {
                if voxels.find(shifted(at, offset)).is_some() {
                    add(row, self.kernel.row(index));
                }
            }
        });
        Ok(output)
    }
}

/// The same row again and again.
fn rows_of(row: &[f32], rows: usize) -> Result<Matrix> {
    Matrix::new(rows, row.len(), row.repeat(rows))
}

/// Adds each product to the row of its output.
fn scatter(products: &Matrix, pairs: &[[u32; 2]], output: &mut Matrix) {
    let columns = output.columns().max(1);
    let values = output.values_mut();
    for (index, &[_, to]) in pairs.iter().enumerate() {
        let first = to as usize * columns;
        if let Some(row) = values.get_mut(first..first + columns) {
            add(row, products.row(index));
        }
    }
}

fn add(row: &mut [f32], other: &[f32]) {
    row.iter_mut().zip(other).for_each(|(value, other)| *value += other);
}
