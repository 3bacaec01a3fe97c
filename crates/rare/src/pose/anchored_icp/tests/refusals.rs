//! What is left out and what is refused.

use super::*;

#[test]
fn points_and_anchors_that_are_not_finite_are_ignored() {
    let scene = Scene::new(corner);
    let icp = AnchoredIcp::for_voxel(VOXEL);
    let start = off(&scene.truth);
    let mut good = anchors(50, &scene.truth, |_| Vector3::zeros());
    let clean = scene.align(&icp, &good, &start).unwrap();

    let spoilt = |cloud: &IcpTarget| {
        let (mut points, mut normals) = (cloud.points().to_vec(), cloud.normals().to_vec());
        for value in [f64::NAN, f64::INFINITY] {
            points.push(Point3::new(value, 0.0, 0.0));
            normals.push(Vector3::z());
            points.push(points[0]);
            normals.push(Vector3::repeat(value));
        }
        IcpTarget::new(points, normals).unwrap()
    };
    let (source, target) = (spoilt(&scene.source), spoilt(&scene.target));
    let sample = |cloud: &IcpTarget| {
        let count = cloud.points().len();
        let mut sample: Vec<usize> = (0..count - 4).step_by(2).collect();
        sample.extend(count - 4..count);
        sample
    };
    for value in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
        good.push(Correspondence { target: Point3::new(0.0, value, 0.0), ..good[0] });
        good.push(Correspondence { source: Point3::new(0.0, value, 0.0), ..good[0] });
    }
    let samples = (sample(&source), sample(&target));
    let result = icp.align(&source, &target, &samples.0, &samples.1, &good, &start).unwrap();
    assert_eq!(result, clean);
}

#[test]
fn what_cannot_be_aligned_is_an_error() {
    let scene = Scene::new(floor);
    let icp = AnchoredIcp::for_voxel(VOXEL);
    let good = every(2, &scene.target);
    let lost = cloud(&[(Point3::new(f64::NAN, 0.0, 0.0), Vector3::z())], &scene.truth);
    let crossed = IcpTarget::new(scene.target.points().to_vec(), vec![Vector3::x(); 4000]).unwrap();
    let huge = [1e200, -1e200].map(|x| (Point3::new(x, 0.0, 0.0), Vector3::z()));
    let huge = cloud(&huge, &RigidTransform::identity());
    let identity = RigidTransform::identity();
    for (source, target, samples, word) in [
        (&scene.target, &scene.target, (&[][..], &[][..]), "no sampled points"),
        (&lost, &scene.target, (&[0], &[]), "no sampled points"),
        (
            &scene.target,
            &scene.target,
            (&[4000], &[]),
            "source sample of anchored icp has the index 4000",
        ),
        (
            &scene.target,
            &scene.target,
            (&[], &[4001]),
            "target sample of anchored icp has the index 4001",
        ),
        (&scene.source, &scene.target, (&good, &good), "within 0.05 m"),
        (&crossed, &scene.target, (&good, &good), "60 degrees"),
        (&huge, &scene.target, (&[0], &good), "within 0.05 m"),
        (&huge, &huge, (&[0, 1], &[]), "too large"),
    ] {
        let result = icp.align(source, target, samples.0, samples.1, &[], &identity);
        let message = result.unwrap_err().to_string();
        assert!(message.contains(word), "{message}");
    }
    assert!(icp.align(&scene.target, &scene.target, &[0], &[], &[], &identity).is_ok());
}

#[test]
fn settings_that_make_no_sense_are_refused() {
    let scene = Scene::new(floor);
    let good = AnchoredIcp::for_voxel(VOXEL);
    for (icp, word) in [
        (AnchoredIcp { stages: Vec::new(), ..good.clone() }, "no stages"),
        (
            AnchoredIcp { stages: AnchoredIcp::for_voxel(-1.0).stages, ..good.clone() },
            "both must be",
        ),
        (AnchoredIcp { rotation_tolerance: -1.0, ..good.clone() }, "rotation tolerance"),
        (AnchoredIcp { translation_tolerance: f64::NAN, ..good.clone() }, "translation tolerance"),
        (AnchoredIcp { anchor_weight: -0.1, ..good.clone() }, "anchor weight"),
        (AnchoredIcp { anchor_weight: f64::INFINITY, ..good.clone() }, "anchor weight"),
        (AnchoredIcp { anchor_width: 0.0, ..good.clone() }, "anchor width"),
    ] {
        let message = scene.align(&icp, &[], &scene.truth).unwrap_err().to_string();
        assert!(message.contains(word), "{message}");
    }
    let still = AnchoredIcp { max_iterations: 0, ..good };
    let result = scene.align(&still, &[], &scene.truth).unwrap();
    assert!(result.target_from_source == scene.truth && !result.converged);
}
