//! Clouds as networks want them: in single precision near the origin, points as far apart as those of the training data.

use rare::data::resolution;
use rare::nalgebra::{Point3, Vector3};
use rare::{Error, Result};

use super::kpconv::{Point, PyramidConfig, subsample, usual_neighbours};

/// A cloud is thinned if its points have so many times more neighbours than those of the training data.
///
/// Clouds that were thinned to the voxel have 0.6 to 1.2 times as many wherever their grid began, single frames of a depth
/// camera twice as many, lidar scans at 0.2 m three times as many (measured on rooms and streets). Counting points per
/// voxel would not tell them apart: a cloud that was thinned by another grid has up to 1.8.
const DENSE: f64 = 1.35;

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

/// Thins a cloud to one point for each voxel if it is denser, and brings it near the origin if it is far away, by
/// multiples of what lies above the coarsest voxel, which keeps it where it is in the grids of a pyramid. `name` is the
/// cloud's for messages.
///
/// # Errors
/// `InvalidInput` if a point is not finite or the cloud spans too many voxels.
pub(super) fn sampled(
    points: &[Point3<f64>],
    name: &str,
    config: &PyramidConfig,
) -> Result<Sampled> {
    let shift = shift(points, config.voxel, config.voxel(config.stages));
    let near = |point: &Point3<f64>| {
        let moved = point - shift;
        [moved.x as f32, moved.y as f32, moved.z as f32]
    };
    let points: Vec<Point> = points.iter().map(near).collect();
    let points = thinned_if_dense(points, config).map_err(|error| match error {
        Error::InvalidInput(what) => Error::invalid(format!("the {name}: {what}")),
        other => other,
    })?;
    Ok(Sampled { points, shift })
}

fn thinned_if_dense(points: Vec<Point>, config: &PyramidConfig) -> Result<Vec<Point>> {
    let neighbours = usual_neighbours(&points, config.radius(0) as f32)? as f64;
    if neighbours > DENSE * config.trained_neighbours() {
        subsample(&points, config.voxel as f32)
    } else {
        Ok(points)
    }
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

#[cfg(test)]
mod tests {
    use rare::data::voxel_downsample;
    use rare::nalgebra::Rotation3;

    use super::*;

    const CONFIG: PyramidConfig =
        PyramidConfig { voxel: 0.025, stages: 4, radius: 2.5, sigma: 2.0 };

    /// A simulated scan of a room, turned and moved, thinned to a spacing.
    fn room(spacing: f64, turn: f64) -> Vec<Point3<f64>> {
        let pair = rare::synthetic::demo_pair(1).unwrap();
        let rotation = Rotation3::new(Vector3::new(turn, 0.7 * turn, -0.3 * turn));
        let place = |point: &Point3<f64>| rotation * point + Vector3::new(0.03, turn, 0.05);
        let points: Vec<Point3<f64>> = pair.target.points().iter().map(place).collect();
        voxel_downsample(&points, spacing).unwrap()
    }

    #[test]
    fn only_clouds_that_are_denser_than_the_voxel_are_thinned() {
        for turn in [0.0, 0.4, 1.1] {
            let fitting = room(0.025, turn);
            let rotation = Rotation3::new(Vector3::new(0.5, turn, 0.2));
            let moved: Vec<Point3<f64>> = fitting.iter().map(|point| rotation * point).collect();
            let kept = sampled(&moved, "source", &CONFIG).unwrap().points.len();
            assert_eq!(kept, fitting.len(), "turned by {turn}");
            let dense = room(0.0125, turn);
            let thinned = sampled(&dense, "source", &CONFIG).unwrap().points.len();
            assert!(2 * thinned < dense.len(), "{thinned} of {}", dense.len());
            assert!(5 * thinned > 4 * fitting.len(), "{thinned}, {}", fitting.len());
        }
    }

    #[test]
    fn far_clouds_come_near_by_whole_cubes_and_bad_ones_are_named() {
        let far = Vector3::new(1.6e6, -3.2e5, 1.6e4);
        let points: Vec<Point3<f64>> = room(0.025, 0.0).iter().map(|point| point + far).collect();
        let near = sampled(&points, "source", &CONFIG).unwrap();
        assert!(near.points.iter().flatten().all(|value| value.abs() < 100.0));
        let cubes = near.shift / CONFIG.voxel(CONFIG.stages);
        assert!((cubes - cubes.map(f64::round)).norm() < 1e-9, "{cubes}");
        let bad = [Point3::new(0.0, f64::NAN, 0.0)];
        let message = sampled(&bad, "target", &CONFIG).err().unwrap().to_string();
        assert!(message.contains("the target"), "{message}");
    }
}
