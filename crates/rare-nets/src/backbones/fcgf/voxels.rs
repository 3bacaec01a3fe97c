//! The voxels of a cloud.

use rare::nalgebra::Point3;
use rare::{Error, Result};

use super::coordinates::{Coordinate, CoordinateMap, FURTHEST};

/// The voxels of a cloud that hold a point.
pub(super) struct Voxels {
    /// The first point in each voxel: indices into the cloud, ascending.
    pub(super) kept: Vec<usize>,
    /// Their coordinates, in the same order: `floor(point / voxel)`.
    pub(super) coordinates: CoordinateMap,
}

/// Finds the voxels of edge `voxel`, metres, that hold points.
///
/// # Errors
/// `InvalidInput` if the edge is not positive, or a point lies more than a million voxels from the origin.
pub(super) fn voxelise(points: &[Point3<f64>], voxel: f64) -> Result<Voxels> {
    if !(voxel.is_finite() && voxel > 0.0) {
        return Err(Error::invalid(format!("voxels need a positive edge, got {voxel} m")));
    }
    let mut kept = Vec::new();
    let mut coordinates = CoordinateMap::new(1);
    for (index, point) in points.iter().enumerate() {
        if coordinates.insert(coordinate(point, voxel)?) {
            kept.push(index);
        }
    }
    Ok(Voxels { kept, coordinates })
}

fn coordinate(point: &Point3<f64>, voxel: f64) -> Result<Coordinate> {
    let place = (point.coords / voxel).map(f64::floor);
    // What is not a number is not within the limit either.
    if !place.iter().all(|value| value.abs() <= f64::from(FURTHEST)) {
        return Err(Error::invalid(format!(
            "the point ({}, {}, {}) is more than {FURTHEST} voxels of {voxel} m from the origin: \
             recentre the cloud, or check the unit of its coordinates (metres)",
            point.x, point.y, point.z
        )));
    }
    Ok([place.x as i32, place.y as i32, place.z as i32])
}
