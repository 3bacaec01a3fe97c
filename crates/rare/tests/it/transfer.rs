//! Steps 5 and 6 against the golden keypoints, samples, common points and fused features.

use nalgebra::Point3;
use rare::data::DepthRange;
use rare::fuse::fuse;
use rare::transfer::{self, Sampling};
use rare::{DepthMap, FeatureMap, Intrinsics, PointFeatures};

use crate::shared::{Array, Golden};

fn pixels(array: &Array) -> Vec<(usize, usize)> {
    array.usize().chunks_exact(2).map(|pixel| (pixel[0], pixel[1])).collect()
}

fn features(golden: &mut Golden, points: &str, values: &str) -> PointFeatures {
    let (points, values) = (golden.array(points).points(), golden.array(values));
    PointFeatures::new(points, values.shape[1], values.f32()).unwrap()
}

fn assert_near(found: &[f32], expected: &[f64], tolerance: f64) {
    assert_eq!(found.len(), expected.len());
    for (index, (&found, &expected)) in found.iter().zip(expected).enumerate() {
        let difference = (f64::from(found) - expected).abs();
        assert!(difference <= tolerance, "number {index}: {found}, expected {expected}");
    }
}

#[test]
fn golden_grids() {
    let Some(mut golden) = Golden::open("rare/s7_keypoints.npz") else { return };
    let indoor = transfer::keypoint_grid(640, 480, 44, 32);
    assert_eq!(indoor, pixels(&golden.array("grid_3dmatch")));
    assert_eq!(transfer::keypoint_grid(1242, 225, 80, 32), pixels(&golden.array("grid_kitti")));
    // Neither side is a multiple of its number of cells.
    assert_eq!(transfer::keypoint_grid(70, 50, 11, 8), pixels(&golden.array("grid_small")));
}

/// The golden features and depths as the step takes them: a map and a depth image that is known at the grid only.
fn golden_view(golden: &mut Golden) -> (FeatureMap, DepthMap) {
    let features = golden.array("features");
    let [channels, height, width] = features.shape[..] else { panic!("three axes") };
    let map = FeatureMap::new(channels, height, width, features.f32()).unwrap();
    let mut depth = DepthMap::empty(Intrinsics::indoor());
    let seen = golden.array("dense_depth_at_keypoints").f32();
    for ((u, v), seen) in pixels(&golden.array("grid_3dmatch")).into_iter().zip(seen) {
        depth.depth_mut()[v * 640 + u] = seen;
    }
    (map, depth)
}

#[test]
fn golden_keypoints_and_features() {
    let Some(mut golden) = Golden::open("rare/s7_keypoints.npz") else { return };
    let (map, depth) = golden_view(&mut golden);
    let lifted = transfer::lift(&map, &depth, DepthRange::indoor(), Sampling::AlignedCorners);
    let mask = golden.array("depth_mask").values;
    let kept: Vec<usize> = (0..mask.len()).filter(|&index| mask[index] == 1.0).collect();
    let grid = pixels(&golden.array("grid_3dmatch"));
    assert_eq!(lifted.pixels, kept.iter().map(|&index| grid[index]).collect::<Vec<_>>());
    let points = golden.array("keypoint_xyz").points();
    for (found, &index) in lifted.keypoints.points().iter().zip(&kept) {
        assert!((found - points[index]).norm() < 1e-5, "{found} {}", points[index]);
    }
    let expected = golden.array("sampled_normalised").values;
    let rows: Vec<f64> =
        kept.iter().flat_map(|&index| &expected[index * 48..(index + 1) * 48]).copied().collect();
    assert_near(lifted.keypoints.values(), &rows, 1e-5);
}

#[test]
fn golden_common_points() {
    let Some(mut golden) = Golden::open("rare/s7_transfer.npz") else { return };
    let query = golden.array("query_xyz").points();
    let keypoints = golden.array("keypoint_xyz").points();
    let (nearest, mask) = (golden.array("nn_index").usize(), golden.array("common_mask").usize());
    let expected: Vec<_> = nearest.into_iter().enumerate().filter(|&(i, _)| mask[i] == 1).collect();
    let common = transfer::common_points(&query, &keypoints, golden.array("threshold").values[0]);
    assert_eq!(common, expected);
    let distances = golden.array("nn_sqdist").values;
    for (i, j) in common {
        let squared = (query[i] - keypoints[j]).norm_squared();
        assert!((squared - distances[i]).abs() < 1e-6);
    }
}

#[test]
fn golden_fused_features() {
    let Some(mut golden) = Golden::open("rare/s7_transfer.npz") else { return };
    let keypoints = features(&mut golden, "query_xyz", "feat3d");
    let lifted = features(&mut golden, "keypoint_xyz", "keypoint_feat");
    let common = transfer::common_points(keypoints.points(), lifted.points(), 0.05);
    let fused = fuse(&keypoints, &lifted, &common);
    let expected = golden.array("fused_common");
    assert_eq!([fused.len(), fused.dimension()], expected.shape[..]);
    assert_near(fused.values(), &expected.values, 1e-5);
    let first_common = common[0].0;
    assert_eq!(fused.points()[0], keypoints.points()[first_common]);
    // Indices that do not exist give no row.
    assert_eq!(fuse(&keypoints, &lifted, &[(500, 0), (0, 1399), (3, 7)]).len(), 1);
}

#[test]
fn pixels_of_which_nothing_is_known_are_left_out() {
    let intrinsics = Intrinsics { width: 6, height: 2, fx: 5.0, fy: 5.0, cx: 3.0, cy: 1.0 };
    // One cell per pixel: depth unknown, too near, too far, feature NaN, feature zero, fine.
    let depth = [0.0, 0.01, 10.0, 2.0, 2.0, 2.0].repeat(2);
    let depth = DepthMap::new(intrinsics, depth).unwrap();
    let features = [1.0, 1.0, 1.0, f32::NAN, 0.0, -3.0].repeat(2);
    let map = FeatureMap::new(1, 2, 6, features).unwrap();
    let lifted = transfer::lift(&map, &depth, DepthRange::indoor(), Sampling::AlignedCorners);
    assert_eq!(lifted.pixels, [(5, 0), (5, 1)]);
    assert!(lifted.keypoints.values().iter().all(|value| (value + 1.0).abs() < 1e-5));
}

#[test]
fn odd_sizes_do_not_panic() {
    assert!(transfer::keypoint_grid(0, 480, 4, 4).is_empty());
    assert!(transfer::keypoint_grid(640, 480, 0, 4).is_empty());
    assert_eq!(transfer::keypoint_grid(3, 1, 40, 1), [(0, 0), (1, 0), (2, 0)]);
    let intrinsics = Intrinsics { width: 1, height: 1, fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0 };
    let depth = DepthMap::new(intrinsics, vec![1.0]).unwrap();
    let map = FeatureMap::new(2, 3, 5, vec![1.0; 30]).unwrap();
    assert_eq!(
        transfer::lift(&map, &depth, DepthRange::indoor(), Sampling::AlignedCorners).pixels,
        [(0, 0)]
    );
    assert!(transfer::common_points(&[Point3::origin()], &[], 1.0).is_empty());
    let broken = [Point3::new(f64::NAN, 0.0, 0.0)];
    assert!(transfer::common_points(&broken, &[Point3::origin()], 1.0).is_empty());
}

#[test]
fn own_cells_are_taken_as_they_are() {
    let features = |intrinsics: Intrinsics, map: &FeatureMap| {
        let depth = vec![2.0; intrinsics.width * intrinsics.height];
        let depth = DepthMap::new(intrinsics, depth).unwrap();
        let lifted = transfer::lift(map, &depth, DepthRange::indoor(), Sampling::OwnCell);
        // The first of the two channels is 1: the second, divided by it, undoes the normalisation.
        let rows = lifted.keypoints.values().chunks_exact(2);
        rows.map(|row| (row[1] / row[0]).round()).collect::<Vec<f32>>()
    };
    let values = [1.0; 8].into_iter().chain((0..8).map(|cell| cell as f32)).collect();
    let map = FeatureMap::new(2, 2, 4, values).unwrap();
    let image = |width, height| Intrinsics { width, height, ..Intrinsics::indoor() };
    assert_eq!(features(image(41, 25), &map), [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]);
    // Fewer pixels than cells: the last cells of each row have no keypoint.
    assert_eq!(features(image(3, 2), &map), [0.0, 1.0, 2.0, 4.0, 5.0, 6.0]);
}
