//! Linear layers, and products of activations.

use rare::{Error, Result};

use crate::engine::{Arrangement, Backend, Convolution, CpuBackend, Kernel, PackedWeight, Shape};
use crate::{Matrix, Parameter, Values};

/// `rows x inputs -> rows x outputs`: `x W^T + b`.
pub(crate) struct Linear {
    weight: PackedWeight,
    inputs: usize,
    outputs: usize,
}

impl Linear {
    /// Packs `weight`, `outputs x inputs`, and a bias per output or none.
    ///
    /// # Errors
    /// `Internal` if the sizes do not fit.
    pub(crate) fn new(cpu: &CpuBackend, weight: Matrix, bias: Option<&[f32]>) -> Result<Linear> {
        let (outputs, inputs) = (weight.rows(), weight.columns());
        let values = Values::F32(weight.into_values());
        let parts = [Parameter { shape: vec![outputs, inputs], values }];
        let kernel = Kernel { parts: &parts, bias, arrangement: Arrangement::Plain };
        Ok(Linear { weight: cpu.pack(&kernel)?, inputs, outputs })
    }

    /// Applies the layer to each row.
    ///
    /// # Errors
    /// `Internal` if the rows are not as long as the layer wants them.
    pub(crate) fn apply(&self, cpu: &CpuBackend, input: &Matrix) -> Result<Matrix> {
        if input.columns() != self.inputs {
            return Err(Error::Internal(format!(
                "rows of {} numbers for a layer of {} inputs",
                input.columns(),
                self.inputs
            )));
        }
        if input.rows() == 0 {
            return Matrix::new(0, self.outputs, Vec::new());
        }
        let shape = Shape { batch: 1, height: 1, width: input.rows(), channels: input.columns() };
        let tensor = cpu.upload(shape, input.values())?;
        let product = cpu.convolve(&tensor, &self.weight, &Convolution::default())?;
        Matrix::new(input.rows(), self.outputs, cpu.download(&product)?)
    }
}

/// All inner products of the rows of `left` and `right`: `left.rows() x right.rows()`.
///
/// # Errors
/// `Internal` if the rows are not equally long.
pub(crate) fn products(cpu: &CpuBackend, left: &Matrix, right: &Matrix) -> Result<Matrix> {
    if left.rows() == 0 || right.rows() == 0 {
        return Ok(Matrix::filled(left.rows(), right.rows(), 0.0));
    }
    Linear::new(cpu, right.clone(), None)?.apply(cpu, left)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::Precision;

    #[test]
    fn a_layer_multiplies_and_adds() {
        let cpu = CpuBackend::new(Precision::F32).unwrap();
        let weight = Matrix::new(2, 3, vec![1.0, 2.0, 3.0, -1.0, 0.0, 1.0]).unwrap();
        let layer = Linear::new(&cpu, weight.clone(), Some(&[10.0, 20.0])).unwrap();
        let input = Matrix::new(2, 3, vec![1.0, 1.0, 1.0, 0.0, 2.0, -1.0]).unwrap();
        assert_eq!(layer.apply(&cpu, &input).unwrap().values(), [16.0, 20.0, 11.0, 19.0]);
        let products = products(&cpu, &input, &weight).unwrap();
        assert_eq!(products.values(), [6.0, 0.0, 1.0, -1.0]);
        assert_eq!(layer.apply(&cpu, &input.part(0, 0)).unwrap().rows(), 0);
        assert!(layer.apply(&cpu, &products).is_err());
    }

    #[test]
    fn products_of_any_size_are_those_of_the_definition() {
        let cpu = CpuBackend::new(Precision::F32).unwrap();
        let matrix = |rows: usize, columns: usize, step: usize| {
            let values = (0..rows * columns).map(|at| ((at * step % 97) as f32 - 48.0) / 16.0);
            Matrix::new(rows, columns, values.collect()).unwrap()
        };
        for (rows, columns, inner) in
            [(31, 31, 8), (31, 8, 31), (30, 31, 8), (5, 70, 33), (1, 1, 1)]
        {
            let (left, right) = (matrix(rows, inner, 37), matrix(columns, inner, 41));
            let found = products(&cpu, &left, &right).unwrap();
            for (at, value) in found.values().iter().enumerate() {
                let pairs = left.row(at / columns).iter().zip(right.row(at % columns));
                let expected: f32 = pairs.map(|(a, b)| a * b).sum();
                assert!(
                    (value - expected).abs() < 1e-3,
                    "{rows} {columns} {inner}: {value} {expected}"
                );
            }
        }
    }
}
