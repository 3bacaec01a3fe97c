//! LAZ: LAS with its points compressed (M. Isenburg, "`LASzip`: lossless compression of LiDAR data", 2013), unpacked by the crate `las`.
//!
//! That crate allocates what the file's counts and sizes ask for, so they are checked against the file's length first.

use std::io::Cursor;

use nalgebra::Point3;

use super::contain_panics::contain_panics;
use super::las::Header;
use super::scalar::{ByteOrder, Scalar};
use crate::error::{Error, Result};

/// Points unpacked at a time.
const BATCH: u64 = 1 << 16;

/// Real scans need two bytes per point or more; a file that claims this many points per byte is damaged.
const MOST_POINTS_PER_BYTE: usize = 16;

/// Number of extended records in the header of LAS 1.4: where it stands and its length, bytes.
const EXTENDED_RECORDS: std::ops::Range<usize> = 243..247;

/// The points of a LAZ file whose header was read already.
///
/// # Errors
/// `InvalidInput` if the file is cut off or damaged.
pub(super) fn read(mut bytes: Vec<u8>, header: &Header) -> Result<Vec<Point3<f64>>> {
    check(&bytes, header).ok_or_else(|| {
        Error::invalid(format!(
            "the compressed data do not fit the LAZ header ({} points of {} bytes): the file is cut off or damaged, \
             write it again",
            header.points, header.record_length
        ))
    })?;
    // Extended records say nothing about points, and the crate allocates whatever length the first one claims.
    if header.version_minor >= 4 {
        bytes.get_mut(EXTENDED_RECORDS).unwrap_or_default().fill(0);
    }
    contain_panics(|| {
        unpack(bytes).map_err(|error| {
            Error::invalid(format!("the LAZ data are damaged ({error}): write the file again"))
        })
    })
}

fn unpack(bytes: Vec<u8>) -> las::Result<Vec<Point3<f64>>> {
    let mut reader = las::Reader::new(Cursor::new(bytes))?;
    let mut batch = reader.read_points(0)?;
    let mut points = Vec::new();
    while reader.fill_points(BATCH, &mut batch)? > 0 {
        let coordinates = batch.x().zip(batch.y()).zip(batch.z());
        points.extend(coordinates.map(|((x, y), z)| Point3::new(x, y, z)));
    }
    Ok(points)
}

/// `None` if a count or a size in the file cannot be true.
fn check(bytes: &[u8], header: &Header) -> Option<()> {
    let packed = bytes.len().checked_sub(header.point_data)?;
    let items = Items::find(bytes, header)?;
    let plausible = header.points <= packed.saturating_mul(MOST_POINTS_PER_BYTE)
        && items.record_length == header.record_length
        && chunk_count(bytes, header.point_data) <= bytes.len();
    if !plausible {
        return None;
    }
    match items.compressor {
        LAYERED => check_layers(bytes, header, &items),
        _ => Some(()),
    }
}

/// The compressor of LAS 1.4 points: the parts of a point are packed apart, each chunk begins with their sizes.
const LAYERED: usize = 3;

/// What the `LASzip` record says about how points are packed.
struct Items {
    compressor: usize,
    /// Points per chunk, `u32::MAX` or 0 if chunks differ.
    chunk: usize,
    record_length: usize,
    /// Sizes at the start of a layered chunk.
    layers: usize,
}

impl Items {
    /// Finds the `LASzip` record among the variable length records.
    fn find(bytes: &[u8], header: &Header) -> Option<Items> {
        const RECORD_HEADER: usize = 54;
        let mut at = header.header_length;
        for _ in 0..header.records {
            let length = number(bytes, at + 20, Scalar::U16)?;
            let content = bytes.get(at + RECORD_HEADER..)?.get(..length)?;
            if bytes.get(at + 2..)?.starts_with(b"laszip encoded")
                && number(bytes, at + 18, Scalar::U16)? == 22204
            {
                return Items::parse(content);
            }
            at += RECORD_HEADER + length;
        }
        None
    }

    fn parse(content: &[u8]) -> Option<Items> {
        let mut items = Items {
            compressor: number(content, 0, Scalar::U16)?,
            chunk: number(content, 12, Scalar::U32)?,
            record_length: 0,
            layers: 0,
        };
        for item in 0..number(content, 32, Scalar::U16)? {
            let at = 34 + 6 * item;
            let (kind, size) =
                (number(content, at, Scalar::U16)?, number(content, at + 2, Scalar::U16)?);
            items.record_length += size;
            // Layers of Point14, RGB14, RGBNIR14, WavePacket14 and, one for each byte, Byte14.
            items.layers += match kind {
                10 => 9,
                11 | 13 => 1,
                12 => 2,
                14 => size,
                _ => 0,
            };
        }
        Some(items)
    }
}

/// How many chunks the table of chunks claims; 0 where there is no table.
fn chunk_count(bytes: &[u8], point_data: usize) -> usize {
    let offset_at = |at: Option<usize>| {
        at.and_then(|at| number(bytes, at, Scalar::I64)).filter(|&at| at > point_data)
    };
    // A writer that could not go back has put the table's offset at the end of the file.
    let table = offset_at(Some(point_data)).or_else(|| offset_at(bytes.len().checked_sub(8)));
    table.and_then(|table| number(bytes, table.checked_add(4)?, Scalar::U32)).unwrap_or(0)
}

/// Walks over the layered chunks: a raw point, a count, the sizes of the layers, the layers.
fn check_layers(bytes: &[u8], header: &Header, items: &Items) -> Option<()> {
    const TABLE_OFFSET: usize = 8;
    let variable = items.chunk == 0 || items.chunk == u32::MAX as usize;
    let (mut at, mut left) = (header.point_data + TABLE_OFFSET, header.points);
    while left > 0 {
        at += header.record_length;
        let counted = number(bytes, at, Scalar::U32)?;
        let sizes = (0..items.layers).map(|layer| number(bytes, at + 4 + 4 * layer, Scalar::U32));
        let layers = sizes.sum::<Option<usize>>()?;
        at += 4 + 4 * items.layers + layers;
        if at > bytes.len() {
            return None;
        }
        left = left.saturating_sub(if variable { counted.max(1) } else { items.chunk });
    }
    Some(())
}

fn number(bytes: &[u8], at: usize, scalar: Scalar) -> Option<usize> {
    scalar.read(bytes.get(at..)?, ByteOrder::Little).map(|value| value as usize)
}
