//! The network's picture of a depth map against the golden ones (FreeReg's functions with `OpenCV`).

use rare::hint::{
    GrayImage, Percentiles, depth_range, hint, normalize_depth, resize_area, resize_image,
    resize_lanczos4,
};
use rare::{DepthMap, Intrinsics};

use crate::shared::{Array, Golden};

const PERCENTILES: f64 = 1e-6;
/// Shares of pixels that may be off by one: truncation of values at a whole number, and `OpenCV`'s fixed-point weights.
const NORMALIZED_OFF: f64 = 0.001;
const RESIZED_OFF: f64 = 0.06;
/// Means of areas fall on halves, which `f32` and `f64` round to different sides.
const RESIZED_OFF_EXACT: f64 = 0.02;

fn bytes(array: &Array) -> Vec<u8> {
    array.values.iter().map(|&value| value as u8).collect()
}

fn depth_map(height: usize, width: usize, depth: Vec<f32>) -> DepthMap {
    DepthMap::new(Intrinsics { width, height, ..Intrinsics::indoor() }, depth).unwrap()
}

/// No pixel is off by more than one, and at most a share of `off` by one.
#[track_caller]
fn assert_close(name: &str, image: &GrayImage, expected: &Array, off: f64) {
    assert_eq!([image.height(), image.width()], expected.shape[..], "{name}");
    let expected = bytes(expected);
    let differences = image.values().iter().zip(&expected).map(|(a, b)| a.abs_diff(*b));
    assert!(differences.clone().max() <= Some(1), "{name}: {:?}", differences.max());
    let share = differences.filter(|&by| by == 1).count() as f64 / expected.len() as f64;
    assert!(share <= off, "{name}: {share}");
}

/// Percentiles, normalised picture and hint of one map.
fn check(golden: &mut Golden, name: &str, map: &DepthMap) {
    let mut array = |part: &str| golden.array(&format!("{name}_{part}"));
    let (near, far) = depth_range(map, Percentiles::AllPixels).unwrap();
    let expected = array("percentiles").values;
    assert!((near - expected[0]).abs() <= PERCENTILES, "{name}: {near}");
    assert!((far - expected[1]).abs() <= PERCENTILES, "{name}: {far}");
    let normalized = normalize_depth(map, Percentiles::AllPixels).unwrap();
    assert_close(name, &normalized, &array("norm_u8"), NORMALIZED_OFF);
    let hint = hint(map, Percentiles::AllPixels).unwrap();
    assert_close(name, &hint, &array("hint_u8"), RESIZED_OFF);
}

#[test]
fn the_hints_of_a_real_pair() {
    let Some(mut golden) = Golden::open("rare/s3_normalize_resize.npz") else { return };
    let Some(mut dense) = Golden::open("rare/s2_dense_outputs.npz") else { return };
    let names = golden.names();
    for name in names.iter().filter_map(|name| name.strip_suffix("_percentiles")) {
        let (map_name, storage) = name.rsplit_once('_').unwrap();
        let mut depth = dense.array(map_name).f32();
        if storage == "png16" {
            depth.iter_mut().for_each(|depth| *depth = (*depth * 1000.0).trunc());
        }
        check(&mut golden, name, &depth_map(480, 640, depth));
    }
}

#[test]
fn the_hint_of_a_street() {
    let Some(mut golden) = Golden::open("rare/s3_normalize_resize_kitti.npz") else { return };
    let depth = golden.array("depth_in").f32();
    check(&mut golden, "kitti_multiscale_float", &depth_map(225, 1242, depth));
}

#[test]
fn resized_pictures() {
    let Some(mut golden) = Golden::open("rare/s3_resize_small.npz") else { return };
    for row in golden.array("sizes").usize().chunks_exact(5) {
        let image = GrayImage::new(row[1], row[0], vec![7; row[0] * row[1]]).unwrap();
        let resized = resize_image(&image, 512).unwrap();
        assert_eq!([resized.height(), resized.width()], row[2..4], "{row:?}");
        assert!(resized.values().iter().all(|&value| value == 7));
    }
    let a = GrayImage::new(60, 45, bytes(&golden.array("a"))).unwrap();
    for name in ["lanczos_48x66", "lanczos_102x124", "area_30x41", "area_15x20", "area_45x66"] {
        let expected = golden.array(name);
        let [height, width] = expected.shape[..] else { panic!("{name}") };
        let resized = match name.starts_with("lanczos") {
            true => resize_lanczos4(&a, height, width),
            false => resize_area(&a, height, width),
        };
        assert_close(name, &resized, &expected, RESIZED_OFF);
        let exact = golden.array(&format!("{name}_float"));
        assert_close(name, &resized, &exact, RESIZED_OFF_EXACT);
    }
}

#[test]
fn a_network_takes_three_equal_channels() {
    let image = GrayImage::new(2, 1, vec![0, 51]).unwrap();
    let channels = image.to_channels().unwrap();
    assert_eq!([channels.channels(), channels.height(), channels.width()], [3, 1, 2]);
    assert_eq!(channels.values(), [0.0, 0.2, 0.0, 0.2, 0.0, 0.2]);
}
