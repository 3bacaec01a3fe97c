//! The ICP family on synthetic surfaces: what every method must do, and what it must not be harmed by.

use nalgebra::{Point3, Rotation3, Vector3};
use rare::RigidTransform;
use rare::pose::{
    Icp, IcpMethod, IcpResult, IcpSource, IcpTarget, MultiScaleIcp, RobustKernel, Trim,
};
use rare::random::Random;

const METHODS: [IcpMethod; 5] = [
    IcpMethod::PointToPoint,
    IcpMethod::PointToPlane,
    IcpMethod::Symmetric,
    IcpMethod::Generalised,
    IcpMethod::VoxelisedGeneralised,
];

/// Makes the surface point at two parameters between 0 and 1.
type Surface = fn(f64, f64) -> Point3<f64>;

/// A floor, two walls and half a ball: every motion is determined.
fn room(a: f64, b: f64) -> Point3<f64> {
    let part = (a * 4.0).floor();
    let a = a * 4.0 - part;
    match part as usize {
        0 => Point3::new(4.0 * a, 3.0 * b, 0.0),
        1 => Point3::new(4.0 * a, 0.0, 3.0 * b),
        2 => Point3::new(0.0, 3.0 * a, 3.0 * b),
        _ => Point3::new(2.0, 1.5, 0.0) + (ball(a, 0.5 * b) - Point3::origin()) * 0.7,
    }
}

fn plane(a: f64, b: f64) -> Point3<f64> {
    Point3::new(4.0 * a, 4.0 * b, 0.0)
}

/// Floor, ceiling and two walls along x.
fn corridor(a: f64, b: f64) -> Point3<f64> {
    let part = (b * 4.0).floor();
    let b = (b * 4.0 - part) * 2.0;
    let x = 10.0 * a;
    match part as usize {
        0 => Point3::new(x, b, 0.0),
        1 => Point3::new(x, b, 2.0),
        2 => Point3::new(x, 0.0, b),
        _ => Point3::new(x, 2.0, b),
    }
}

/// A unit ball: equal areas of the parameters are equal areas of the surface.
fn ball(a: f64, b: f64) -> Point3<f64> {
    let (turn, z) = (std::f64::consts::TAU * a, 1.0 - 2.0 * b);
    let radius = (1.0 - z * z).max(0.0).sqrt();
    Point3::new(radius * turn.cos(), radius * turn.sin(), z)
}

/// A pipe of radius 1 along z.
fn pipe(a: f64, b: f64) -> Point3<f64> {
    let turn = std::f64::consts::TAU * a;
    Point3::new(turn.cos(), turn.sin(), 6.0 * b - 3.0)
}

/// `count` random points of a surface, 5 mm off it (one standard deviation).
fn sampled(surface: Surface, count: usize, seed: u64, noise: f64) -> Vec<Point3<f64>> {
    let mut random = Random::new(seed, 0);
    (0..count)
        .map(|_| {
            let point = surface(random.uniform(), random.uniform());
            point + Vector3::from_fn(|_, _| noise * random.normal())
        })
        .collect()
}

fn motion() -> RigidTransform {
    RigidTransform::new(
        Rotation3::new(Vector3::new(0.03, -0.05, 0.04)),
        Vector3::new(0.08, -0.05, 0.06),
    )
}

fn prepared(points: Vec<Point3<f64>>) -> IcpTarget {
    IcpTarget::with_estimated_normals(points, 20).unwrap().with_voxels(0.3).unwrap()
}

fn apart(a: &RigidTransform, b: &RigidTransform) -> (f64, f64) {
    let error = a.error_to(b);
    (error.rotation_degrees, error.translation)
}

#[test]
fn every_method_recovers_a_known_motion() {
    let target = prepared(sampled(room, 12_000, 1, 0.0));
    // The very same points, so that every method has an exact answer but the voxelised one.
    let moved = motion().inverse().apply_all(&target.points()[..4000]);
    for method in METHODS {
        for kernel in [RobustKernel::None, RobustKernel::Tukey, RobustKernel::GemanMcClure] {
            let icp = Icp { kernel, max_iterations: 100, ..Icp::for_method(method, 0.1) };
            let result = icp.align(&moved, &target, &RigidTransform::identity()).unwrap();
            let (degrees, metres) = apart(&result.target_from_source, &motion());
            let (most_degrees, most_metres) = match method {
                IcpMethod::VoxelisedGeneralised => (0.1, 5e-3),
                _ => (1e-3, 1e-4),
            };
            assert!(
                degrees < most_degrees && metres < most_metres,
                "{method:?} {kernel:?}: {degrees} deg, {metres} m"
            );
            let all_matched = method == IcpMethod::VoxelisedGeneralised || result.fitness > 0.99;
            assert!(result.open_directions.is_empty() && all_matched, "{method:?}");
        }
    }
}

#[test]
fn a_motion_of_both_clouds_moves_the_result_along() {
    let (source, points) = (sampled(room, 2000, 2, 0.003), sampled(room, 6000, 3, 0.003));
    // Georeferenced coordinates are of this size.
    let common = RigidTransform::new(
        Rotation3::new(Vector3::new(0.9, -0.4, 2.0)),
        Vector3::new(3000.0, -4000.0, 500.0),
    );
    let start = motion();
    // Voxels are anchored to the axes: the voxelised method is not equivariant.
    for method in &METHODS[..4] {
        let icp = Icp::for_method(*method, 0.1);
        let here = icp.align(&source, &prepared(points.clone()), &start).unwrap();
        let there = prepared(common.apply_all(&points));
        let there = icp
            .align(&common.apply_all(&source), &there, &(common * start * common.inverse()))
            .unwrap();
        let back = common.inverse() * there.target_from_source * common;
        let (degrees, metres) = apart(&back, &here.target_from_source);
        assert!(degrees < 1e-5 && metres < 1e-6, "{method:?}: {degrees} deg, {metres} m");
        assert_eq!(there.iterations, here.iterations, "{method:?}");
    }
}

#[test]
fn swapping_the_clouds_inverts_the_result() {
    let first = sampled(room, 6000, 4, 0.003);
    let second = motion().apply_all(&sampled(room, 6000, 5, 0.003));
    for method in METHODS {
        let icp = Icp::for_method(method, 0.1);
        let identity = RigidTransform::identity();
        let there = icp.align(&first, &prepared(second.clone()), &identity).unwrap();
        let back = icp.align(&second, &prepared(first.clone()), &identity).unwrap();
        let around = back.target_from_source * there.target_from_source;
        let (degrees, metres) = apart(&around, &identity);
        let most = if method == IcpMethod::PointToPoint { 3.0 } else { 1.0 };
        assert!(degrees < 0.1 * most && metres < 3e-3 * most, "{method:?}: {degrees} {metres}");
    }
}

#[test]
fn the_number_of_threads_does_not_show() {
    let (source, points) = (sampled(room, 5000, 6, 0.003), sampled(room, 9000, 7, 0.003));
    for method in METHODS {
        for trim in [Trim::Off, Trim::Automatic, Trim::Overlap(0.7)] {
            let align = |threads| {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
                let icp = Icp { trim, ..Icp::for_method(method, 0.1) };
                pool.install(|| icp.align(&source, &prepared(points.clone()), &motion()).unwrap())
            };
            assert_eq!(align(1), align(3), "{method:?} {trim:?}");
        }
    }
}

/// Aligns a surface that leaves motions open from a start 3 cm and half a degree off.
fn aligned(surface: Surface, method: IcpMethod, noise: f64) -> IcpResult {
    let target = prepared(sampled(surface, 8000, 8, noise));
    let source = sampled(surface, 3000, 9, noise);
    let start =
        RigidTransform::new(Rotation3::new(Vector3::new(5e-3, -5e-3, 5e-3)), Vector3::repeat(0.02));
    Icp::for_method(method, 0.1).align(&source, &target, &start).unwrap()
}

#[test]
fn open_directions_are_named() {
    for method in METHODS {
        let found = aligned(plane, method, 0.002).open_directions;
        assert_eq!(found.len(), 3, "{method:?} {found:?}");
        for shift in &found[..2] {
            assert!(
                shift.translation.norm() > 0.99 && shift.translation.z.abs() < 0.02,
                "{shift:?}"
            );
            assert_eq!(shift.point_on_axis(), None);
        }
        let axis = found[2].rotation.normalize();
        assert!(axis.z > 0.999 && found[2].point_on_axis().is_some(), "{found:?}");

        let found = aligned(corridor, method, 0.002).open_directions;
        assert_eq!(found.len(), 1, "{method:?} {found:?}");
        assert!(found[0].translation.x > 0.999 && found[0].rotation.norm() < 0.02, "{found:?}");

        let found = aligned(ball, method, 0.002).open_directions;
        assert_eq!(found.len(), 3, "{method:?} {found:?}");
        for turn in &found {
            let centre = turn.point_on_axis().unwrap();
            assert!(centre.coords.norm() < 0.05 && turn.visibility < 1e-2, "{turn:?}");
        }

        let found = aligned(pipe, method, 0.002).open_directions;
        assert_eq!(found.len(), 2, "{method:?} {found:?}");
        assert!(found[0].translation.z > 0.99, "{found:?}");
        let axis = found[1].rotation.normalize();
        let on_axis = found[1].point_on_axis().unwrap();
        assert!(axis.z > 0.999 && on_axis.x.hypot(on_axis.y) < 0.05, "{found:?}");

        assert!(aligned(room, method, 0.002).open_directions.is_empty(), "{method:?}");
    }
}

#[test]
fn nothing_runs_away_along_open_directions() {
    for (surface, name) in
        [(plane as Surface, "plane"), (corridor, "corridor"), (ball, "ball"), (pipe, "pipe")]
    {
        for method in METHODS {
            // So much noise that it would drive a plane along itself, round after round.
            let result = aligned(surface, method, 0.005);
            let (degrees, metres) = apart(&result.target_from_source, &RigidTransform::identity());
            assert!(degrees < 1.5 && metres < 0.06, "{name} {method:?}: {degrees} deg, {metres} m");
        }
    }
}

#[test]
fn a_trimmed_overlap_survives_what_has_no_counterpart() {
    let target = prepared(sampled(room, 12_000, 10, 0.0));
    let mut source = motion().inverse().apply_all(&sampled(room, 3000, 11, 0.0));
    // 17 % of the source: a cabinet that the target never saw, 25 cm in front of a wall.
    let cabinet: Vec<_> = sampled(plane, 600, 12, 0.0)
        .iter()
        .map(|p| Point3::new(0.25, 0.5 + 0.5 * p.x, 0.5 + 0.5 * p.y))
        .collect();
    source.extend(motion().inverse().apply_all(&cabinet));
    for method in METHODS {
        let align = |trim| {
            let icp = Icp { trim, ..Icp::plain(method, 0.5) };
            let result = icp.align(&source, &target, &RigidTransform::identity()).unwrap();
            (apart(&result.target_from_source, &motion()).1, result.overlap)
        };
        let (untrimmed, _) = align(Trim::Off);
        // It never pairs the cabinet with the wall.
        let in_own_voxel = method == IcpMethod::VoxelisedGeneralised;
        for trim in [Trim::Overlap(0.8), Trim::Automatic] {
            let (trimmed, overlap) = align(trim);
            assert!(
                trimmed < 0.012 && (untrimmed > 2.0 * trimmed || in_own_voxel),
                "{method:?} {trim:?}: {trimmed} {untrimmed}"
            );
            assert!((0.7..0.87).contains(&overlap), "{method:?} {trim:?}: {overlap}");
        }
    }
}

#[test]
fn points_that_are_not_finite_take_no_part() {
    let (source, points) = (sampled(room, 2000, 13, 0.0), sampled(room, 6000, 14, 0.0));
    let broken = |points: &[Point3<f64>]| -> Vec<Point3<f64>> {
        let odd = [f64::NAN, f64::INFINITY, f64::NEG_INFINITY].map(|x| Point3::new(x, 1.0, x));
        odd.iter().chain(points).chain(&odd).copied().collect()
    };
    for method in METHODS {
        let icp = Icp::for_method(method, 0.1);
        let whole = icp.align(&source, &prepared(points.clone()), &motion()).unwrap();
        let result = icp.align(&broken(&source), &prepared(broken(&points)), &motion()).unwrap();
        let (degrees, metres) = apart(&result.target_from_source, &whole.target_from_source);
        assert!(degrees < 1e-9 && metres < 1e-9, "{method:?}: {degrees} {metres}");
        assert_eq!(result.fitness, whole.fitness);
        let multi = MultiScaleIcp::for_voxel(method, 0.1);
        multi.align(&broken(&source), &broken(&points), &motion()).unwrap();
    }
}

#[test]
fn odd_clouds_give_a_pose_that_is_finite_or_an_error() {
    let same = vec![Point3::new(1.0, 2.0, 3.0); 30];
    let line: Vec<_> = (0..50).map(|i| Point3::new(0.1 * f64::from(i), 0.0, 0.0)).collect();
    let huge: Vec<_> = (0..50).map(|i| Point3::new(1e200 * f64::from(i), 1e200, -1e200)).collect();
    let nan = vec![Point3::new(f64::NAN, 0.0, 0.0); 10];
    let clouds = [same[..1].to_vec(), same, line, huge, nan, sampled(room, 300, 15, 0.0)];
    for (method, (source, points)) in METHODS.into_iter().flat_map(|method| {
        clouds
            .iter()
            .flat_map(|a| clouds.iter().map(move |b| (a, b)))
            .map(move |pair| (method, pair))
    }) {
        let mut target = IcpTarget::with_estimated_normals(points.clone(), 20).unwrap();
        if let Ok(with_voxels) = target.clone().with_voxels(0.5) {
            target = with_voxels;
        }
        for reach in [0.1, f64::INFINITY] {
            for trim in [Trim::Off, Trim::Automatic] {
                let icp = Icp { trim, ..Icp::plain(method, reach) };
                let start = RigidTransform::from_translation(Vector3::new(0.01, 0.02, 0.03));
                if let Ok(result) = icp.align(source, &target, &start) {
                    assert!(result.target_from_source.to_matrix().iter().all(|x| x.is_finite()));
                    assert!(result.inlier_rmse.is_finite() && result.residual_rmse.is_finite());
                }
            }
        }
        let _ = MultiScaleIcp::for_voxel(method, 0.1).align(source, points, &motion());
    }
}

#[test]
fn collinear_points_leave_the_turn_about_their_line_open() {
    let line: Vec<_> = (0..50).map(|i| Point3::new(0.1 * f64::from(i), 2.0, 0.0)).collect();
    let target = IcpTarget::new(line.clone(), vec![Vector3::zeros(); 50]).unwrap();
    let start = RigidTransform::from_translation(Vector3::new(0.0, 0.02, 0.03));
    let result =
        Icp::for_method(IcpMethod::PointToPoint, 0.1).align(&line, &target, &start).unwrap();
    let (degrees, metres) = apart(&result.target_from_source, &RigidTransform::identity());
    assert!(degrees < 1e-6 && metres < 1e-6, "{degrees} {metres}");
    assert_eq!(result.open_directions.len(), 1);
    let open = result.open_directions[0];
    assert!(open.rotation.normalize().x > 0.999_999, "{open:?}");
    assert!((open.point_on_axis().unwrap().y - 2.0).abs() < 1e-9);
}

#[test]
fn what_makes_no_sense_is_an_error() {
    let points = sampled(room, 500, 16, 0.0);
    let bare = IcpTarget::with_estimated_normals(points.clone(), 20).unwrap();
    let flat = IcpTarget::new(points.clone(), vec![Vector3::repeat(f64::NAN); 500]).unwrap();
    let voxelised = Icp::for_method(IcpMethod::VoxelisedGeneralised, 0.1);
    let trimmed = |share| Icp { trim: Trim::Overlap(share), ..Icp::for_voxel(0.1) };
    let nan = [Point3::new(f64::NAN, 0.0, 0.0)];
    for (icp, source, target, word) in [
        (&voxelised, &points[..], &bare, "without voxels"),
        (&trimmed(0.0), &points, &bare, "is 0,"),
        (&trimmed(f64::NAN), &points, &bare, "is NaN"),
        (&Icp::for_voxel(0.1), &points, &flat, "one with a normal"),
        (&Icp::for_voxel(0.1), &nan, &bare, "no source points"),
        (&Icp::for_method(IcpMethod::Symmetric, 0.1), &[], &bare, "no source points"),
    ] {
        let message = icp.align(source, target, &motion()).unwrap_err().to_string();
        assert!(message.contains(word), "{message}");
    }
    assert!(IcpSource::new(points.clone(), Vec::new()).is_err());
    assert!(bare.with_voxels(0.0).is_err());
    let scales =
        MultiScaleIcp { voxels: Vec::new(), ..MultiScaleIcp::for_voxel(IcpMethod::Symmetric, 0.1) };
    assert!(scales.align(&points, &points, &motion()).is_err());
}

#[test]
fn two_scales_recover_a_larger_motion() {
    let target = sampled(room, 30_000, 17, 0.002);
    let far = RigidTransform::new(
        Rotation3::new(Vector3::new(0.1, 0.0, 0.1)),
        Vector3::new(0.15, 0.1, -0.1),
    );
    let source = far.inverse().apply_all(&sampled(room, 30_000, 18, 0.002));
    let identity = RigidTransform::identity();
    for method in METHODS {
        let icp = MultiScaleIcp::for_voxel(method, 0.05);
        let result = icp.align(&source, &target, &identity).unwrap();
        let (degrees, metres) = apart(&result.target_from_source, &far);
        assert!(degrees < 0.2 && metres < 5e-3, "{method:?}: {degrees} {metres}");
        assert_eq!(result.iterations.len(), 6);
        // Means of voxels lie farther away than points.
        assert!(result.fitness > 0.99 || method == IcpMethod::VoxelisedGeneralised);
    }
}
