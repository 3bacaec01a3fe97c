//! Clouds as networks want them: in single precision near the origin, points as far apart as those of the training data.

use rare::Result;
use rare::data::resolution;
use rare::nalgebra::{Point3, Vector3};

use super::kpconv::{Point, subsample};

/// A cloud with more points than this for each occupied voxel is thinned.
///
/// One that was thinned already has 1 if its grid was the same, and more if it was shifted against ours, because
/// barycentres of neighbouring voxels then share one of ours: up to 1.8 in rooms. One whose points are half as far apart
/// has at least 3.6, and surfaces seen from close by have tens.
const DENSE: f64 = 2.5;

/// Coordinates beyond so many voxels are brought near the origin: single precision then rounds by less than a
/// thousandth of a voxel.
const FAR: f64 = 4096.0;

/// Points are too far apart if they are so many times farther apart than those of the training data.
const WIDE: f64 = 2.0;

/// The median distance to the nearest neighbour in a cloud that was thinned to voxels of 1 (0.53 in rooms).
const NEAREST: f64 = 0.55;

/// A cloud as a network takes it.
pub(super) struct Sampled {
    /// The points, metres.
    pub(super) points: Vec<Point>,
    /// What was subtracted from them.
    pub(super) shift: Vector3<f64>,
}

/// Thins a cloud to one point for each voxel (metres) if it is denser, and brings it near the origin if it is far away, by
/// multiples of `step`, which keeps it where it is in the grids of a pyramid.
///
/// # Errors
/// `InvalidInput` if a point is not finite or the cloud spans too many voxels.
pub(super) fn sampled(points: &[Point3<f64>], voxel: f64, step: f64) -> Result<Sampled> {
    let shift = shift(points, voxel, step);
    let near = |point: &Point3<f64>| {
        let moved = point - shift;
        [moved.x as f32, moved.y as f32, moved.z as f32]
    };
    let points: Vec<Point> = points.iter().map(near).collect();
    let thinned = subsample(&points, voxel as f32)?;
    let dense = points.len() as f64 > DENSE * thinned.len() as f64;
    Ok(Sampled { points: if dense { thinned } else { points }, shift })
}

fn shift(points: &[Point3<f64>], voxel: f64, step: f64) -> Vector3<f64> {
    let largest = points.iter().flat_map(|point| point.iter()).fold(0.0_f64, |a, b| a.max(b.abs()));
    if largest <= FAR * voxel {
        return Vector3::zeros();
    }
    let sum: Vector3<f64> = points.iter().map(|point| point.coords).sum();
    (sum / points.len().max(1) as f64).map(|coordinate| (coordinate / step).round() * step)
}

impl Sampled {
    /// That of [`warning`].
    pub(super) fn warning(&self, name: &str, trained: f64) -> Option<String> {
        let points: Vec<Point3<f64>> =
            self.points.iter().map(|point| Point3::from(point.map(f64::from))).collect();
        warning(&points, name, trained)
    }
}

/// What to say if points are much farther apart than those that the network was trained on, which were thinned to voxels
/// of `trained` metres. Spacings are given as the voxels to which such clouds were thinned.
pub(super) fn warning(points: &[Point3<f64>], name: &str, trained: f64) -> Option<String> {
    let spacing = resolution(points) / NEAREST;
    (spacing > WIDE * trained).then(|| {
        format!("trained on points {trained} m apart, the {name}'s are {spacing:.2} m apart")
    })
}
