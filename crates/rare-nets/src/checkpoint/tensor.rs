//! A tensor of a weight file, and the reading of its values.

use std::sync::Arc;

use half::{bf16, f16};
use rare::{Error, Result};
use rayon::prelude::*;

use super::ElementType;
use super::weight_file::WeightFile;
use crate::{Parameter, Values};

/// Elements that one thread reads and converts at a time: few enough that the bytes stay in its cache.
const CHUNK: usize = 1 << 17;

/// Elements that a tensor may have beyond those that are stored, by repeating them (a stride of 0).
const MOST_REPEATED: usize = 1 << 24;

/// A tensor whose values are still in a file, or in a part of one that is in memory. Cheap to clone.
#[derive(Debug, Clone)]
pub struct Tensor {
    element: ElementType,
    shape: Vec<usize>,
    layout: Layout,
    bytes: Bytes,
}

/// Where the elements are among those that are stored.
#[derive(Debug, Clone)]
enum Layout {
    /// One after the other, row-major.
    RowMajor,
    /// The distance from one element to the next along each axis.
    Strided(Vec<usize>),
}

/// The stored elements.
#[derive(Debug, Clone)]
struct Bytes {
    place: Place,
    /// Offset of the first element of the tensor.
    start: u64,
    big_endian: bool,
}

/// What holds the bytes.
#[derive(Debug, Clone)]
pub(super) enum Place {
    /// A file that stays open.
    File(Arc<WeightFile>),
    /// Values that were inside the object itself.
    Memory(Arc<[u8]>),
}

/// A tensor as a file describes it, not yet checked.
#[derive(Debug, Clone)]
pub(super) struct Description {
    /// Type of the elements.
    pub(super) element: ElementType,
    /// Sizes.
    pub(super) shape: Vec<usize>,
    /// Distance in elements along each axis.
    pub(super) strides: Vec<usize>,
    /// Elements of the storage before the first of the tensor.
    pub(super) offset: usize,
    /// Whether the most significant byte comes first.
    pub(super) big_endian: bool,
}

impl Tensor {
    /// The row-major, little-endian tensor whose bytes begin at `start` of `file`; the caller has made sure that they
    /// exist.
    pub(super) fn in_file(
        file: Arc<WeightFile>,
        start: u64,
        element: ElementType,
        shape: Vec<usize>,
    ) -> Tensor {
        let bytes = Bytes { place: Place::File(file), start, big_endian: false };
        Tensor { element, shape, layout: Layout::RowMajor, bytes }
    }

    /// A tensor in a storage of `length` bytes that begins at `start`; or what is wrong with it.
    pub(super) fn in_storage(
        described: Description,
        place: Place,
        start: u64,
        length: u64,
    ) -> std::result::Result<Tensor, String> {
        let Description { element, shape, strides, offset, big_endian } = described;
        let size = element.bytes() as u64;
        let wrong = || {
            format!(
                "a tensor of shape {shape:?}, strides {strides:?} and offset {offset} does not fit its storage of {} elements",
                length / size
            )
        };
        let span = span(&shape, &strides).ok_or_else(wrong)?;
        let end = offset.checked_add(span).and_then(|end| (end as u64).checked_mul(size));
        if end.is_none_or(|end| end > length) {
            return Err(wrong());
        }
        let row_major = is_row_major(&shape, &strides);
        let layout = if row_major { Layout::RowMajor } else { Layout::Strided(strides) };
        let bytes = Bytes { place, start: start + offset as u64 * size, big_endian };
        Ok(Tensor { element, shape, layout, bytes })
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

    /// All elements, row-major.
    ///
    /// # Errors
    /// `Unsupported` if the elements are not floating-point numbers; `Io` or `InvalidInput` if the file cannot be read.
    pub fn read_f64(&self) -> Result<Vec<f64>> {
        match self.element {
            ElementType::F64 => self.widened(f64::from_le_bytes, |value| value),
            ElementType::F32 => self.widened(f32::from_le_bytes, f64::from),
            ElementType::F16 => self.widened(f16::from_le_bytes, f64::from),
            ElementType::Bf16 => self.widened(bf16::from_le_bytes, f64::from),
            other => Err(unsupported(other, "floating-point numbers")),
        }
    }

    /// All elements, row-major.
    ///
    /// # Errors
    /// `Unsupported` if the elements are not integers of at most 64 bits with sign; `Io` or `InvalidInput` if the file
    /// cannot be read.
    pub fn read_i64(&self) -> Result<Vec<i64>> {
        match self.element {
            ElementType::I64 => self.widened(i64::from_le_bytes, |value| value),
            ElementType::I32 => self.widened(i32::from_le_bytes, i64::from),
            ElementType::I16 => self.widened(i16::from_le_bytes, i64::from),
            ElementType::I8 => self.widened(i8::from_le_bytes, i64::from),
            ElementType::U32 => self.widened(u32::from_le_bytes, i64::from),
            ElementType::U16 => self.widened(u16::from_le_bytes, i64::from),
            ElementType::U8 | ElementType::Bool => self.widened(u8::from_le_bytes, i64::from),
            other => Err(unsupported(other, "integers")),
        }
    }

    /// The elements in the precision of the file, row-major.
    ///
    /// # Errors
    /// `Unsupported` if they are not F32, F16 or BF16; `Io` or `InvalidInput` if the file cannot be read.
    pub fn read(&self) -> Result<Parameter> {
        Ok(Parameter { shape: self.shape.clone(), values: self.values()?.0 })
    }

    /// All elements, row-major, in the precision of the file, and how many stored ones are not finite.
    pub(super) fn values(&self) -> Result<(Values, usize)> {
        match self.element {
            ElementType::F32 => {
                let (values, bad) = self.decode(f32::from_le_bytes, f32::is_finite)?;
                Ok((Values::F32(values), bad))
            }
            ElementType::F16 => {
                let (values, bad) = self.decode(f16::from_le_bytes, f16::is_finite)?;
                Ok((Values::F16(values), bad))
            }
            ElementType::Bf16 => {
                let (values, bad) = self.decode(bf16::from_le_bytes, bf16::is_finite)?;
                Ok((Values::Bf16(values), bad))
            }
            other => Err(unsupported(other, "weights in F32, F16 or BF16")),
        }
    }

    fn widened<T: Copy + Default + Send, U, const SIZE: usize>(
        &self,
        convert: fn([u8; SIZE]) -> T,
        widen: fn(T) -> U,
    ) -> Result<Vec<U>> {
        Ok(self.decode(convert, |_| true)?.0.into_iter().map(widen).collect())
    }

    /// Reads and converts all elements and counts those that are not `finite`.
    fn decode<T: Copy + Default + Send, const SIZE: usize>(
        &self,
        convert: fn([u8; SIZE]) -> T,
        finite: fn(T) -> bool,
    ) -> Result<(Vec<T>, usize)> {
        match &self.layout {
            Layout::RowMajor => self.bytes.decode(self.count(), convert, finite),
            Layout::Strided(strides) => {
                let stored = span(&self.shape, strides).unwrap_or(0);
                let (values, bad) = self.bytes.decode(stored, convert, finite)?;
                Ok((gather(&values, &self.shape, strides), bad))
            }
        }
    }
}

impl Bytes {
    /// Reads and converts the first `count` elements, a chunk per thread at a time.
    fn decode<T: Copy + Default + Send, const SIZE: usize>(
        &self,
        count: usize,
        convert: fn([u8; SIZE]) -> T,
        finite: fn(T) -> bool,
    ) -> Result<(Vec<T>, usize)> {
        let mut values = vec![T::default(); count];
        let bad = values
            .par_chunks_mut(CHUNK)
            .enumerate()
            .map(|(index, chunk)| {
                let mut bytes = vec![0; chunk.len() * SIZE];
                self.fill(&mut bytes, (index * CHUNK * SIZE) as u64)?;
                if self.big_endian {
                    bytes.chunks_exact_mut(SIZE).for_each(<[u8]>::reverse);
                }
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

    /// The bytes from `offset` on.
    fn fill(&self, buffer: &mut [u8], offset: u64) -> Result<()> {
        let begin = self.start + offset;
        match &self.place {
            Place::File(file) => file.read_at(buffer, begin),
            Place::Memory(bytes) => {
                let begin = usize::try_from(begin).unwrap_or(usize::MAX);
                let part = bytes.get(begin..begin.saturating_add(buffer.len()));
                let part =
                    part.ok_or_else(|| Error::Internal("an array left its bytes".to_owned()))?;
                buffer.copy_from_slice(part);
                Ok(())
            }
        }
    }
}

fn unsupported(found: ElementType, expected: &str) -> Error {
    Error::Unsupported(format!("the numbers are of type {found}, expected {expected}"))
}

/// The distance along each axis of a row-major tensor.
pub(super) fn strides_of(shape: &[usize]) -> Vec<usize> {
    let mut strides = vec![1; shape.len()];
    let mut product = 1_usize;
    for (stride, &size) in strides.iter_mut().zip(shape).rev() {
        *stride = product;
        product = product.saturating_mul(size);
    }
    strides
}

/// Whether the elements lie one after the other; an axis of size 1 may have any stride.
fn is_row_major(shape: &[usize], strides: &[usize]) -> bool {
    let expected = strides_of(shape);
    let mut axes = shape.iter().zip(strides.iter().zip(&expected));
    shape.contains(&0) || axes.all(|(&size, (stride, expected))| size == 1 || stride == expected)
}

/// How many stored elements a tensor reaches over; `None` if there is no such tensor.
fn span(shape: &[usize], strides: &[usize]) -> Option<usize> {
    if shape.len() != strides.len() {
        return None;
    }
    let count = shape.iter().try_fold(1_usize, |product, &size| product.checked_mul(size))?;
    if count == 0 {
        return Some(0);
    }
    let span = shape.iter().zip(strides).try_fold(1_usize, |sum, (&size, &stride)| {
        sum.checked_add((size - 1).checked_mul(stride)?)
    })?;
    (count <= span.max(MOST_REPEATED)).then_some(span)
}

/// The elements of a strided tensor, row-major.
fn gather<T: Copy>(stored: &[T], shape: &[usize], strides: &[usize]) -> Vec<T> {
    let mut places = vec![0];
    for (&size, &stride) in shape.iter().zip(strides) {
        places = places
            .iter()
            .flat_map(|place| (0..size).map(move |index| place + index * stride))
            .collect();
    }
    places.iter().filter_map(|&place| stored.get(place).copied()).collect()
}
