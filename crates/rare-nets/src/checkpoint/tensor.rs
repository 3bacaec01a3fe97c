//! A tensor of a weight file, and the reading of its values.

use std::path::Path;
use std::sync::Arc;

use half::{bf16, f16};
use rare::{Error, Result};
use rayon::prelude::*;

use super::ElementType;
use super::weight_file::WeightFile;
use crate::Values;

/// Elements that one thread reads and converts at a time: few enough that the bytes stay in its cache.
const CHUNK: usize = 1 << 17;

/// A tensor whose values are still in a file, or in a part of one that is in memory. Cheap to clone.
#[derive(Debug, Clone)]
pub struct Tensor {
    element: ElementType,
    shape: Vec<usize>,
    bytes: Bytes,
}

/// Where the little-endian, row-major values are.
#[derive(Debug, Clone)]
enum Bytes {
    File { file: Arc<WeightFile>, start: u64 },
}

impl Tensor {
    /// The row-major tensor whose bytes begin at `start` of `file`; the caller has made sure that they exist.
    pub(super) fn in_file(
        file: Arc<WeightFile>,
        start: u64,
        element: ElementType,
        shape: Vec<usize>,
    ) -> Tensor {
        Tensor { element, shape, bytes: Bytes::File { file, start } }
    }

    /// Type of the elements.
    #[must_use]
    pub fn element(&self) -> ElementType {
        self.element
    }

    /// Sizes, the slowest first; empty for a scalar.
    #[must_use]
    pub fn shape(&self) -> &[usize] {
        &self.shape
    }

    /// Number of elements.
    #[must_use]
    pub fn count(&self) -> usize {
        self.shape.iter().product()
    }

    /// The file that holds it.
    pub(super) fn path(&self) -> &Path {
        match &self.bytes {
            Bytes::File { file, .. } => file.path(),
        }
    }

    /// All elements, row-major, in the precision of the file, and how many of them are not finite.
    pub(super) fn values(&self) -> Result<(Values, usize)> {
        match self.element {
            ElementType::F32 => {
                let (values, bad) = self.decode(f32::from_le_bytes, |value| value.is_finite())?;
                Ok((Values::F32(values), bad))
            }
            ElementType::F16 => {
                let (values, bad) = self.decode(f16::from_le_bytes, |value| value.is_finite())?;
                Ok((Values::F16(values), bad))
            }
            ElementType::Bf16 => {
                let (values, bad) = self.decode(bf16::from_le_bytes, |value| value.is_finite())?;
                Ok((Values::Bf16(values), bad))
            }
            other => Err(Error::Unsupported(format!(
                "numbers of type {other} where weights are expected: use a file in F32, F16 or BF16"
            ))),
        }
    }

    /// Reads and converts all elements, a chunk per thread at a time, and counts those that are not `finite`.
    fn decode<T: Copy + Default + Send, const SIZE: usize>(
        &self,
        convert: fn([u8; SIZE]) -> T,
        finite: fn(T) -> bool,
    ) -> Result<(Vec<T>, usize)> {
        let mut values = vec![T::default(); self.count()];
        let bad = values
            .par_chunks_mut(CHUNK)
            .enumerate()
            .map(|(index, chunk)| {
                let mut bytes = vec![0; chunk.len() * SIZE];
                self.fill(&mut bytes, (index * CHUNK * SIZE) as u64)?;
                let mut bad = 0;
                for (value, bytes) in chunk.iter_mut().zip(bytes.as_chunks().0) {
                    *value = convert(*bytes);
                    bad += usize::from(!finite(*value));
                }
                Ok(bad)
            })
            .collect::<Result<Vec<usize>>>()?;
        Ok((values, bad.iter().sum()))
    }

    /// The bytes of the tensor from `offset` on.
    fn fill(&self, buffer: &mut [u8], offset: u64) -> Result<()> {
        match &self.bytes {
            Bytes::File { file, start } => file.read_at(buffer, start + offset),
        }
    }
}
