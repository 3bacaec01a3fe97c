//! NPY: one array of `NumPy`, a short text header and its numbers.
//!
//! The header is a Python dictionary of three entries. It is taken apart here by hand: a general parser of Python
//! literals recurses as deep as a hostile header nests. Format: `NumPy` Enhancement Proposal 1.

use std::io::{self, Read, Write};

use nalgebra::Point3;

use super::scalar::{ByteOrder, Column, Scalar, read_points};
use crate::error::{Error, Result};

/// What every NPY file begins with.
pub(super) const MAGIC: &[u8] = b"\x93NUMPY";

/// No header of a plain array comes near this length, bytes.
const LONGEST_HEADER: usize = 1 << 16;

/// An array of numbers in C order: the last index runs fastest.
#[derive(Debug, Clone, PartialEq)]
pub struct Array<T> {
    /// Length along each axis; empty for a single number.
    pub shape: Vec<usize>,
    /// The numbers, as many as the product of `shape`.
    pub values: Vec<T>,
}

/// What the header says about the array after it.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Header {
    pub(super) scalar: Scalar,
    pub(super) order: ByteOrder,
    pub(super) fortran: bool,
    pub(super) shape: Vec<usize>,
    /// Bytes of the header itself.
    pub(super) length: usize,
}

impl Header {
    /// Reads the header and leaves `reader` at the first number.
    ///
    /// # Errors
    /// `InvalidInput` if it is damaged, `Unsupported` if the array holds something other than plain numbers.
    pub(super) fn read(reader: &mut dyn Read) -> Result<Header> {
        let damaged = |_| Error::invalid("the NPY header is cut off: save the array again");
        let mut start = [0; 8];
        reader.read_exact(&mut start).map_err(damaged)?;
        if !start.starts_with(MAGIC) {
            return Err(Error::invalid(
                "this is no NPY array: save it with numpy.save or numpy.savez",
            ));
        }
        let mut size = [0; 4];
        // Version 1 has a 16-bit length, the later ones have 32 bits.
        let width = if start[6] <= 1 { 2 } else { 4 };
        reader.read_exact(&mut size[..width]).map_err(damaged)?;
        let size = u32::from_le_bytes(size) as usize;
        if size > LONGEST_HEADER {
            return Err(Error::invalid(format!(
                "the NPY header claims {size} bytes: the file is damaged"
            )));
        }
        let mut text = vec![0; size];
        reader.read_exact(&mut text).map_err(damaged)?;
        Header::parse(&String::from_utf8_lossy(&text), start.len() + width + size)
    }

    fn parse(text: &str, length: usize) -> Result<Header> {
        let damaged = || Error::invalid("the NPY header is damaged: save the array again");
        let kind = entry(text, "descr").ok_or_else(damaged)?;
        if kind.starts_with('[') {
            return Err(Error::Unsupported(
                "the array has named fields: save the coordinates as a plain N x 3 array"
                    .to_owned(),
            ));
        }
        let kind = quoted_value(kind).ok_or_else(damaged)?;
        let (scalar, order) = scalar_of(kind).ok_or_else(|| {
            Error::Unsupported(format!(
                "arrays of the type {kind} are not read: save it as float32 or float64"
            ))
        })?;
        let fortran = entry(text, "fortran_order").ok_or_else(damaged)?.starts_with("True");
        let shape = entry(text, "shape").and_then(parse_shape).ok_or_else(damaged)?;
        Ok(Header { scalar, order, fortran, shape, length })
    }

    /// How many numbers the array has; `None` if the product overflows.
    pub(super) fn count(&self) -> Option<usize> {
        self.shape.iter().try_fold(1usize, |product, &size| product.checked_mul(size))
    }

    /// How many bytes the numbers take.
    ///
    /// # Errors
    /// `InvalidInput` if no file could hold them.
    pub(super) fn data_length(&self) -> Result<usize> {
        let length = self.count().and_then(|count| count.checked_mul(self.scalar.size()));
        length.ok_or_else(|| {
            Error::invalid(format!(
                "the NPY header claims the shape {:?}: the file is damaged",
                self.shape
            ))
        })
    }

    /// The first three columns of an `N x 3` or wider array as points.
    ///
    /// # Errors
    /// `InvalidInput` if the shape is another one or the data are too short.
    pub(super) fn points(&self, data: &[u8]) -> Result<Vec<Point3<f64>>> {
        let &[rows, columns @ 3..=usize::MAX] = self.shape.as_slice() else {
            return Err(Error::invalid(format!(
                "the array has the shape {:?}, N x 3 is needed: save the points as rows",
                self.shape
            )));
        };
        let size = self.scalar.size();
        let across = if self.fortran { rows.saturating_mul(size) } else { size };
        let down = if self.fortran { size } else { columns.saturating_mul(size) };
        let column = |index: usize| Column {
            offset: index.saturating_mul(across),
            stride: down,
            scalar: self.scalar,
        };
        read_points(data, &[column(0), column(1), column(2)], rows, self.order)
            .ok_or_else(|| self.cut_off(data.len()))
    }

    /// All numbers in C order, each passed through `convert`.
    ///
    /// # Errors
    /// `InvalidInput` if the data are too short.
    pub(super) fn array<T: Copy>(
        &self,
        data: &[u8],
        convert: impl Fn(f64) -> T,
    ) -> Result<Array<T>> {
        let cut_off = || self.cut_off(data.len());
        let data = data.get(..self.data_length()?).ok_or_else(cut_off)?;
        let read = |bytes| self.scalar.read(bytes, self.order).map(&convert);
        let stored: Option<Vec<T>> = data.chunks_exact(self.scalar.size()).map(read).collect();
        let stored = stored.ok_or_else(cut_off)?;
        let values = if self.fortran { c_order(&self.shape, &stored) } else { stored };
        Ok(Array { shape: self.shape.clone(), values })
    }

    fn cut_off(&self, available: usize) -> Error {
        Error::invalid(format!(
            "an array of the shape {:?} needs {} bytes, there are {available}: the file is cut off, save it again",
            self.shape,
            self.data_length().unwrap_or(usize::MAX)
        ))
    }
}

/// What follows `key` and its colon.
fn entry<'a>(text: &'a str, key: &str) -> Option<&'a str> {
    let (_, after) =
        text.split_once(&format!("'{key}'")).or_else(|| text.split_once(&format!("\"{key}\"")))?;
    Some(after.trim_start().strip_prefix(':')?.trim_start())
}

fn quoted_value(text: &str) -> Option<&str> {
    let quote = text.chars().next().filter(|&quote| quote == '\'' || quote == '"')?;
    text.get(1..)?.split_once(quote).map(|(value, _)| value)
}

fn parse_shape(text: &str) -> Option<Vec<usize>> {
    let (sizes, _) = text.strip_prefix('(')?.split_once(')')?;
    let sizes = sizes.split(',').map(|size| size.trim().trim_end_matches('L'));
    sizes.filter(|size| !size.is_empty()).map(|size| size.parse().ok()).collect()
}

/// The number type of a `NumPy` type string such as `<f8`.
fn scalar_of(kind: &str) -> Option<(Scalar, ByteOrder)> {
    let mut letters = kind.chars();
    let order = match letters.next()? {
        '<' | '|' | '=' => ByteOrder::Little,
        '>' => ByteOrder::Big,
        _ => return None,
    };
    let scalar = match letters.as_str() {
        "f2" => Scalar::F16,
        "f4" => Scalar::F32,
        "f8" => Scalar::F64,
        "i1" => Scalar::I8,
        "i2" => Scalar::I16,
        "i4" => Scalar::I32,
        "i8" => Scalar::I64,
        "u1" | "b1" => Scalar::U8,
        "u2" => Scalar::U16,
        "u4" => Scalar::U32,
        "u8" => Scalar::U64,
        _ => return None,
    };
    Some((scalar, order))
}

/// Reorders values whose first index runs fastest so that the last one does.
fn c_order<T: Copy>(shape: &[usize], stored: &[T]) -> Vec<T> {
    let mut index = vec![0; shape.len()];
    let mut values = Vec::with_capacity(stored.len());
    for _ in 0..stored.len() {
        let at = index.iter().zip(shape).rev().fold(0, |at, (&index, &size)| at * size + index);
        values.extend(stored.get(at));
        for (index, &size) in index.iter_mut().zip(shape).rev() {
            *index += 1;
            if *index < size {
                break;
            }
            *index = 0;
        }
    }
    values
}

/// The first three columns of the array in an NPY file as points.
///
/// # Errors
/// `InvalidInput` or `Unsupported` that says what is wrong with the array.
pub(super) fn read_cloud(bytes: &[u8]) -> Result<Vec<Point3<f64>>> {
    let mut rest = bytes;
    Header::read(&mut rest)?.points(rest)
}

/// The array in an NPY file.
///
/// # Errors
/// `InvalidInput` or `Unsupported` that says what is wrong with it.
pub(super) fn read_array(bytes: &[u8]) -> Result<Array<f64>> {
    let mut rest = bytes;
    Header::read(&mut rest)?.array(rest, |value| value)
}

/// Writes the header of a little-endian array in C order; `kind` is `NumPy`'s type string without its byte order.
pub(super) fn write_header(writer: &mut dyn Write, kind: &str, shape: &[usize]) -> io::Result<()> {
    const BEFORE_TEXT: usize = 10;
    let sizes: String = shape.iter().map(|size| format!("{size}, ")).collect();
    let mut text = format!(
        "{{'descr': '<{kind}', 'fortran_order': False, 'shape': ({}), }}",
        sizes.trim_end()
    );
    // The numbers begin at a multiple of 64 bytes, so that they can be mapped into memory.
    let padded = (BEFORE_TEXT + text.len() + 1).next_multiple_of(64) - BEFORE_TEXT;
    text.push_str(&" ".repeat(padded - text.len() - 1));
    text.push('\n');
    let length = u16::try_from(text.len()).map_err(io::Error::other)?;
    writer.write_all(MAGIC)?;
    writer.write_all(&[1, 0])?;
    writer.write_all(&length.to_le_bytes())?;
    writer.write_all(text.as_bytes())
}

/// Writes points as an `N x 3` array of 64-bit floats.
pub(super) fn write(writer: &mut dyn Write, points: &[Point3<f64>]) -> io::Result<()> {
    write_header(writer, "f8", &[points.len(), 3])?;
    let mut values = points.iter().flat_map(|point| point.coords.as_slice());
    values.try_for_each(|value| writer.write_all(&value.to_le_bytes()))
}
