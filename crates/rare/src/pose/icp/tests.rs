//! Tests of ICP on synthetic surfaces.

use nalgebra::Rotation3;

use super::*;
use crate::data::KdTree;
use crate::features::estimate_normals;
use crate::random::Random;

/// A floor, two walls and a ball: every motion is determined.
fn room(seed: u64, count: usize) -> Vec<Point3<f64>> {
    let mut random = Random::new(seed, 0);
    let mut point = |kind: usize| {
        let (a, b) = (4.0 * random.uniform(), 3.0 * random.uniform());
        match kind % 4 {
            0 => Point3::new(a, b, 0.0),
            1 => Point3::new(a, 0.0, b),
            2 => Point3::new(0.0, b, a * 0.7),
            _ => {
                let direction = Vector3::from([0; 3].map(|_| random.normal())).normalize();
                Point3::new(2.0, 1.5, 1.0) + direction * 0.5
            }
        }
    };
    (0..count).map(&mut point).collect()
}

fn target(points: Vec<Point3<f64>>) -> IcpTarget {
    let normals = estimate_normals(&points, &KdTree::new(&points), 0.2, 30);
    IcpTarget::new(points, normals).unwrap()
}

fn motion() -> RigidTransform {
    RigidTransform::new(
        Rotation3::new(Vector3::new(0.03, -0.05, 0.04)),
        Vector3::new(0.08, -0.05, 0.06),
    )
}

#[test]
fn a_known_motion_is_recovered_and_the_claims_hold() {
    let truth = motion();
    let back = truth.inverse();
    let source: Vec<_> = room(1, 4000).iter().map(|point| back.apply(point)).collect();
    let target = target(room(2, 20_000));
    for kernel in
        [RobustKernel::Tukey, RobustKernel::Huber, RobustKernel::Cauchy, RobustKernel::GemanMcClure]
    {
        let icp = Icp { kernel, ..Icp::for_voxel(0.1) };
        let result = icp.align(&source, &target, &RigidTransform::identity()).unwrap();
        let error = result.target_from_source.error_to(&truth);
        assert!(error.rotation_degrees < 0.02 && error.translation < 5e-4, "{kernel:?} {error:?}");
        assert!(result.converged && result.open_directions.is_empty() && result.fitness > 0.99);

        let squares: Vec<f64> = source
            .iter()
            .map(|point| result.target_from_source.apply(point))
            .filter_map(|moved| target.tree().nearest_within(&moved, 0.15))
            .map(|found| found.squared_distance)
            .collect();
        assert_eq!(result.fitness, squares.len() as f64 / 4000.0);
        let rmse = (squares.iter().sum::<f64>() / squares.len() as f64).sqrt();
        assert!((rmse - result.inlier_rmse).abs() < 1e-12);
    }
}

#[test]
fn wrong_points_do_not_pull_a_tukey_kernel() {
    let truth = motion();
    let mut source: Vec<_> = room(1, 3000).iter().map(|p| truth.inverse().apply(p)).collect();
    // A cabinet that the target never saw, 20 cm in front of a wall.
    source.extend((0..400).map(|i| {
        let (y, z) = (f64::from(i % 20) * 0.06, f64::from(i / 20) * 0.06);
        truth.inverse().apply(&Point3::new(0.2, y, z))
    }));
    let target = target(room(2, 20_000));
    let result = Icp::for_voxel(0.1).align(&source, &target, &RigidTransform::identity());
    let error = result.unwrap().target_from_source.error_to(&truth);
    assert!(error.rotation_degrees < 0.2 && error.translation < 0.01, "{error:?}");
}

#[test]
fn the_information_is_the_curvature_of_the_plane_error() {
    let target = target(room(2, 5000));
    let source = room(2, 500);
    let stage = IcpStage { max_distance: 0.5, kernel_width: 1e6 };
    let icp = Icp { stages: vec![stage], max_iterations: 0, ..Icp::for_voxel(0.1) };
    let information = icp.align(&source, &target, &RigidTransform::identity()).unwrap().information;
    let twist = nalgebra::Vector6::new(2e-5, -1e-5, 3e-5, 1e-5, 2e-5, -4e-5);
    let moved = RigidTransform::from_increment(&twist);
    let result = icp.align(&source, &target, &moved).unwrap();
    let error = result.residual_rmse.powi(2) * source.len() as f64;
    let predicted = twist.dot(&(information * twist));
    assert!((error / predicted - 1.0).abs() < 1e-3, "{error} {predicted}");
}

#[test]
fn a_single_plane_is_reported_and_does_not_run_away() {
    let plane: Vec<_> = (0..2500)
        .map(|i| Point3::new(f64::from(i % 50) * 0.1 + 700.0, f64::from(i / 50) * 0.1, 0.0))
        .collect();
    let start = RigidTransform::from_translation(Vector3::new(0.0, 0.0, 0.05));
    let target = IcpTarget::new(plane.clone(), vec![Vector3::z(); 2500]).unwrap();
    let result = Icp::for_voxel(0.1).align(&plane, &target, &start).unwrap();
    assert_eq!(result.open_directions.len(), 3);
    let error = result.target_from_source.error_to(&RigidTransform::identity());
    assert!(error.rotation_degrees < 1e-6 && error.translation < 1e-6, "{error:?}");
}

#[test]
fn what_cannot_be_aligned_is_an_error() {
    let target = target(room(2, 1000));
    let far = [Point3::new(100.0, 0.0, 0.0)];
    let icp = Icp::for_voxel(0.1);
    let identity = RigidTransform::identity();
    let unstaged = Icp { stages: Vec::new(), ..icp.clone() };
    for (icp, source, word) in [
        (&icp, &far[..], "within 0.15"),
        (&icp, &[], "no source points"),
        (&unstaged, &far, "no stages"),
        (&Icp::for_voxel(-1.0), &far, "positive"),
    ] {
        let message = icp.align(source, &target, &identity).unwrap_err().to_string();
        assert!(message.contains(word), "{message}");
    }
    assert!(IcpTarget::new(far.to_vec(), Vec::new()).is_err());
    assert!(icp.align(&target.points()[..1], &target, &identity).is_ok());
}

#[test]
fn the_number_of_threads_does_not_show() {
    let target = target(room(2, 5000));
    let source = room(1, 5000);
    let align = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| Icp::for_voxel(0.1).align(&source, &target, &motion()).unwrap())
    };
    assert_eq!(align(1), align(2));
}
