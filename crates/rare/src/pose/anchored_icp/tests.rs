//! Tests of anchored ICP on planes whose normals are known, so that what moves is the method's doing.

mod refusals;

use nalgebra::{Point3, Rotation3, Vector3};

use super::*;
use crate::random::Random;

const VOXEL: f64 = 0.05;

/// Points and the normals of what they lie on.
type Surface = Vec<(Point3<f64>, Vector3<f64>)>;

/// Points `count` on the rectangle from `corner` along `a` and `b`, with the rectangle's normal.
fn wall(seed: u64, count: usize, corner: [f64; 3], a: [f64; 3], b: [f64; 3]) -> Surface {
    let (corner, a, b) = (Point3::from(corner), Vector3::from(a), Vector3::from(b));
    let mut random = Random::new(seed, 0);
    let normal = a.cross(&b).normalize();
    (0..count).map(|_| (corner + a * random.uniform() + b * random.uniform(), normal)).collect()
}

/// A floor and two walls of 2 m: every motion is determined.
fn corner(seed: u64) -> Surface {
    let (o, x, y, z) = ([0.0; 3], [2.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 2.0]);
    [(x, y), (y, z), (z, x)]
        .iter()
        .enumerate()
        .flat_map(|(i, &(a, b))| wall(10 * seed + i as u64, 2000, o, a, b))
        .collect()
}

fn floor(seed: u64) -> Surface {
    wall(seed, 4000, [0.0; 3], [2.0, 0.0, 0.0], [0.0, 2.0, 0.0])
}

fn cloud(points: &[(Point3<f64>, Vector3<f64>)], pose: &RigidTransform) -> IcpTarget {
    let (points, normals) = points.iter().map(|(p, n)| (pose.apply(p), pose.rotate(n))).unzip();
    IcpTarget::new(points, normals).unwrap()
}

fn every(step: usize, cloud: &IcpTarget) -> Vec<usize> {
    (0..cloud.points().len()).step_by(step).collect()
}

fn pose(turn: [f64; 3], shift: [f64; 3]) -> RigidTransform {
    RigidTransform::new(Rotation3::new(Vector3::from(turn)), Vector3::from(shift))
}

/// The truth of most tests, far from the origin's neighbourhood and from the identity.
fn truth() -> RigidTransform {
    pose([0.4, -0.8, 0.3], [1.5, -2.0, 0.7])
}

/// Anchors at random points of the floor, the target's truly `pose` of the source's plus `offset(i)`.
fn anchors(
    count: usize,
    target_from_source: &RigidTransform,
    mut offset: impl FnMut(usize) -> Vector3<f64>,
) -> Vec<Correspondence> {
    let back = target_from_source.inverse();
    let pair = |(i, (target, _)): (usize, &(Point3<f64>, Vector3<f64>))| Correspondence {
        source: back.apply(target),
        target: target + offset(i),
        score: 1.0,
    };
    floor(99)[..count].iter().enumerate().map(pair).collect()
}

fn spread_out(random: &mut Random, length: f64) -> Vector3<f64> {
    Vector3::from([0; 3].map(|_| random.normal())).normalize() * length
}

/// A source and a target with samples of every other point.
struct Scene {
    source: IcpTarget,
    target: IcpTarget,
    truth: RigidTransform,
}

impl Scene {
    /// Two samplings of one surface.
    fn new(surface: fn(u64) -> Surface) -> Scene {
        let target = cloud(&surface(1), &RigidTransform::identity());
        Scene { source: cloud(&surface(2), &truth().inverse()), target, truth: truth() }
    }

    fn align(
        &self,
        icp: &AnchoredIcp,
        anchors: &[Correspondence],
        start: &RigidTransform,
    ) -> Result<AnchoredIcpResult> {
        let (source, target) = (every(2, &self.source), every(2, &self.target));
        icp.align(&self.source, &self.target, &source, &target, anchors, start)
    }

    fn error(&self, result: &AnchoredIcpResult) -> (f64, f64) {
        // At a point that both clouds share.
        let shared = Point3::new(0.5, 0.5, 0.0);
        let moved = result.target_from_source.apply(&self.truth.inverse().apply(&shared));
        let error = result.target_from_source.error_to(&self.truth);
        (error.rotation_degrees, (moved - shared).norm())
    }
}

/// Turned by 1.5 degrees and two voxels off.
fn off(truth: &RigidTransform) -> RigidTransform {
    pose([0.01, -0.02, 0.015], [1.2 * VOXEL, -VOXEL, 1.2 * VOXEL]) * *truth
}

#[test]
fn a_known_pose_is_recovered_from_either_cloud_alone_or_both() {
    let scene = Scene::new(corner);
    let icp = AnchoredIcp::for_voxel(VOXEL);
    let (source, target) = (every(2, &scene.source), every(2, &scene.target));
    for (source, target) in [(&source[..], &target[..]), (&source, &[]), (&[], &target)] {
        let start = off(&scene.truth);
        let result = icp.align(&scene.source, &scene.target, source, target, &[], &start).unwrap();
        let (turn, shift) = scene.error(&result);
        assert!(turn < 1e-3 && shift < 1e-3 * VOXEL, "{turn} {shift}");
        assert!(result.converged && result.iterations.len() == 3 && result.anchors == 0);
        let sampled = source.len() + target.len();
        assert!(2 * result.pairs > sampled && result.pairs <= sampled, "{result:?}");
    }
}

/// A road in rings five voxels apart; those of different seeds lie between one another.
fn rings(seed: u64) -> Surface {
    let ring = |number: u32| {
        let x = (f64::from(number) + 0.5 * seed as f64) * 5.0 * VOXEL;
        (0..200).map(move |i| (Point3::new(x, f64::from(i) * 0.2 * VOXEL, 0.0), Vector3::z()))
    };
    (0..8).flat_map(ring).collect()
}

#[test]
fn rings_that_never_meet_lie_on_one_road() {
    let scene = Scene::new(rings);
    let tilted = scene.truth * pose([0.0, 0.01, 0.0], [0.0, 0.0, 0.3 * VOXEL]);
    let result = scene.align(&AnchoredIcp::for_rotating_scanner(VOXEL), &[], &tilted).unwrap();
    // The road determines its normal and its height, no more.
    let moved = result.target_from_source * scene.truth.inverse();
    let (tilt, height) =
        (moved.rotate(&Vector3::z()).xy().norm(), moved.apply(&Point3::origin()).z);
    assert!(tilt < 1e-5 && height.abs() < 1e-3 * VOXEL && result.converged, "{tilt} {height}");
    // Nothing is near enough where scans are dense.
    assert!(scene.align(&AnchoredIcp::for_voxel(VOXEL), &[], &tilted).is_err());
}

#[test]
fn where_the_clouds_lie_does_not_matter() {
    let place = RigidTransform::from_translation(Vector3::new(900.0, -700.0, 100.0));
    let near = Scene::new(corner);
    let target = cloud(&corner(1), &place);
    let far = Scene { target, truth: place * near.truth, ..Scene::new(corner) };
    let icp = AnchoredIcp::for_voxel(VOXEL);
    let start = off(&near.truth);
    let expected = near.align(&icp, &[], &start).unwrap();
    let result = far.align(&icp, &[], &(place * start)).unwrap();
    let error = result.target_from_source.error_to(&(place * expected.target_from_source));
    assert!(error.rotation_degrees < 1e-6 && error.translation < 1e-6 * VOXEL, "{error:?}");
    assert_eq!(result.iterations, expected.iterations);
}

#[test]
fn pairs_end_at_the_largest_distance_and_fade_before() {
    let scene = Scene::new(floor);
    let lifted = pose([0.0; 3], [0.0, 0.0, 1.5 * VOXEL]) * scene.truth;
    for (voxels, found) in [(1.0, false), (2.0, true)] {
        let stage = IcpStage { max_distance: voxels * VOXEL, kernel_width: 1.0 };
        let icp = AnchoredIcp { stages: vec![stage], ..AnchoredIcp::for_voxel(VOXEL) };
        assert_eq!(scene.align(&icp, &[], &lifted).is_ok(), found);
    }
    // A rug of 0.6 m2 that the target never saw, 0.8 voxels above 4 m2: it would lift the floor by 0.1 voxels.
    let rug = [0.5, 0.5, 0.8 * VOXEL];
    let mut points = floor(2);
    points.extend(wall(3, 600, rug, [1.0, 0.0, 0.0], [0.0, 0.6, 0.0]));
    let scene = Scene { source: cloud(&points, &scene.truth.inverse()), ..scene };
    let result = scene.align(&AnchoredIcp::for_voxel(VOXEL), &[], &scene.truth).unwrap();
    let (turn, shift) = scene.error(&result);
    assert!(shift < 0.03 * VOXEL && turn < 0.1, "{turn} {shift}");
}

#[test]
fn the_sign_of_a_normal_does_not_matter() {
    let scene = Scene::new(corner);
    let normals = scene.source.normals().iter().enumerate();
    let signs = normals.map(|(i, normal)| if i % 3 == 0 { -normal } else { *normal }).collect();
    let flipped = IcpTarget::new(scene.source.points().to_vec(), signs).unwrap();
    let flipped = Scene { source: flipped, ..Scene::new(corner) };
    let icp = AnchoredIcp::for_voxel(VOXEL);
    let align = |scene: &Scene| scene.align(&icp, &[], &off(&scene.truth)).unwrap();
    assert_eq!(align(&scene), align(&flipped));
}

#[test]
fn anchors_hold_what_a_floor_leaves_open() {
    let scene = Scene::new(floor);
    let slide = pose([0.0, 0.0, 0.02], [2.0 * VOXEL, -VOXEL, 0.3 * VOXEL]) * scene.truth;
    // A fifth of them 1 m off.
    let mut random = Random::new(7, 0);
    let anchors = anchors(60, &scene.truth, |i| {
        if i % 5 == 0 { spread_out(&mut random, 1.0) } else { Vector3::zeros() }
    });
    let icp = AnchoredIcp::for_voxel(VOXEL);
    let plain = AnchoredIcp { anchor_weight: 0.0, ..icp.clone() };
    let plain = scene.align(&plain, &anchors, &slide).unwrap();
    let moved = plain.target_from_source.error_to(&scene.truth);
    assert!(scene.error(&plain).1 > 1.5 * VOXEL && moved.rotation_degrees > 1.0, "{moved:?}");
    assert_eq!(plain.anchors, 0);
    let held = scene.align(&icp, &anchors, &slide).unwrap();
    let (turn, shift) = scene.error(&held);
    assert!(turn < 1e-2 && shift < 1e-3 * VOXEL, "{turn} {shift}");
    assert!(held.anchors == 48 && held.converged);
}

#[test]
fn noise_slides_nothing_along_what_is_left_open() {
    let rough = |seed: u64| {
        let mut random = Random::new(seed, 1);
        let mut points = floor(seed);
        for (_, normal) in &mut points {
            *normal = (*normal + spread_out(&mut random, 0.05)).normalize();
        }
        points
    };
    let target = cloud(&rough(1), &RigidTransform::identity());
    let scene = Scene { source: cloud(&rough(2), &truth().inverse()), target, truth: truth() };
    let start = pose([0.0; 3], [VOXEL, VOXEL, 0.5 * VOXEL]) * scene.truth;
    let result = scene.align(&AnchoredIcp::for_voxel(VOXEL), &[], &start).unwrap();
    let moved = result.target_from_source * start.inverse();
    let centre = Point3::new(1.0, 1.0, 0.0);
    let shift = moved.apply(&centre) - centre;
    assert!(shift.xy().norm() < 0.05 * VOXEL, "{shift}");
    assert!((shift.z + 0.5 * VOXEL).abs() < 0.05 * VOXEL, "{shift}");
}

#[test]
fn wrong_anchors_hardly_move_what_the_surfaces_determine() {
    let scene = Scene::new(corner);
    let icp = AnchoredIcp::for_voxel(VOXEL);
    let mut random = Random::new(8, 0);
    let far = anchors(200, &scene.truth, |_| spread_out(&mut random, 1.0));
    let alone = scene.align(&icp, &[], &off(&scene.truth)).unwrap();
    assert_eq!(scene.align(&icp, &far, &off(&scene.truth)).unwrap(), alone);
    // Within the kernel they do pull, but in all directions, and weigh a tenth.
    let mut random = Random::new(9, 0);
    let near = anchors(200, &scene.truth, |i| spread_out(&mut random, 0.03 * VOXEL * i as f64));
    let pulled = scene.align(&icp, &near, &off(&scene.truth)).unwrap();
    let (turn, shift) = scene.error(&pulled);
    assert!(pulled.anchors > 100 && shift > 0.0);
    assert!(turn < 0.15 && shift < 0.1 * VOXEL, "{turn} {shift}");
}

#[test]
fn all_anchors_together_weigh_what_was_asked_however_many_they_are() {
    // Along the floor's normal surfaces weigh 1 and anchors a quarter: the rest is a fifth of what anchors claim.
    let scene = Scene::new(floor);
    let wide = IcpStage { max_distance: 0.5, kernel_width: 1e4 };
    let icp = AnchoredIcp {
        stages: vec![wide],
        anchor_weight: 0.25,
        anchor_width: 1e4,
        ..AnchoredIcp::for_voxel(VOXEL)
    };
    for side in [7, 21] {
        let along = |i: usize| (i as f64 + 0.5) * 2.0 / side as f64;
        let grid = (0..side * side).map(|i| Point3::new(along(i % side), along(i / side), 0.0));
        let anchor = |target: Point3<f64>| Correspondence {
            source: scene.truth.inverse().apply(&target),
            target: target + Vector3::new(0.0, 0.0, 0.5 * VOXEL),
            score: 1.0,
        };
        let anchors: Vec<Correspondence> = grid.map(anchor).collect();
        let result = scene.align(&icp, &anchors, &scene.truth).unwrap();
        let centre = Point3::new(1.0, 1.0, 0.0);
        let moved = result.target_from_source.apply(&scene.truth.inverse().apply(&centre));
        let shift = moved - centre;
        assert!((shift.z - 0.1 * VOXEL).abs() < 2e-3 * VOXEL, "{shift}");
    }
}

#[test]
fn a_sixth_of_overlap_suffices() {
    // Two floors of 3 m with a wall along x that share half a metre; their other ends hold clutter of their own.
    let strip = |seed: u64, from: f64| {
        let mut points = wall(seed, 4000, [from, 0.0, 0.0], [3.0, 0.0, 0.0], [0.0, 2.0, 0.0]);
        points.extend(wall(seed + 1, 4000, [from, 0.0, 0.0], [0.0, 0.0, 2.0], [3.0, 0.0, 0.0]));
        points.extend(wall(seed + 2, 500, [from, 0.3, 0.1], [0.0, 0.5, 0.1], [0.2, 0.0, 0.4]));
        points
    };
    let target = cloud(&strip(1, 0.0), &RigidTransform::identity());
    let scene =
        Scene { source: cloud(&strip(5, -2.5), &truth().inverse()), target, truth: truth() };
    let anchors: Vec<Correspondence> = anchors(4000, &scene.truth, |_| Vector3::zeros())
        .into_iter()
        .filter(|anchor| anchor.target.x < 0.5 && anchor.target.y > 0.9)
        .take(40)
        .collect();
    let start = pose([0.005, -0.01, 0.005], [2.0 * VOXEL, -0.5 * VOXEL, 0.5 * VOXEL]) * scene.truth;
    let result = scene.align(&AnchoredIcp::for_voxel(VOXEL), &anchors, &start).unwrap();
    let (turn, shift) = scene.error(&result);
    assert!(turn < 0.05 && shift < 0.02 * VOXEL, "{turn} {shift}");
    let sampled = (scene.source.points().len() + scene.target.points().len()) / 2;
    assert!(4 * result.pairs < sampled, "{} {sampled}", result.pairs);
}

#[test]
fn the_number_of_threads_does_not_show() {
    let scene = Scene::new(corner);
    let mut random = Random::new(3, 0);
    let anchors = anchors(60, &scene.truth, |_| spread_out(&mut random, VOXEL));
    let align = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let icp = AnchoredIcp::for_voxel(VOXEL);
        pool.install(|| scene.align(&icp, &anchors, &off(&scene.truth)).unwrap())
    };
    assert_eq!(align(1), align(3));
}

#[test]
fn anchors_that_weigh_less_than_five_are_ignored() {
    let scene = Scene::new(floor);
    let slide = pose([0.0; 3], [VOXEL, 0.0, 0.0]) * scene.truth;
    let icp = AnchoredIcp::for_voxel(VOXEL);
    let alone = scene.align(&icp, &[], &slide).unwrap();
    // One voxel off, an anchor weighs (1 - 1/16)^2 = 0.88: five weigh 4.4, six 5.3.
    let anchors = anchors(6, &scene.truth, |_| Vector3::zeros());
    assert_eq!(scene.align(&icp, &anchors[..5], &slide).unwrap(), alone);
    let held = scene.align(&icp, &anchors, &slide).unwrap();
    assert!(held.anchors == 6 && scene.error(&held).1 < 1e-3 * VOXEL);
}
