//! Point clouds: finite points near the origin, and where that origin stands in the caller's frame.

use nalgebra::{Point3, Vector3};

use crate::data::RigidTransform;
use crate::error::{Error, Result};

/// Clouds further than this from the origin, metres, are recentred. Below it a sensor at the origin stays there.
const RECENTRE_BEYOND: f64 = 10_000.0;

/// A cloud of at least one point, all finite.
///
/// Georeferenced coordinates (UTM: 10^5 to 10^7 m) are shifted to the neighbourhood of the origin on the way in, so
/// that products of coordinates keep their millimetres: `world = local + shift`. Everything in this crate works on
/// local points; [`PointCloud::to_world`] and [`PointCloud::to_local`] move poses between the frames.
#[derive(Debug, Clone, PartialEq)]
pub struct PointCloud {
    points: Vec<Point3<f64>>,
    shift: Vector3<f64>,
    dropped: usize,
}

impl PointCloud {
    /// Takes points in the caller's frame, metres; drops (and counts) those that are not finite, and recentres the
    /// cloud if it lies more than 10 km from the origin.
    ///
    /// # Errors
    /// `InvalidInput` if no finite point is left.
    pub fn new(mut points: Vec<Point3<f64>>) -> Result<PointCloud> {
        let given = points.len();
        points.retain(|point| point.coords.iter().all(|value| value.is_finite()));
        let dropped = given - points.len();
        if points.is_empty() {
            return Err(Error::invalid(if given == 0 {
                "the cloud is empty: there is no point in it".to_owned()
            } else {
                format!("the cloud has no finite point: all {given} are NaN or infinite")
            }));
        }
        let shift = recentring_shift(&points);
        if shift != Vector3::zeros() {
            for point in &mut points {
                *point -= shift;
            }
        }
        Ok(PointCloud { points, shift, dropped })
    }

    /// The points, in the local frame, metres. Never empty.
    #[must_use]
    pub fn points(&self) -> &[Point3<f64>] {
        &self.points
    }

    /// Number of points (at least 1).
    #[must_use]
    #[expect(clippy::len_without_is_empty, reason = "a cloud is never empty")]
    pub fn len(&self) -> usize {
        self.points.len()
    }

    /// What was subtracted from the caller's coordinates: `world = local + shift`, metres, whole numbers.
    #[must_use]
    pub fn shift(&self) -> &Vector3<f64> {
        &self.shift
    }

    /// How many points were dropped because a coordinate was NaN or infinite.
    #[must_use]
    pub fn dropped(&self) -> usize {
        self.dropped
    }

    /// The corners of the axis-aligned bounding box, local frame.
    #[must_use]
    pub fn bounds(&self) -> (Point3<f64>, Point3<f64>) {
        bounds(&self.points)
    }

    /// The points of the cloud in the caller's frame.
    #[must_use]
    pub fn world_points(&self) -> Vec<Point3<f64>> {
        self.points.iter().map(|point| point + self.shift).collect()
    }

    /// Rewrites a pose between the callers' frames of two clouds as one between their local frames.
    #[must_use]
    pub fn to_local(
        target: &PointCloud,
        source: &PointCloud,
        target_from_source: &RigidTransform,
    ) -> RigidTransform {
        // R (s + shift_s) + t - shift_t, with the large numbers cancelled before anything else is added.
        let moved = target_from_source.rotate(&source.shift) - target.shift
            + target_from_source.translation();
        RigidTransform::new(*target_from_source.rotation(), moved)
    }

    /// The inverse of [`PointCloud::to_local`].
    #[must_use]
    pub fn to_world(
        target: &PointCloud,
        source: &PointCloud,
        target_from_source: &RigidTransform,
    ) -> RigidTransform {
        let moved = target_from_source.translation() + target.shift
            - target_from_source.rotate(&source.shift);
        RigidTransform::new(*target_from_source.rotation(), moved)
    }
}

/// The corners of the axis-aligned bounding box of some points (`(inf, -inf)` corners for none).
pub(crate) fn bounds(points: &[Point3<f64>]) -> (Point3<f64>, Point3<f64>) {
    let low = Point3::from([f64::INFINITY; 3]);
    let high = Point3::from([f64::NEG_INFINITY; 3]);
    points.iter().fold((low, high), |(low, high), point| (low.inf(point), high.sup(point)))
}

/// The whole-metre centre of the bounding box if the cloud is far from the origin, otherwise zero.
fn recentring_shift(points: &[Point3<f64>]) -> Vector3<f64> {
    let (low, high) = bounds(points);
    // Halves first: the sum of two huge coordinates could overflow.
    let centre = (low.coords * 0.5 + high.coords * 0.5).map(f64::round);
    if centre.amax() > RECENTRE_BEYOND { centre } else { Vector3::zeros() }
}

#[cfg(test)]
mod tests {
    use nalgebra::Rotation3;

    use super::*;

    #[test]
    fn points_that_are_not_finite_are_dropped_and_counted() {
        let points = vec![
            Point3::new(1.0, 2.0, 3.0),
            Point3::new(f64::NAN, 0.0, 0.0),
            Point3::new(0.0, f64::INFINITY, 0.0),
        ];
        let cloud = PointCloud::new(points).unwrap();
        assert_eq!((cloud.len(), cloud.dropped()), (1, 2));
        assert!(PointCloud::new(Vec::new()).unwrap_err().to_string().contains("empty"));
        assert!(
            PointCloud::new(vec![Point3::new(f64::NAN, 0.0, 0.0)])
                .unwrap_err()
                .to_string()
                .contains("finite")
        );
    }

    #[test]
    fn georeferenced_clouds_are_recentred_and_poses_follow() {
        let offset = Vector3::new(500_123.25, 5_400_321.5, 120.0);
        let near: Vec<_> =
            (0..10).map(|i| Point3::new(f64::from(i), f64::from(i * i % 7), 0.5)).collect();
        let source = PointCloud::new(near.iter().map(|p| p + offset).collect()).unwrap();
        let target = PointCloud::new(
            near.iter().map(|p| p + offset + Vector3::new(3.0, 0.0, 0.0)).collect(),
        )
        .unwrap();
        assert!(source.points().iter().all(|p| p.coords.amax() < 100.0));
        assert_eq!(source.world_points()[3], near[3] + offset);
        let pose = RigidTransform::new(
            Rotation3::new(Vector3::new(0.0, 0.0, 1e-3)),
            Vector3::new(5403.0, -498.0, 1.0),
        );
        let local = PointCloud::to_local(&target, &source, &pose);
        let expected = pose.apply(&source.world_points()[4]) - target.shift();
        assert!((local.apply(&source.points()[4]) - expected).norm() < 1e-8);
        assert!(PointCloud::to_world(&target, &source, &local).error_to(&pose).translation < 1e-8);
    }

    #[test]
    fn a_cloud_around_its_sensor_keeps_its_origin() {
        let cloud =
            PointCloud::new(vec![Point3::new(-80.0, 3.0, 1.0), Point3::new(90.0, 2.0, 0.0)])
                .unwrap();
        assert_eq!(cloud.shift(), &Vector3::zeros());
    }
}
