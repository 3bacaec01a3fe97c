//! LAS: points as integers with a scale and an offset (ASPRS LAS 1.0 to 1.4), and the way to its compressed form, LAZ.
//!
//! Every point format begins with x, y and z as 32-bit integers, so uncompressed points are taken straight from their
//! bytes.

use nalgebra::Point3;

use super::laz;
use super::scalar::{ByteOrder, Column, Scalar, read_points};
use crate::error::{Error, Result};

/// What every LAS or LAZ file begins with.
pub(super) const MAGIC: &[u8] = b"LASF";

/// Length of the header up to and including its bounding box, bytes.
const SHORTEST_HEADER: usize = 227;

/// Bytes of a point's coordinates.
const COORDINATES: usize = 12;

/// What the header says about the points.
#[derive(Debug, Clone, Copy)]
pub(super) struct Header {
    pub(super) header_length: usize,
    pub(super) records: usize,
    pub(super) point_data: usize,
    pub(super) record_length: usize,
    pub(super) points: usize,
    compressed: bool,
    pub(super) version_minor: u8,
    scale: Point3<f64>,
    offset: Point3<f64>,
}

impl Header {
    fn parse(bytes: &[u8]) -> Result<Header> {
        let cut_off = || Error::invalid("the LAS header is cut off: write the file again");
        if bytes.len() < SHORTEST_HEADER {
            return Err(cut_off());
        }
        let number = |scalar: Scalar, at: usize| {
            let rest = bytes.get(at..).unwrap_or_default();
            scalar.read(rest, ByteOrder::Little).ok_or_else(cut_off)
        };
        let whole = |scalar: Scalar, at: usize| number(scalar, at).map(|value| value as usize);
        let triple = |at: usize| -> Result<Point3<f64>> {
            Ok(Point3::new(
                number(Scalar::F64, at)?,
                number(Scalar::F64, at + 8)?,
                number(Scalar::F64, at + 16)?,
            ))
        };
        let version_minor = bytes[25];
        // Since 1.4 the count has 64 bits; the old field is then zero unless the file suits older readers too.
        let mut points = whole(Scalar::U32, 107)?;
        if points == 0 && version_minor >= 4 {
            points = whole(Scalar::U64, 247)?;
        }
        Ok(Header {
            header_length: whole(Scalar::U16, 94)?,
            records: whole(Scalar::U32, 100)?,
            point_data: whole(Scalar::U32, 96)?,
            record_length: whole(Scalar::U16, 105)?,
            points,
            compressed: bytes[104] & 0xc0 != 0,
            version_minor,
            scale: triple(131)?,
            offset: triple(155)?,
        })
    }

    /// The coordinates that the integers of a record stand for.
    fn scaled(&self, stored: Point3<f64>) -> Point3<f64> {
        Point3::from(stored.coords.component_mul(&self.scale.coords) + self.offset.coords)
    }
}

/// The points of a LAS or LAZ file, in its coordinate system.
///
/// # Errors
/// `InvalidInput` if the file is cut off or damaged.
pub(super) fn read(bytes: Vec<u8>) -> Result<Vec<Point3<f64>>> {
    let header = Header::parse(&bytes)?;
    if header.record_length < COORDINATES {
        return Err(Error::invalid(format!(
            "the LAS header gives {} bytes per point, the coordinates alone take {COORDINATES}: the file is damaged",
            header.record_length
        )));
    }
    if header.compressed {
        return laz::read(bytes, &header);
    }
    let body = bytes.get(header.point_data..).unwrap_or_default();
    let mut points = stored_points(body, header.record_length, header.points).ok_or_else(|| {
        Error::invalid(format!(
            "the LAS header promises {} points of {} bytes, {} bytes are there: the file is cut off, write it again",
            header.points,
            header.record_length,
            body.len()
        ))
    })?;
    for point in &mut points {
        *point = header.scaled(*point);
    }
    Ok(points)
}

fn stored_points(body: &[u8], record_length: usize, count: usize) -> Option<Vec<Point3<f64>>> {
    let column = |offset| Column { offset, stride: record_length, scalar: Scalar::I32 };
    read_points(body, &[column(0), column(4), column(8)], count, ByteOrder::Little)
}
