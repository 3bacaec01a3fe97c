//! Where the sensors of a pair stand: the poses, their overlap, and the search for two views of a room.

use std::ops::RangeInclusive;

use nalgebra::{Point3, Rotation3, Vector3};

use crate::data::RigidTransform;
use crate::random::Random;
use crate::synthetic::overlap::{Survey, directional_spread, distinct_solids, share};
use crate::synthetic::room::between;
use crate::synthetic::{DepthSensor, Room, Scene};

/// Every how many pixels or rays the overlap is judged.
pub(super) const SURVEY_STEP: usize = 12;
/// How many ways to move the camera are tried for a room pair.
const MAX_MOTIONS: usize = 64;

/// Where both sensors stood.
pub(super) struct Poses {
    pub(super) world_from_source: RigidTransform,
    pub(super) world_from_target: RigidTransform,
}

impl Poses {
    pub(super) fn target_from_source(&self) -> RigidTransform {
        self.world_from_target.inverse() * self.world_from_source
    }

    pub(super) fn overlap(&self, survey: &Survey<impl Fn(&Point3<f64>) -> bool>) -> f64 {
        let seen = survey.look(&self.world_from_source);
        share(&survey.seen_again(&seen, &self.world_from_target), &seen)
    }
}

/// The camera's view of a scene, by some of its pixels.
pub(super) fn survey_with_camera<'a>(
    scene: &'a Scene,
    sensor: &'a DepthSensor,
) -> Survey<'a, impl Fn(&Point3<f64>) -> bool + use<'a>> {
    let rows = (0..sensor.intrinsics.height).step_by(SURVEY_STEP);
    let columns = || (0..sensor.intrinsics.width).step_by(SURVEY_STEP);
    let rays = rows.flat_map(|v| columns().map(move |u| sensor.ray(u, v))).collect();
    Survey { scene, rays, reaches: move |point: &Point3<f64>| sensor.reaches(point) }
}

/// A camera at `place` (world, z up) that looks along `heading` and `pitch` (up), its image turned by `roll`; radians.
pub(super) fn looking(place: Point3<f64>, heading: f64, pitch: f64, roll: f64) -> RigidTransform {
    let forward =
        Vector3::new(heading.cos() * pitch.cos(), heading.sin() * pitch.cos(), pitch.sin());
    let right = Vector3::new(heading.sin(), -heading.cos(), 0.0);
    let axes = Rotation3::from_basis_unchecked(&[right, forward.cross(&right), forward]);
    RigidTransform::new(axes * Rotation3::from_axis_angle(&Vector3::z_axis(), roll), place.coords)
}

/// A motion of the camera along which the overlap falls from 1 towards 0.
struct Motion {
    start: Point3<f64>,
    heading: f64,
    pitch: f64,
    /// How far the camera has moved and turned at the end.
    shift: Vector3<f64>,
    turn: Vector3<f64>,
}

impl Motion {
    /// Starts near the free wall of the room and looks into it; turns left while moving right, or the other way.
    fn new(room: &Room, random: &mut Random) -> Motion {
        let side = if random.uniform() < 0.5 { -1.0 } else { 1.0 };
        let start = Point3::new(
            (0.5 - side * between(random, 0.05, 0.2)) * room.size.x,
            between(random, 0.3, 0.7),
            between(random, 1.2, 1.7),
        );
        Motion {
            start,
            heading: std::f64::consts::FRAC_PI_2 - side * between(random, 0.0, 0.25),
            pitch: between(random, -0.45, -0.2),
            shift: Vector3::new(
                side * between(random, 0.8, 1.4),
                between(random, 0.0, 0.4),
                between(random, -0.4, 0.4),
            ),
            turn: Vector3::new(
                side * between(random, 0.8, 1.3),
                between(random, -0.3, 0.2),
                between(random, -0.3, 0.3),
            ),
        }
    }

    /// The pose of the camera after the share `progress` of the motion.
    fn at(&self, progress: f64) -> RigidTransform {
        let turn = self.turn * progress;
        let place = self.start + self.shift * progress;
        looking(place, self.heading + turn.x, self.pitch + turn.y, turn.z)
    }
}

/// Views of a room whose common part lies in the range and fixes the pose, with their overlap.
pub(super) fn find_views(
    room: &Room,
    survey: &Survey<impl Fn(&Point3<f64>) -> bool>,
    range: &RangeInclusive<f64>,
    seed: u64,
) -> Option<(Poses, f64)> {
    let mut random = Random::new(seed, 3);
    let goal = (range.start() + range.end()) / 2.0;
    (0..MAX_MOTIONS).find_map(|_| {
        let motion = Motion::new(room, &mut random);
        let world_from_target = motion.at(0.0);
        let (mut low, mut high) = (0.0, 1.0);
        for _ in 0..8 {
            let middle = (low + high) / 2.0;
            let poses = Poses { world_from_source: motion.at(middle), world_from_target };
            if poses.overlap(survey) > goal { low = middle } else { high = middle }
        }
        let poses = Poses { world_from_source: motion.at((low + high) / 2.0), world_from_target };
        let seen = survey.look(&poses.world_from_source);
        let common = survey.seen_again(&seen, &poses.world_from_target);
        let overlap = share(&common, &seen);
        let is_telling = directional_spread(&common) > 0.05 && distinct_solids(&common) >= 8;
        // Both views must be full of surface, not a close-up with the rest out of range.
        let is_full = 4 * seen.len() > 3 * survey.rays.len();
        (range.contains(&overlap) && is_telling && is_full).then_some((poses, overlap))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_camera_looks_where_it_is_told() {
        let place = Point3::new(1.0, 2.0, 3.0);
        let world_from_camera = looking(place, std::f64::consts::FRAC_PI_2, -0.5, 0.0);
        let ahead = world_from_camera.apply(&Point3::new(0.0, 0.0, 2.0));
        let expected = place + Vector3::new(0.0, 0.5_f64.cos(), -0.5_f64.sin()) * 2.0;
        assert!((ahead - expected).norm() < 1e-12);
        assert!((world_from_camera.rotate(&Vector3::x()) - Vector3::x()).norm() < 1e-12);
        assert!(world_from_camera.rotate(&Vector3::y()).z < -0.8);
        assert!((world_from_camera.rotation().matrix().determinant() - 1.0).abs() < 1e-12);
    }

    #[test]
    fn the_overlap_of_two_views_is_the_one_asked_for() {
        let sensor = DepthSensor::default();
        for seed in 0..6 {
            let room = Room::new(seed);
            let survey = survey_with_camera(&room.scene, &sensor);
            for range in [0.1..=0.3, 0.5..=0.6, 0.7..=0.9] {
                let (poses, overlap) = find_views(&room, &survey, &range, seed).unwrap();
                assert!(range.contains(&overlap), "room {seed}: {overlap}");
                assert_eq!(overlap, poses.overlap(&survey));
            }
        }
    }
}
