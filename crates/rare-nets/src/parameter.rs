//! A tensor as a weight file holds it.

use half::{bf16, f16};

/// One tensor of a network, in the precision of its file.
#[derive(Debug, Clone, PartialEq)]
pub struct Parameter {
    /// Sizes, the slowest first; empty for a scalar.
    pub shape: Vec<usize>,
    /// The elements, row-major; as many as the product of the sizes.
    pub values: Values,
}

/// The elements of a [`Parameter`].
#[derive(Debug, Clone, PartialEq)]
pub enum Values {
    /// Single precision.
    F32(Vec<f32>),
    /// Half precision.
    F16(Vec<f16>),
    /// The upper half of single precision.
    Bf16(Vec<bf16>),
}

impl Parameter {
    /// All elements in single precision (exact: both half precisions are subsets).
    #[must_use]
    pub fn to_f32(&self) -> Vec<f32> {
        match &self.values {
            Values::F32(values) => values.clone(),
            Values::F16(values) => values.iter().map(|value| value.to_f32()).collect(),
            Values::Bf16(values) => values.iter().map(|value| value.to_f32()).collect(),
        }
    }
}

impl Values {
    /// Number of elements.
    #[must_use]
    pub fn len(&self) -> usize {
        match self {
            Values::F32(values) => values.len(),
            Values::F16(values) => values.len(),
            Values::Bf16(values) => values.len(),
        }
    }

    /// Whether there is no element.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}
