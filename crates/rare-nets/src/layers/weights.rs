//! The tensors of a network whose layout is known.

use rare::{Error, Result};

use super::Linear;
use crate::Matrix;
use crate::checkpoint::{Layout, Parameters, require};
use crate::engine::CpuBackend;

/// Added to the variances of batch normalisations.
const NORMALISATION_EPSILON: f64 = 1e-5;

/// Reads the tensors of a network, each with the shape that its layout says.
pub(crate) struct Weights<'a> {
    parameters: &'a Parameters,
    layout: &'a Layout,
}

impl<'a> Weights<'a> {
    /// Makes sure that the file holds the tensors of `layout` and no others. `network` is its name for the message.
    ///
    /// # Errors
    /// `InvalidInput` with the file and the first differences.
    pub(crate) fn new(
        parameters: &'a Parameters,
        layout: &'a Layout,
        network: &str,
    ) -> Result<Weights<'a>> {
        let advice = "`rare weights check` says which network a file is of";
        require(layout, parameters, network, advice)?;
        Ok(Weights { parameters, layout })
    }

    /// The shape of the tensor `name`, the slowest size first.
    ///
    /// # Errors
    /// `Internal` if the layout does not have it.
    pub(crate) fn shape(&self, name: &str) -> Result<&'a [usize]> {
        let shape = self.layout.get(name).map(Vec::as_slice);
        shape.ok_or_else(|| Error::Internal(format!("the layout has no tensor {name}")))
    }

    /// Whether the network has a tensor `name`.
    pub(crate) fn has(&self, name: &str) -> bool {
        self.layout.contains_key(name)
    }

    /// The numbers of the tensor `name`, the last index fastest.
    ///
    /// # Errors
    /// `InvalidInput` if a number is not finite; `Io`, `Unsupported` as the file has it.
    pub(crate) fn values(&self, name: &str) -> Result<Vec<f32>> {
        Ok(self.parameters.read(name, self.shape(name)?)?.to_f32())
    }

    /// The one number of the tensor `name`.
    ///
    /// # Errors
    /// Those of [`Weights::values`]; `Internal` if the layout has more than one.
    pub(crate) fn scalar(&self, name: &str) -> Result<f32> {
        match self.values(name)?.as_slice() {
            [value] => Ok(*value),
            values => Err(Error::Internal(format!("{name} has {} numbers", values.len()))),
        }
    }

    /// The tensor `name` of shape `outputs x inputs x 1 ...` as a matrix.
    ///
    /// # Errors
    /// Those of [`Weights::values`]; `Internal` if the layout has no such shape.
    pub(crate) fn matrix(&self, name: &str) -> Result<Matrix> {
        match self.shape(name)? {
            [rows, columns, rest @ ..] if rest.iter().all(|&size| size == 1) => {
                Matrix::new(*rows, *columns, self.values(name)?)
            }
            shape => Err(Error::Internal(format!("{name} of shape {shape:?} is no matrix"))),
        }
    }

    /// The linear layer of `name.weight` and, if the network has it, `name.bias`.
    ///
    /// # Errors
    /// Those of [`Weights::matrix`].
    pub(crate) fn linear(&self, cpu: &CpuBackend, name: &str) -> Result<Linear> {
        let bias = format!("{name}.bias");
        let bias = if self.has(&bias) { Some(self.values(&bias)?) } else { None };
        Linear::new(cpu, self.matrix(&format!("{name}.weight"))?, bias.as_deref())
    }

    /// The linear layers of these names as one, their outputs one after the other. All have a bias.
    ///
    /// # Errors
    /// Those of [`Weights::matrix`].
    pub(crate) fn stacked_linear(&self, cpu: &CpuBackend, names: &[String]) -> Result<Linear> {
        let mut weight: Option<Matrix> = None;
        let mut bias = Vec::new();
        for name in names {
            let part = self.matrix(&format!("{name}.weight"))?;
            weight = Some(match weight {
                Some(above) => above.stacked(&part)?,
                None => part,
            });
            bias.extend(self.values(&format!("{name}.bias"))?);
        }
        let weight = weight.ok_or_else(|| Error::Internal("no layers to stack".to_owned()))?;
        Linear::new(cpu, weight, Some(&bias))
    }

    /// The linear layer `name`, which has a bias, and the batch normalisation `norm` after it (Ioffe and Szegedy, 2015)
    /// as one linear layer.
    ///
    /// # Errors
    /// Those of [`Weights::matrix`]; `InvalidInput` if a variance is negative.
    pub(crate) fn normalised_linear(
        &self,
        cpu: &CpuBackend,
        name: &str,
        norm: &str,
    ) -> Result<Linear> {
        let mut weight = self.matrix(&format!("{name}.weight"))?;
        let mut bias = self.values(&format!("{name}.bias"))?;
        let part = |part: &str| self.values(&format!("{norm}.{part}"));
        let (scale, shift) = (part("weight")?, part("bias")?);
        let (mean, variance) = (part("running_mean")?, part("running_var")?);
        if let Some(negative) = variance.iter().find(|&&variance| variance < 0.0) {
            return Err(Error::invalid(format!("{norm}.running_var holds {negative}")));
        }
        let columns = weight.columns().max(1);
        let rows = weight.values_mut().chunks_exact_mut(columns).zip(&mut bias);
        let affine = scale.iter().zip(&shift).zip(mean.iter().zip(&variance));
        for ((row, bias), ((&scale, shift), (mean, &variance))) in rows.zip(affine) {
            let factor = f64::from(scale) / (f64::from(variance) + NORMALISATION_EPSILON).sqrt();
            row.iter_mut().for_each(|value| *value = (f64::from(*value) * factor) as f32);
            let centred = f64::from(*bias) - f64::from(*mean);
            *bias = (centred * factor + f64::from(*shift)) as f32;
        }
        Linear::new(cpu, weight, Some(&bias))
    }
}
