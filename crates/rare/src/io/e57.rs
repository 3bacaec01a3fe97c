//! E57 (ASTM E2807): the scans of a terrestrial laser scanner, each in its own frame with a pose.
//!
//! All scans of a file are brought into the file's common frame and joined. The crate `e57` takes the file apart.

use std::io::Cursor;

use ::e57::{CartesianCoordinate, E57Reader, PointCloud, RecordDataType, Transform};
use nalgebra::{Point3, Quaternion, Translation3, UnitQuaternion};

use super::contain_panics::contain_panics;
use crate::error::{Error, Result};

/// What every E57 file begins with.
pub(super) const MAGIC: &[u8] = b"ASTM-E57";

/// The valid points of all scans in the frame of the file.
///
/// # Errors
/// `InvalidInput` if the file is cut off or damaged, a scan has more points than the file can hold, or a pose is not
/// rigid.
pub(super) fn read(bytes: &[u8]) -> Result<Vec<Point3<f64>>> {
    contain_panics(|| {
        let mut reader = E57Reader::new(Cursor::new(bytes)).map_err(|error| damaged(&error))?;
        let mut points = Vec::new();
        for scan in reader.pointclouds() {
            check_count(&scan, bytes.len())?;
            append(&mut reader, &scan, &mut points)?;
        }
        Ok(points)
    })
}

/// Reads one scan; points that are marked invalid or are mere directions are passed over.
fn append(
    reader: &mut E57Reader<Cursor<&[u8]>>,
    scan: &PointCloud,
    points: &mut Vec<Point3<f64>>,
) -> Result<()> {
    let file_from_scan = pose(scan.transform.as_ref())?;
    let mut records = reader.pointcloud_simple(scan).map_err(|error| damaged(&error))?;
    // The crate would apply a quaternion of another length than 1 as a scale.
    records.apply_pose(false);
    records.intensity_to_color(false);
    for record in records {
        if let CartesianCoordinate::Valid { x, y, z } =
            record.map_err(|error| damaged(&error))?.cartesian
        {
            points.push(file_from_scan * Point3::new(x, y, z));
        }
    }
    Ok(())
}

fn pose(transform: Option<&Transform>) -> Result<nalgebra::Isometry3<f64>> {
    const LENGTH_TOLERANCE: f64 = 1e-3;
    let Some(Transform { rotation, translation }) = transform else {
        return Ok(nalgebra::Isometry3::identity());
    };
    let quaternion = Quaternion::new(rotation.w, rotation.x, rotation.y, rotation.z);
    let length = quaternion.norm();
    if !length.is_finite() || (length - 1.0).abs() > LENGTH_TOLERANCE {
        return Err(Error::invalid(format!(
            "the pose of a scan has a quaternion of length {length}, it must be 1: export the file again"
        )));
    }
    let translation = Translation3::new(translation.x, translation.y, translation.z);
    Ok(nalgebra::Isometry3::from_parts(translation, UnitQuaternion::from_quaternion(quaternion)))
}

/// Compares the number of points with the bits that one takes. Points that take none at all, because every column is
/// constant, are refused however few they are: the crate makes them up without end.
fn check_count(scan: &PointCloud, length: usize) -> Result<()> {
    let bits: u64 = scan.prototype.iter().map(|record| bits(&record.data_type)).sum();
    if bits == 0 || scan.records.saturating_mul(bits) > (length as u64).saturating_mul(8) {
        return Err(Error::invalid(format!(
            "a scan of the E57 file promises {} points of {bits} bits, the file has {length} bytes: it is cut off or \
             damaged, export it again",
            scan.records
        )));
    }
    Ok(())
}

/// Bits that one value takes in the file.
fn bits(kind: &RecordDataType) -> u64 {
    match *kind {
        RecordDataType::Single { .. } => 32,
        RecordDataType::Double { .. } => 64,
        RecordDataType::Integer { min, max } | RecordDataType::ScaledInteger { min, max, .. } => {
            u64::from(i64::BITS - min.abs_diff(max).leading_zeros())
        }
    }
}

fn damaged(error: &::e57::Error) -> Error {
    Error::invalid(format!("the E57 file is damaged ({error}): export it again"))
}
