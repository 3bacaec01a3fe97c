//! KITTI `.bin`: `x y z reflectance` as little-endian 32-bit floats, without a header.
//! (A. Geiger et al., "Vision meets Robotics: The KITTI Dataset", IJRR 2013)

use nalgebra::Point3;

use super::scalar::{ByteOrder, Column, Scalar, read_points};
use crate::error::{Error, Result};

/// Bytes per point.
const RECORD: usize = 16;

/// The points of a KITTI scan, metres, in the sensor's frame.
///
/// # Errors
/// `InvalidInput` if the length is not a multiple of 16 bytes or the content is text.
pub(super) fn read(bytes: &[u8]) -> Result<Vec<Point3<f64>>> {
    if !bytes.len().is_multiple_of(RECORD) {
        return Err(Error::invalid(format!(
            "a KITTI scan has 16 bytes per point, {} bytes are no multiple of that: the file is cut off or in another \
             format",
            bytes.len()
        )));
    }
    // Any bytes are floats, so a text that happens to have the right length would be read as nonsense.
    let start = &bytes[..bytes.len().min(4096)];
    if start.iter().all(|&byte| byte.is_ascii_graphic() || byte.is_ascii_whitespace()) {
        return Err(Error::invalid(
            "this is text, no KITTI scan: if it has a point per line, name it .xyz",
        ));
    }
    let column = |offset| Column { offset, stride: RECORD, scalar: Scalar::F32 };
    let columns = [column(0), column(4), column(8)];
    read_points(bytes, &columns, bytes.len() / RECORD, ByteOrder::Little).ok_or_else(|| {
        Error::Internal("a KITTI scan of whole points ends within a point".to_owned())
    })
}
