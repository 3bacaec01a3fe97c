//! Pairs of scans with a known pose and a wrong start: what registration is given, and what it should find.

use std::ops::RangeInclusive;

use nalgebra::{Point3, Rotation3, Unit, Vector3};

use crate::data::{PointCloud, RigidTransform};
use crate::error::{Error, Result};
use crate::random::Random;
use crate::synthetic::overlap::Survey;
use crate::synthetic::room::between;
use crate::synthetic::views::{Poses, SURVEY_STEP, find_views, looking, survey_with_camera};
use crate::synthetic::{DepthSensor, Lidar, Room, Street, object};

/// Two scans of one scene, the truth, and a start to be refined.
#[derive(Debug, Clone, PartialEq)]
pub struct ScanPair {
    /// The scan that is moved.
    pub source: PointCloud,
    /// The scan that stays.
    pub target: PointCloud,
    /// The true pose.
    pub target_from_source: RigidTransform,
    /// A wrong pose, as a coarse registration would return it.
    pub initial: RigidTransform,
    /// The share of the surface seen by the source's sensor that the target's sensor sees as well (before noise and
    /// holes).
    pub overlap: f64,
}

/// How wrong the start of an indoor pair is: degrees and metres.
const INDOOR_START: (f64, f64) = (12.0, 0.25);
/// How wrong the start of an outdoor pair is.
const OUTDOOR_START: (f64, f64) = (4.0, 1.2);
/// How wrong the start of an object pair is.
const OBJECT_START: (f64, f64) = (10.0, 0.03);

/// Two scans of a room with a depth sensor that overlap by 50 to 60 %, and a start that is 12 degrees and 0.25 m off.
///
/// # Errors
/// `InvalidInput` if no two such views are found.
pub fn demo_pair(seed: u64) -> Result<ScanPair> {
    room_pair(seed, 0.5..=0.6)
}

/// Two scans of the room number `seed` with the default [`DepthSensor`] whose overlap lies in `overlap`, and a start
/// that is 12 degrees and 0.25 m off. Both clouds are in their camera's frame.
///
/// # Errors
/// `InvalidInput` if no two such views are found: the range is empty, too narrow or out of reach.
pub fn room_pair(seed: u64, overlap: RangeInclusive<f64>) -> Result<ScanPair> {
    let room = Room::new(seed);
    let sensor = DepthSensor::default();
    let survey = survey_with_camera(&room.scene, &sensor);
    let Some((poses, share)) = find_views(&room, &survey, &overlap, seed) else {
        return Err(Error::invalid(format!(
            "no two views of room {seed} overlap by {} to {} (shares from 0 to 1): widen the range or take another seed",
            overlap.start(),
            overlap.end()
        )));
    };
    let scan = |pose, stream| sensor.scan(&room.scene, pose, sub_seed(seed, stream));
    let source = scan(&poses.world_from_source, 1);
    let target = scan(&poses.world_from_target, 2);
    poses.into_pair(source, target, share, INDOOR_START, seed)
}

/// Two scans of the street number `seed` with the default [`Lidar`], 1.8 m above the ground, 6 to 10 m and some degrees
/// apart, and a start that is 4 degrees and 1.2 m off. Both clouds are in their sensor's frame.
///
/// # Errors
/// `InvalidInput` if a scan is empty, which the default sensor does not let happen.
pub fn street_pair(seed: u64) -> Result<ScanPair> {
    let street = Street::new(seed);
    let lidar = Lidar::default();
    let mut random = Random::new(seed, 3);
    let distance = between(&mut random, 6.0, 10.0);
    let mut stand = |x: f64| {
        let place = Vector3::new(x, between(&mut random, -1.5, 1.5), street.ground(x) + 1.8);
        let climb = if x > 0.0 { -street.slope.atan() } else { 0.0 };
        let turn = Rotation3::from_euler_angles(
            between(&mut random, -0.01, 0.01),
            climb,
            between(&mut random, -0.15, 0.15),
        );
        RigidTransform::new(turn, place)
    };
    let poses = Poses { world_from_target: stand(-3.0), world_from_source: stand(distance - 3.0) };
    let steps = (0..lidar.steps).step_by(SURVEY_STEP);
    let rays = steps.flat_map(|step| (0..lidar.rings).map(move |ring| lidar.ray(ring, step)));
    let survey = Survey {
        scene: &street.scene,
        rays: rays.collect(),
        reaches: |point: &Point3<f64>| lidar.reaches(point),
    };
    let share = poses.overlap(&survey);
    let scan = |pose, stream| lidar.scan(&street.scene, pose, sub_seed(seed, stream));
    let (source, target) = (scan(&poses.world_from_source, 1), scan(&poses.world_from_target, 2));
    poses.into_pair(source, target, share, OUTDOOR_START, seed)
}

/// Two scans of the object number `seed`, from two sides 60 degrees apart, and a start that is 10 degrees and 0.03 m off.
/// The clouds are not in a sensor's frame: each is turned at random, with the object around its origin.
///
/// # Errors
/// `InvalidInput` if a scan is empty, which the default sensor does not let happen.
pub fn object_pair(seed: u64) -> Result<ScanPair> {
    let scene = object(seed);
    let sensor = DepthSensor::default();
    let mut random = Random::new(seed, 3);
    let (side, height) =
        (between(&mut random, 0.0, std::f64::consts::TAU), between(&mut random, 0.1, 0.4));
    let stand = |angle: f64| {
        let place = Point3::new(angle.cos(), angle.sin(), height) * 0.75;
        looking(place, angle + std::f64::consts::PI, -height.atan(), 0.0)
    };
    let views = Poses {
        world_from_target: stand(side),
        world_from_source: stand(side + 60_f64.to_radians()),
    };
    let share = views.overlap(&survey_with_camera(&scene, &sensor));
    let scan = |world_from_camera: &RigidTransform, world_from_cloud: &RigidTransform, stream| {
        let points = sensor.scan(&scene, world_from_camera, sub_seed(seed, stream));
        (world_from_cloud.inverse() * *world_from_camera).apply_all(&points)
    };
    let mut turned = || {
        let turn = Vector3::from_fn(|_, _| random.normal());
        RigidTransform::new(Rotation3::new(turn), Vector3::zeros())
    };
    let frames = Poses { world_from_target: turned(), world_from_source: turned() };
    let source = scan(&views.world_from_source, &frames.world_from_source, 1);
    let target = scan(&views.world_from_target, &frames.world_from_target, 2);
    frames.into_pair(source, target, share, OBJECT_START, seed)
}

/// A pose that is wrong by exactly `degrees` and `metres`: turns by `degrees` about a random axis through `about` (target
/// frame), and shifts by `metres` in a random direction. A point that `truth` maps to `about` moves by `metres`.
#[must_use]
pub fn perturb(
    truth: &RigidTransform,
    degrees: f64,
    metres: f64,
    about: &Point3<f64>,
    seed: u64,
) -> RigidTransform {
    let mut random = Random::new(seed, 4);
    let mut direction = || Unit::new_normalize(Vector3::from_fn(|_, _| random.normal()));
    let rotation = Rotation3::from_axis_angle(&direction(), degrees.to_radians());
    let shift = direction().into_inner() * metres;
    let motion = RigidTransform::new(rotation, about.coords - rotation * about.coords + shift);
    motion * *truth
}

impl Poses {
    /// The pair of two scans; the start is wrong by `start` (degrees, metres) about the middle of the source.
    fn into_pair(
        self,
        source: Vec<Point3<f64>>,
        target: Vec<Point3<f64>>,
        overlap: f64,
        start: (f64, f64),
        seed: u64,
    ) -> Result<ScanPair> {
        let (source, target) = (PointCloud::new(source)?, PointCloud::new(target)?);
        let truth = self.target_from_source();
        let sum = source.points().iter().fold(Vector3::zeros(), |sum, point| sum + point.coords);
        let middle = truth.apply(&Point3::from(sum / source.len() as f64));
        let initial = perturb(&truth, start.0, start.1, &middle, seed);
        Ok(ScanPair { source, target, target_from_source: truth, initial, overlap })
    }
}

/// The seed of a part of a pair: the scans of one pair do not share their noise.
fn sub_seed(seed: u64, stream: u64) -> u64 {
    Random::new(seed, stream).bits()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The distances of every `step`-th source point to the nearest target point, ascending.
    fn nearest_distances(pair: &ScanPair, pose: &RigidTransform, step: usize) -> Vec<f64> {
        let nearest = |point: &Point3<f64>| {
            let moved = pose.apply(point);
            let squared = pair.target.points().iter().map(|other| (other - moved).norm_squared());
            squared.fold(f64::INFINITY, f64::min).sqrt()
        };
        let mut distances: Vec<f64> =
            pair.source.points().iter().step_by(step).map(nearest).collect();
        distances.sort_by(f64::total_cmp);
        distances
    }

    /// The share of ascending distances below `limit`.
    fn share_within(distances: &[f64], limit: f64) -> f64 {
        distances.partition_point(|&distance| distance < limit) as f64 / distances.len() as f64
    }

    /// The scans fall onto each other where they overlap, and only under the true pose.
    fn assert_consistent(pair: &ScanPair, noise: f64) {
        let step = pair.source.len() / 300;
        let apart = nearest_distances(pair, &pair.target_from_source, step);
        let median_of_overlap = apart[(apart.len() as f64 * pair.overlap / 2.0) as usize];
        assert!(median_of_overlap < noise, "{median_of_overlap}");
        let start = nearest_distances(pair, &pair.initial, step);
        assert!(share_within(&apart, noise) > 1.5 * share_within(&start, noise));
    }

    #[test]
    fn two_scans_of_a_room_meet_under_the_true_pose() {
        for seed in 0..2 {
            let pair = demo_pair(seed).unwrap();
            assert_consistent(&pair, 0.012);
            // By the points instead of by the sensors: those without a partner within 5 cm do not overlap.
            let apart = nearest_distances(&pair, &pair.target_from_source, 500);
            let by_points = share_within(&apart, 0.05);
            assert!((by_points - pair.overlap).abs() < 0.08, "{by_points} {}", pair.overlap);
        }
    }

    #[test]
    fn two_scans_of_a_street_or_an_object_meet_under_the_true_pose() {
        assert_consistent(&street_pair(1).unwrap(), 0.15);
        assert_consistent(&object_pair(1).unwrap(), 0.003);
    }

    #[test]
    fn an_overlap_out_of_reach_is_refused() {
        let message = room_pair(0, 2.0..=3.0).unwrap_err().to_string();
        assert!(message.contains("overlap by 2 to 3"), "{message}");
    }

    #[test]
    fn a_perturbed_pose_is_wrong_by_what_was_asked() {
        let truth = RigidTransform::new(
            Rotation3::new(Vector3::new(0.3, -1.0, 2.0)),
            Vector3::new(4.0, 5.0, -6.0),
        );
        let point = Point3::new(1.0, -2.0, 3.0);
        let about = truth.apply(&point);
        let wrong = perturb(&truth, 7.0, 0.4, &about, 11);
        assert!((wrong.error_to(&truth).rotation_degrees - 7.0).abs() < 1e-9);
        assert!(((wrong.apply(&point) - about).norm() - 0.4).abs() < 1e-9);
        assert_ne!(wrong, perturb(&truth, 7.0, 0.4, &about, 12));
    }

    #[test]
    fn the_start_of_the_demo_is_12_degrees_and_a_quarter_metre_off() {
        let pair = demo_pair(3).unwrap();
        let error = pair.initial.error_to(&pair.target_from_source);
        assert!((error.rotation_degrees - 12.0).abs() < 1e-9);
        let sum = pair.source.points().iter().map(|point| point.coords).sum::<Vector3<f64>>();
        let middle = Point3::from(sum / pair.source.len() as f64);
        let moved = pair.initial.apply(&middle) - pair.target_from_source.apply(&middle);
        assert!((moved.norm() - 0.25).abs() < 1e-9);
    }

    #[test]
    fn pairs_repeat_for_any_number_of_threads_and_differ_between_seeds() {
        let with_threads = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| [demo_pair(5), street_pair(5), object_pair(5)].map(Result::unwrap))
        };
        let one = with_threads(1);
        assert_eq!(one, with_threads(3));
        assert_ne!(one[0], demo_pair(6).unwrap());
        assert_ne!(one[1], street_pair(6).unwrap());
        assert_ne!(one[2], object_pair(6).unwrap());
    }
}
