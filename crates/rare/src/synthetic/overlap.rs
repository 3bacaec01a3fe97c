//! How much of what one sensor sees another one sees too, before noise and holes.

use nalgebra::{Matrix3, Point3, Vector3};

use crate::data::RigidTransform;
use crate::synthetic::scene::{RayCaster, Scene};

/// How far from a surface point the ray of the other sensor may end and still be said to see it, metres.
const SAME_SURFACE: f64 = 0.01;

/// A surface point in the world, and what it lies on.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sighting {
    pub(super) point: Point3<f64>,
    pub(super) normal: Vector3<f64>,
    pub(super) solid: usize,
}

/// A sensor reduced to some of its rays and its field of view.
pub(super) struct Survey<'a, Reaches: Fn(&Point3<f64>) -> bool> {
    pub(super) scene: &'a Scene,
    /// Directions in the sensor's frame.
    pub(super) rays: Vec<Vector3<f64>>,
    /// Whether a point (sensor's frame) is in view and in range.
    pub(super) reaches: Reaches,
}

impl<Reaches: Fn(&Point3<f64>) -> bool> Survey<'_, Reaches> {
    /// What the sensor sees from a pose: at most one point per ray.
    pub(super) fn look(&self, world_from_sensor: &RigidTransform) -> Vec<Sighting> {
        let origin = Point3::from(*world_from_sensor.translation());
        let caster = RayCaster::new(self.scene, &origin);
        let sightings = self.rays.iter().filter_map(|ray| {
            let direction = world_from_sensor.rotate(ray);
            let hit = caster.cast(&direction)?;
            (self.reaches)(&Point3::from(ray * hit.distance)).then(|| Sighting {
                point: origin + direction * hit.distance,
                normal: hit.normal,
                solid: hit.solid,
            })
        });
        sightings.collect()
    }

    /// Those of the sightings that the sensor sees from a pose.
    pub(super) fn seen_again(
        &self,
        sightings: &[Sighting],
        world_from_sensor: &RigidTransform,
    ) -> Vec<Sighting> {
        let origin = Point3::from(*world_from_sensor.translation());
        let caster = RayCaster::new(self.scene, &origin);
        let sensor_from_world = world_from_sensor.inverse();
        let visible = |sighting: &&Sighting| {
            let towards = sighting.point - origin;
            let is_free = |limit: f64| {
                caster.cast(&towards).is_some_and(|hit| (hit.distance - 1.0).abs() < limit)
            };
            (self.reaches)(&sensor_from_world.apply(&sighting.point))
                && sighting.normal.dot(&towards) < 0.0
                && is_free(SAME_SURFACE / towards.norm())
        };
        sightings.iter().filter(visible).copied().collect()
    }
}

/// The share of `part` in `whole`; 0 of nothing.
pub(super) fn share(part: &[Sighting], whole: &[Sighting]) -> f64 {
    if whole.is_empty() { 0.0 } else { part.len() as f64 / whole.len() as f64 }
}

/// How well sightings fix a shift in its least certain direction: the smallest eigenvalue of the mean of `n n^T`,
/// 0 for a plane, 1/3 at best.
pub(super) fn directional_spread(sightings: &[Sighting]) -> f64 {
    let sum =
        sightings.iter().fold(Matrix3::zeros(), |sum, s| sum + s.normal * s.normal.transpose());
    (sum / sightings.len().max(1) as f64).symmetric_eigenvalues().min()
}

/// The number of different solids among the sightings.
pub(super) fn distinct_solids(sightings: &[Sighting]) -> usize {
    let mut solids: Vec<usize> = sightings.iter().map(|sighting| sighting.solid).collect();
    solids.sort_unstable();
    solids.dedup();
    solids.len()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::views::{looking, survey_with_camera};
    use crate::synthetic::{DepthSensor, Room};

    #[test]
    fn a_view_overlaps_itself_and_not_the_opposite_one() {
        let room = Room::new(1);
        let sensor = DepthSensor::default();
        let survey = survey_with_camera(&room.scene, &sensor);
        let pose = |heading| looking(Point3::new(2.5, 0.5, 1.5), heading, -0.2, 0.0);
        let seen = survey.look(&pose(1.5));
        assert_eq!(share(&survey.seen_again(&seen, &pose(1.5)), &seen), 1.0);
        assert_eq!(share(&survey.seen_again(&seen, &pose(-1.5)), &seen), 0.0);
        let turned = share(&survey.seen_again(&seen, &pose(1.8)), &seen);
        assert!(turned > 0.5 && turned < 0.8, "{turned}");
    }

    #[test]
    fn what_hides_behind_something_is_not_seen_again() {
        let mut scene = Scene::default();
        scene.add_box(Point3::new(-3.0, 5.0, 0.0), Vector3::new(6.0, 1.0, 4.0), 0.0);
        scene.add_box(Point3::new(3.0, 5.0, 0.0), Vector3::new(6.0, 1.0, 4.0), 0.0);
        let sensor = DepthSensor::default();
        let pose = looking(Point3::new(0.0, 0.0, 1.5), 1.57, 0.0, 0.0);
        let seen = survey_with_camera(&scene, &sensor).look(&pose);
        assert_eq!((distinct_solids(&seen), directional_spread(&seen)), (2, 0.0));
        scene.add_box(Point3::new(0.8, 3.0, 0.0), Vector3::new(0.6, 0.2, 4.0), 0.0);
        let again = survey_with_camera(&scene, &sensor).seen_again(&seen, &pose);
        assert_eq!(distinct_solids(&again), 2);
        // The box covers 0.5 to 1.1 m of the 3.2 m wide view at its distance.
        let hidden = 1.0 - share(&again, &seen);
        assert!((hidden - 0.6 / 3.17).abs() < 0.03, "{hidden}");
    }
}
