//! The kernel point convolution.

use rare::{Error, Result};
use rayon::prelude::*;

use super::Point;
use super::pyramid::Neighbourhood;
use crate::Matrix;
use crate::engine::CpuBackend;
use crate::layers::{Linear, Weights};

/// Bytes of the features that are gathered at once.
pub(super) const BLOCK_BYTES: usize = 8 << 20;

/// Kernel points in a vector: the networks have 15.
const LANES: usize = 16;

/// Where the places of a vector that hold no kernel point are: out of reach.
const FAR: f32 = 1e18;

/// A rigid kernel point convolution with linear influence and summation (Thomas et al., ICCV 2019, equations 1 to 3).
///
/// Each neighbour `x` of a query `y` acts on kernel point `k` with the weight `max(0, 1 - |x - y - k| / sigma)`. The
/// weighted sums of features at each kernel point are multiplied by the matrix of that point and added up. Two things are
/// those of the released networks: the sum is divided by the number of neighbours whose features have a positive sum, and
/// the positions of kernel points come from the weights.
pub(crate) struct KernelPointConvolution {
    /// x, y and z of all kernel points.
    kernel: [[f32; LANES]; 3],
    points: usize,
    reciprocal_sigma: f32,
    inputs: usize,
    /// The matrices of all kernel points, one below the other.
    linear: Linear,
    bias: Option<Vec<f32>>,
}

impl KernelPointConvolution {
    /// Reads `name.weights` (kernel points x inputs x outputs), `name.kernel_points` and, if the network has it,
    /// `name.bias`; `sigma` in metres.
    ///
    /// # Errors
    /// Those of [`Weights::values`]; `Internal` if the layout has other shapes.
    pub(crate) fn load(
        cpu: &CpuBackend,
        weights: &Weights<'_>,
        name: &str,
        sigma: f64,
    ) -> Result<KernelPointConvolution> {
        let [tensor, kernel, bias] =
            ["weights", "kernel_points", "bias"].map(|part| format!("{name}.{part}"));
        let &[points, inputs, outputs] = weights.shape(&tensor)? else {
            return Err(Error::Internal(format!("{tensor} is no tensor of three sizes")));
        };
        if points > LANES || weights.shape(&kernel)? != [points, 3] {
            return Err(Error::Internal(format!("{kernel} is no list of at most {LANES} points")));
        }
        let mut positions = [[FAR; LANES]; 3];
        for (index, point) in weights.values(&kernel)?.chunks_exact(3).enumerate() {
            for (axis, coordinate) in positions.iter_mut().zip(point) {
                axis[index] = *coordinate;
            }
        }
        let matrix = Matrix::new(points * inputs, outputs, weights.values(&tensor)?)?.transposed();
        Ok(KernelPointConvolution {
            kernel: positions,
            points,
            reciprocal_sigma: (1.0 / sigma) as f32,
            inputs,
            linear: Linear::new(cpu, matrix, None)?,
            bias: if weights.has(&bias) { Some(weights.values(&bias)?) } else { None },
        })
    }

    /// A row for each query from a row for each support point.
    ///
    /// # Errors
    /// `Internal` if there are not as many rows as support points, or they have another length.
    pub(crate) fn apply(
        &self,
        cpu: &CpuBackend,
        around: Neighbourhood<'_>,
        features: &Matrix,
    ) -> Result<Matrix> {
        let (rows, columns) = (features.rows(), features.columns());
        if (rows, columns) != (around.support.len(), self.inputs) {
            return Err(Error::Internal(format!(
                "{rows} rows of {columns} numbers for a convolution of {} inputs at {} points",
                self.inputs,
                around.support.len()
            )));
        }
        let positive = positive(features);
        let width = self.points * self.inputs;
        let block = (BLOCK_BYTES / (4 * width.max(1))).max(1);
        let mut result = Vec::new();
        // In blocks, because gathered features are fifteen times as many as features.
        for first in (0..around.queries.len()).step_by(block) {
            let last = (first + block).min(around.queries.len());
            let mut gathered = Matrix::filled(last - first, width, 0.0);
            gathered.values_mut().par_chunks_mut(width.max(1)).enumerate().for_each(
                |(row, sums)| {
                    self.gather(around, first + row, features, sums);
                },
            );
            result.extend(self.linear.apply(cpu, &gathered)?.into_values());
        }
        let columns = result.len().checked_div(around.queries.len()).unwrap_or(0);
        let mut result = Matrix::new(around.queries.len(), columns, result)?;
        self.normalise(around, &positive, &mut result);
        Ok(result)
    }

    /// Adds the features of the neighbours of a query to the sums of the kernel points that they act on.
    fn gather(&self, around: Neighbourhood<'_>, query: usize, features: &Matrix, sums: &mut [f32]) {
        let Some(center) = around.queries.get(query) else { return };
        for &index in around.neighbours.row(query) {
            let index = index as usize;
            // What fills up the rows stands for no point.
            let Some(point) = around.support.get(index) else { break };
            let row = features.row(index);
            let influences = self.influences([0, 1, 2].map(|axis| point[axis] - center[axis]));
            for (sums, influence) in sums.chunks_exact_mut(self.inputs).zip(influences) {
                if influence > 0.0 {
                    sums.iter_mut().zip(row).for_each(|(sum, value)| *sum += influence * value);
                }
            }
        }
    }

    /// How much a neighbour at `offset` acts on each kernel point (equation 3).
    fn influences(&self, offset: Point) -> [f32; LANES] {
        let mut influences = [0.0; LANES];
        for (lane, influence) in influences.iter_mut().enumerate() {
            let [x, y, z] = [0, 1, 2].map(|axis| offset[axis] - self.kernel[axis][lane]);
            let distance = (x * x + y * y + z * z).sqrt();
            *influence = (1.0 - distance * self.reciprocal_sigma).max(0.0);
        }
        influences
    }

    /// Divides by the number of neighbours with positive features, then adds the bias.
    fn normalise(&self, around: Neighbourhood<'_>, positive: &[bool], result: &mut Matrix) {
        let columns = result.columns().max(1);
        result.values_mut().par_chunks_mut(columns).enumerate().for_each(|(query, row)| {
            let is_positive = |&&index: &&u32| positive.get(index as usize).copied() == Some(true);
            let count = around.neighbours.row(query).iter().filter(is_positive).count().max(1);
            let share = 1.0 / count as f32;
            match &self.bias {
                Some(bias) => {
                    let pairs = row.iter_mut().zip(bias);
                    pairs.for_each(|(value, bias)| *value = *value * share + bias);
                }
                None => row.iter_mut().for_each(|value| *value *= share),
            }
        });
    }
}

/// Whether the features of each point have a positive sum.
fn positive(features: &Matrix) -> Vec<bool> {
    let columns = features.columns().max(1);
    features.values().par_chunks(columns).map(|row| row.iter().sum::<f32>() > 0.0).collect()
}

#[cfg(test)]
mod tests {
    use rare::random::Random;

    use super::super::neighbours;
    use super::*;
    use crate::engine::Precision;

    #[test]
    fn convolutions_are_those_of_the_definition() {
        let mut random = Random::new(3, 0);
        let mut number = || (2.0 * random.uniform() - 1.0) as f32;
        let (points, inputs, outputs, sigma) = (15, 5, 7, 0.5);
        let kernel: Vec<Point> = (0..points).map(|_| [number(), number(), number()]).collect();
        let weights: Vec<f32> = (0..points * inputs * outputs).map(|_| number()).collect();
        let support: Vec<Point> = (0..200).map(|_| [number(), number(), number()]).collect();
        let bias: Vec<f32> = (0..outputs).map(|_| number()).collect();
        let features =
            Matrix::new(200, inputs, (0..200 * inputs).map(|_| number()).collect()).unwrap();
        let cpu = CpuBackend::new(Precision::F32).unwrap();
        let mut positions = [[FAR; LANES]; 3];
        for (index, point) in kernel.iter().enumerate() {
            (0..3).for_each(|axis| positions[axis][index] = point[axis]);
        }
        let matrix = Matrix::new(points * inputs, outputs, weights.clone()).unwrap().transposed();
        let layer = KernelPointConvolution {
            kernel: positions,
            points,
            reciprocal_sigma: (1.0 / sigma) as f32,
            inputs,
            linear: Linear::new(&cpu, matrix, None).unwrap(),
            bias: Some(bias.clone()),
        };
        let queries = &support[..50];
        let lengths = [[50, 0], [200, 0]];
        // Most rows are filled up.
        let found = neighbours([queries, &support], lengths, 0.6, 60).unwrap();
        let around = Neighbourhood { queries, support: &support, neighbours: &found };
        let result = layer.apply(&cpu, around, &features).unwrap();
        for (query, center) in queries.iter().enumerate() {
            let near: Vec<usize> = found
                .row(query)
                .iter()
                .map(|&index| index as usize)
                .filter(|&index| index < 200)
                .collect();
            let positive =
                near.iter().filter(|&&index| features.row(index).iter().sum::<f32>() > 0.0);
            let share = 1.0 / positive.count().max(1) as f64;
            for output in 0..outputs {
                let mut sum = 0.0;
                for &index in &near {
                    for (k, kernel) in kernel.iter().enumerate() {
                        let offset = (0..3).map(|axis| {
                            f64::from(support[index][axis] - center[axis] - kernel[axis]).powi(2)
                        });
                        let influence = (1.0 - offset.sum::<f64>().sqrt() / sigma).max(0.0);
                        for (input, value) in features.row(index).iter().enumerate() {
                            let weight = weights[(k * inputs + input) * outputs + output];
                            sum += influence * f64::from(*value) * f64::from(weight);
                        }
                    }
                }
                let expected = sum * share + f64::from(bias[output]);
                let difference = (f64::from(result.row(query)[output]) - expected).abs();
                assert!(difference < 1e-5, "{query} {output}: {difference}");
            }
        }
        assert!(layer.apply(&cpu, around, &result).is_err());
    }
}
