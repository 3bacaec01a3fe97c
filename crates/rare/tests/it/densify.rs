//! Step 2 against the golden images (FreeReg's filters with `OpenCV`), step by step.

use rare::densify::{
    Densifier, DensifyOptions, Holes, Image, bilateral5, close_full, dilate_cross, dilate_diamond,
    dilate_full, median5,
};
use rare::{DepthMap, Intrinsics};

use crate::shared::{Array, Golden};

/// Dilations, closings and medians only choose among values; `15 - d` and `100 - d` round.
const CHOSEN: f32 = 1e-5;
/// `OpenCV` takes the exponential of the bilateral filter from a table.
const FAST_BILATERAL: f32 = 2e-5;
const MULTISCALE_BILATERAL: f32 = 1e-4;
/// The formula in `f32` against `f64`, for values around 10.
const ROUNDING: f32 = 4e-6;
/// A value within rounding of the threshold 0.1 may flip its pixel.
const FLIPPED: f64 = 1e-4;

fn depth_map(array: &Array) -> DepthMap {
    let [height, width] = array.shape[..] else { panic!("{:?}", array.shape) };
    DepthMap::new(Intrinsics { width, height, ..Intrinsics::indoor() }, array.f32()).unwrap()
}

fn image(array: &Array) -> Image {
    Image::new(array.shape[1], array.shape[0], array.f32()).unwrap()
}

/// The share of pixels that differ by more than `tolerance`.
fn differing(values: &[f32], expected: &Array, tolerance: f32) -> f64 {
    assert_eq!(values.len(), expected.values.len());
    let different = |(a, b): &(&f32, &f64)| (f64::from(**a) - **b).abs() > f64::from(tolerance);
    values.iter().zip(&expected.values).filter(different).count() as f64 / values.len() as f64
}

/// Runs a filter and compares what it shows of every step with the golden arrays named here.
fn check_steps(densifier: Densifier, file: &str, steps: &[(&str, &str, f32)]) {
    let Some(mut golden) = Golden::open(file) else { return };
    let map = depth_map(&golden.array("s0_in"));
    let mut seen = Vec::new();
    let options = DensifyOptions::default();
    let dense = densifier.densify_observed(&map, &options, &mut |name, image| {
        seen.push((name, image.clone()));
    });
    assert_eq!(seen.len(), steps.len());
    for ((name, image), (expected_name, array, tolerance)) in seen.iter().zip(steps) {
        assert_eq!(name, expected_name);
        let share = differing(image.values(), &golden.array(array), *tolerance);
        assert!(share <= FLIPPED, "{file}: {array} differs in {share} of all pixels");
    }
    assert_eq!(densifier.densify(&map), dense);
}

fn check_fast_steps(file: &str) {
    check_steps(
        Densifier::Fast,
        file,
        &[
            ("invert", "s1_invert", CHOSEN),
            ("dilate", "s2_dilate_diamond7", CHOSEN),
            ("close", "s3_close_full5", CHOSEN),
            ("fill", "s4_fill_full7", CHOSEN),
            ("median", "s5_median5", CHOSEN),
            ("bilateral", "s6_bilateral", FAST_BILATERAL),
            ("revert", "s7_out", FAST_BILATERAL),
        ],
    );
}

fn check_multiscale_steps(file: &str) {
    check_steps(
        Densifier::Multiscale,
        file,
        &[
            ("invert", "s1_invert", CHOSEN),
            ("dilate", "s2_dilated", CHOSEN),
            ("close", "s3_closed", CHOSEN),
            ("median", "s4_median", CHOSEN),
            ("fill columns", "s5_fill9", CHOSEN),
            ("top mask", "s6_topmask", 0.0),
            ("fill gaps", "s7a_fill5x6", CHOSEN),
            ("second median", "s7b_median", CHOSEN),
            ("bilateral", "s7c_bilateral", MULTISCALE_BILATERAL),
            ("revert", "s8_invert", MULTISCALE_BILATERAL),
        ],
    );
}

#[test]
fn the_steps_of_fast() {
    check_fast_steps("rare/s2_fast_steps_small.npz");
    check_fast_steps("rare/s2_fast_steps_refview_ref.npz");
}

#[test]
fn the_steps_of_multiscale() {
    check_multiscale_steps("rare/s2_multiscale_steps_small.npz");
    check_multiscale_steps("rare/s2_multiscale_steps_kitti.npz");
}

#[test]
fn holes_of_multiscale_are_far_away_on_demand() {
    for file in ["rare/s2_multiscale_steps_small.npz", "rare/s2_multiscale_steps_kitti.npz"] {
        let Some(mut golden) = Golden::open(file) else { return };
        let map = depth_map(&golden.array("s0_in"));
        let options = DensifyOptions { holes: Holes::FarAway, ..DensifyOptions::default() };
        let dense = Densifier::Multiscale.densify_with(&map, &options);
        let share = differing(dense.depth(), &golden.array("s9_out"), MULTISCALE_BILATERAL);
        assert!(share <= FLIPPED, "{file}: {share}");
    }
}

#[test]
fn the_dense_maps_of_a_real_pair() {
    let Some(mut golden) = Golden::open("rare/s2_dense_outputs.npz") else { return };
    let Some(mut sparse) = Golden::open("rare/s1_projection_3dmatch.npz") else { return };
    for name in golden.names() {
        let expected = golden.array(&name);
        let (map_name, filter) = name.rsplit_once('_').unwrap();
        let mut map = DepthMap::empty(Intrinsics::indoor());
        let pixels = sparse.array(&format!("{map_name}_idx")).usize();
        let depths = sparse.array(&format!("{map_name}_depth")).f32();
        for (pixel, depth) in pixels.into_iter().zip(depths) {
            map.depth_mut()[pixel] = depth;
        }
        let (densifier, holes, tolerance) = match filter {
            "fast" => (Densifier::Fast, Holes::Zero, FAST_BILATERAL),
            _ => (Densifier::Multiscale, Holes::FarAway, MULTISCALE_BILATERAL),
        };
        let options = DensifyOptions { holes, ..DensifyOptions::default() };
        let dense = densifier.densify_with(&map, &options);
        let share = differing(dense.depth(), &expected, tolerance);
        assert!(share <= FLIPPED, "{name}: {share}");
    }
}

#[test]
fn the_filters_are_those_of_opencv() {
    let Some(mut golden) = Golden::open("rare/s2_primitives.npz") else { return };
    let input = image(&golden.array("in"));
    type Filter = fn(&mut Image);
    let cases: [(&str, Filter, f32); 13] = [
        ("dilate_FULL_KERNEL_5", dilate_full::<5>, 0.0),
        ("dilate_FULL_KERNEL_7", dilate_full::<7>, 0.0),
        ("dilate_FULL_KERNEL_9", dilate_full::<9>, 0.0),
        ("dilate_CROSS_KERNEL_3", dilate_cross::<3>, 0.0),
        ("dilate_CROSS_KERNEL_5", dilate_cross::<5>, 0.0),
        ("dilate_CROSS_KERNEL_7", dilate_cross::<7>, 0.0),
        ("dilate_DIAMOND_KERNEL_7", dilate_diamond, 0.0),
        ("close_FULL_KERNEL_5", close_full::<5>, 0.0),
        ("median5", median5, 0.0),
        ("bilateral_5_1.5_2", |image| bilateral5(image, 1.5, 2.0), FAST_BILATERAL),
        ("bilateral_5_0.5_2", |image| bilateral5(image, 0.5, 2.0), MULTISCALE_BILATERAL),
        ("bilateral_5_1.5_2_exact", |image| bilateral5(image, 1.5, 2.0), ROUNDING),
        ("bilateral_5_0.5_2_exact", |image| bilateral5(image, 0.5, 2.0), ROUNDING),
    ];
    for (name, filter, tolerance) in cases {
        let mut image = input.clone();
        filter(&mut image);
        let share = differing(image.values(), &golden.array(name), tolerance);
        assert_eq!(share, 0.0, "{name}");
    }
}

#[test]
fn maps_of_any_size_and_content_go_through() {
    for (width, height) in [(0, 0), (0, 3), (3, 0), (1, 1), (2, 1), (1, 7), (4, 4), (5, 3)] {
        let intrinsics = Intrinsics { width, height, ..Intrinsics::indoor() };
        for depth in [2.0, 0.0, -1.0, 1e30, f32::NAN, f32::INFINITY] {
            let map = DepthMap::new(intrinsics, vec![depth; width * height]).unwrap();
            let expected = if depth == 2.0 { 2.0 } else { 0.0 };
            for densifier in [Densifier::Fast, Densifier::Multiscale] {
                let dense = densifier.densify(&map);
                assert_eq!(dense.depth().len(), width * height);
                assert!(dense.depth().iter().all(|&depth| (depth - expected).abs() < 1e-5));
            }
        }
    }
}
