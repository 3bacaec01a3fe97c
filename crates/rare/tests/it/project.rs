//! Step 1 against the golden projections (FreeReg's own function, `f64`).

use rare::nalgebra::{Matrix3, Matrix4};
use rare::project::{pixel, project, project_moved};
use rare::{Camera, DepthMap, Intrinsics, RigidTransform};

use crate::shared::{Array, Golden};

/// The depth that is stored is `f32`.
const DEPTH_TOLERANCE: f32 = 1e-6;

/// The stored true pose is a rotation only to 5e-5 (it was printed from `f32`): made a rotation, it moves depths by
/// up to 1e-4 m, and some points over the border of a pixel.
const RIGID_DEPTH_TOLERANCE: f32 = 1.2e-4;
const RIGID_PIXELS: usize = 120;

fn intrinsics(k: &Array, width: usize, height: usize) -> Intrinsics {
    let k = Matrix3::from_row_slice(&k.values);
    Intrinsics { width, height, fx: k[(0, 0)], fy: k[(1, 1)], cx: k[(0, 2)], cy: k[(1, 2)] }
}

/// How many pixels of a map differ from those of a sparse golden one by more than `tolerance`, or in being seen.
fn differing(map: &DepthMap, pixels: &[usize], expected: &[f32], tolerance: f32) -> usize {
    let mut golden = vec![0.0; map.depth().len()];
    for (&pixel, &depth) in pixels.iter().zip(expected) {
        golden[pixel] = depth;
    }
    let different = |(depth, golden): &(&f32, &f32)| {
        (**depth == 0.0) != (**golden == 0.0) || (*depth - *golden).abs() > tolerance
    };
    map.depth().iter().zip(&golden).filter(different).count()
}

#[test]
fn the_six_maps_of_a_real_pair() {
    let Some(mut golden) = Golden::open("rare/s1_projection_3dmatch.npz") else { return };
    let (reference, source) =
        (golden.array("ref_points").points(), golden.array("src_points").points());
    let intrinsics = intrinsics(&golden.array("K"), 640, 480);
    assert_eq!(intrinsics, Intrinsics::indoor());
    let (truth, initial) = (golden.array("gt").matrix4(), golden.array("T_init").matrix4());
    let cases = [
        ("refview_ref", &reference, Matrix4::identity()),
        ("refview_src_gt", &source, truth),
        ("refview_src_init", &source, initial),
        ("srcview_src", &source, Matrix4::identity()),
        ("srcview_ref_gt", &reference, truth.try_inverse().unwrap()),
        ("srcview_ref_init", &reference, initial.try_inverse().unwrap()),
    ];
    for (name, points, matrix) in cases {
        let pixels = golden.array(&format!("{name}_idx")).usize();
        let depth = golden.array(&format!("{name}_depth")).f32();
        let moved: Vec<_> = points.iter().map(|point| matrix.transform_point(point)).collect();
        let identity = RigidTransform::identity();
        let exact = project_moved(&moved, &identity, &intrinsics).depth_map;
        assert_eq!(differing(&exact, &pixels, &depth, DEPTH_TOLERANCE), 0, "{name}");
        let camera_from_world = RigidTransform::from_matrix(&matrix).unwrap();
        let rigid = project_moved(points, &camera_from_world, &intrinsics);
        let moved = differing(&rigid.depth_map, &pixels, &depth, RIGID_DEPTH_TOLERANCE);
        assert!(moved <= RIGID_PIXELS, "{name}: {moved}");
        assert_eq!(project(points, &Camera { intrinsics, camera_from_world }), rigid);
    }
}

#[test]
fn a_street_seen_by_the_kitti_camera() {
    let Some(mut golden) = Golden::open("rare/s1_projection_kitti.npz") else { return };
    let intrinsics = intrinsics(&golden.array("K"), 1242, 225);
    let points = golden.array("points").points();
    let projection = project_moved(&points, &RigidTransform::identity(), &intrinsics);
    let pixels = golden.array("depth_idx").usize();
    let expected = golden.array("depth").f32();
    assert_eq!(differing(&projection.depth_map, &pixels, &expected, DEPTH_TOLERANCE), 0);
}

#[test]
fn points_on_every_border() {
    let Some(mut golden) = Golden::open("rare/s1_projection_edge.npz") else { return };
    let intrinsics = intrinsics(&golden.array("K"), 640, 480);
    let points = golden.array("points").points();
    let projection = project_moved(&points, &RigidTransform::identity(), &intrinsics);
    let pixels = golden.array("depth_idx").usize();
    let expected = golden.array("depth").f32();
    let depth = projection.depth_map.depth();
    let seen: Vec<(usize, f32)> =
        depth.iter().copied().enumerate().filter(|&(_, depth)| depth != 0.0).collect();
    assert_eq!(seen, pixels.into_iter().zip(expected).collect::<Vec<_>>());
    // The golden mask comes before the rule that nothing is seen beyond 9999.
    for (point, &kept) in points.iter().zip(&golden.array("kept").values) {
        assert_eq!(pixel(point, &intrinsics).is_some(), kept == 1.0 && point.z <= 9999.0);
    }
}
