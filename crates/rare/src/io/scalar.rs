//! Numbers as binary files store them, and points gathered from columns of such numbers.

use nalgebra::Point3;

/// Which end of a number comes first.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ByteOrder {
    Little,
    Big,
}

/// The type of a stored number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    I64,
    U64,
    F16,
    F32,
    F64,
}

impl Scalar {
    /// Bytes per number.
    pub(super) fn size(self) -> usize {
        match self {
            Scalar::I8 | Scalar::U8 => 1,
            Scalar::I16 | Scalar::U16 | Scalar::F16 => 2,
            Scalar::I32 | Scalar::U32 | Scalar::F32 => 4,
            Scalar::I64 | Scalar::U64 | Scalar::F64 => 8,
        }
    }

    pub(super) fn is_float(self) -> bool {
        matches!(self, Scalar::F16 | Scalar::F32 | Scalar::F64)
    }

    /// The number at the start of `bytes`, `None` if they are too few.
    #[inline]
    pub(super) fn read(self, bytes: &[u8], order: ByteOrder) -> Option<f64> {
        Some(match self {
            Scalar::I8 => f64::from(i8::from_le_bytes(little(bytes, order)?)),
            Scalar::U8 => f64::from(u8::from_le_bytes(little(bytes, order)?)),
            Scalar::I16 => f64::from(i16::from_le_bytes(little(bytes, order)?)),
            Scalar::U16 => f64::from(u16::from_le_bytes(little(bytes, order)?)),
            Scalar::I32 => f64::from(i32::from_le_bytes(little(bytes, order)?)),
            Scalar::U32 => f64::from(u32::from_le_bytes(little(bytes, order)?)),
            Scalar::I64 => i64::from_le_bytes(little(bytes, order)?) as f64,
            Scalar::U64 => u64::from_le_bytes(little(bytes, order)?) as f64,
            Scalar::F16 => half_to_f64(u16::from_le_bytes(little(bytes, order)?)),
            Scalar::F32 => f64::from(f32::from_le_bytes(little(bytes, order)?)),
            Scalar::F64 => f64::from_le_bytes(little(bytes, order)?),
        })
    }
}

#[inline]
fn little<const SIZE: usize>(bytes: &[u8], order: ByteOrder) -> Option<[u8; SIZE]> {
    let mut number = *bytes.first_chunk::<SIZE>()?;
    if order == ByteOrder::Big {
        number.reverse();
    }
    Some(number)
}

/// IEEE 754 binary16: 1 sign bit, 5 exponent bits (bias 15), 10 fraction bits.
fn half_to_f64(bits: u16) -> f64 {
    let fraction = f64::from(bits & 0x3ff);
    let magnitude = match (bits >> 10) & 0x1f {
        0 => fraction * 2f64.powi(-24),
        31 if fraction == 0.0 => f64::INFINITY,
        31 => f64::NAN,
        exponent => (1.0 + fraction / 1024.0) * 2f64.powi(i32::from(exponent) - 15),
    };
    if bits & 0x8000 == 0 { magnitude } else { -magnitude }
}

/// One number per record: where the first lies, how far apart they are (both in bytes), and their type.
#[derive(Debug, Clone, Copy)]
pub(super) struct Column {
    pub(super) offset: usize,
    pub(super) stride: usize,
    pub(super) scalar: Scalar,
}

impl Column {
    /// Whether the column's number in each of `count` records lies within `length` bytes.
    fn fits(&self, count: usize, length: usize) -> bool {
        let last = count.saturating_sub(1).checked_mul(self.stride);
        let end = last
            .and_then(|last| last.checked_add(self.offset))
            .and_then(|last| last.checked_add(self.scalar.size()));
        count == 0 || end.is_some_and(|end| end <= length)
    }

    #[inline]
    fn read(&self, bytes: &[u8], record: usize, order: ByteOrder) -> Option<f64> {
        self.scalar.read(bytes.get(self.offset + record * self.stride..)?, order)
    }
}

/// The points whose coordinates are the three columns of `count` records; `None`, before anything is allocated, if
/// the bytes are too few.
pub(super) fn read_points(
    bytes: &[u8],
    columns: &[Column; 3],
    count: usize,
    order: ByteOrder,
) -> Option<Vec<Point3<f64>>> {
    if !columns.iter().all(|column| column.fits(count, bytes.len())) {
        return None;
    }
    let [x, y, z] = columns;
    let mut points = Vec::with_capacity(count);
    for record in 0..count {
        points.push(Point3::new(
            x.read(bytes, record, order)?,
            y.read(bytes, record, order)?,
            z.read(bytes, record, order)?,
        ));
    }
    Some(points)
}

/// Whether 32-bit floats keep these coordinates: none beyond 10 km, none moved by more than 0.1 mm.
pub(super) fn fits_single(points: &[Point3<f64>]) -> bool {
    const REACH: f64 = 10_000.0;
    const LOSS: f64 = 1e-4;
    let kept = |value: &f64| {
        !value.is_finite()
            || (value.abs() <= REACH && (value - f64::from(*value as f32)).abs() <= LOSS)
    };
    points.iter().all(|point| point.coords.iter().all(kept))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn halves_are_read_exactly() {
        for (bits, value) in [
            (0x3c00, 1.0),
            (0xc000, -2.0),
            (0x7bff, 65504.0),
            (0x0001, 2f64.powi(-24)),
            (0x3555, 0.333_251_953_125),
            (0x7c00, f64::INFINITY),
        ] {
            assert_eq!(half_to_f64(bits), value);
        }
        assert!(half_to_f64(0x7e00).is_nan());
    }

    #[test]
    fn columns_beyond_the_bytes_are_refused_before_allocating() {
        let column = |offset| Column { offset, stride: 12, scalar: Scalar::F32 };
        let columns = [column(0), column(4), column(8)];
        let bytes = [0; 24];
        assert_eq!(read_points(&bytes, &columns, 2, ByteOrder::Little).unwrap().len(), 2);
        assert!(read_points(&bytes, &columns, 3, ByteOrder::Little).is_none());
        assert!(read_points(&bytes, &columns, usize::MAX, ByteOrder::Little).is_none());
    }

    #[test]
    fn single_precision_is_kept_only_where_it_loses_nothing() {
        let fits = |value| fits_single(&[Point3::new(value, 0.0, 0.0)]);
        assert!(fits(1.25) && fits(123.456) && fits(f64::NAN) && fits(8192.5));
        assert!(!fits(20_000.0) && !fits(8192.0003));
    }
}
