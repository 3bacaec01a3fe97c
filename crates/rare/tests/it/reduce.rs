//! Step 4 against the golden arrays (FreeReg's formulas in `f64` with a symmetric eigensolver).

use rare::FeatureMap;
use rare::reduce::{Corners, JointPca, reduce, resize_bilinear};

use crate::shared::{Array, Golden};

const COORDINATES: f64 = 1e-4;
/// Relative to the largest eigenvalue.
const EIGENVALUES: f64 = 1e-6;
const RESIZED: f64 = 1e-6;

fn feature_map(array: &Array) -> FeatureMap {
    let [channels, height, width] = array.shape[..] else { panic!("{:?}", array.shape) };
    FeatureMap::new(channels, height, width, array.f32()).unwrap()
}

#[track_caller]
fn assert_close(name: &str, values: &FeatureMap, expected: &Array, tolerance: f64) {
    assert_eq!([values.channels(), values.height(), values.width()], expected.shape[..], "{name}");
    let largest = values
        .values()
        .iter()
        .zip(&expected.values)
        .map(|(&a, &b)| (f64::from(a) - b).abs())
        .fold(0.0, f64::max);
    assert!(largest <= tolerance, "{name}: {largest:e}");
}

/// The analysis of one layer.
fn check_layer(golden: &mut Golden, layer: usize, components: usize) {
    let mut array = |name: &str| golden.array(&format!("{name}_{layer}"));
    let (a, b) = (feature_map(&array("in_a")), feature_map(&array("in_b")));
    let pca = JointPca::fit(&a, &b, components).unwrap();
    for (mean, expected) in pca.mean().iter().zip(&array("mean").values) {
        assert!((mean - expected).abs() < 1e-7);
    }
    let expected = array("eigenvalues").values;
    assert_eq!(pca.eigenvalues().len(), expected.len().min(a.values().len() / a.channels() * 2));
    let found = pca.eigenvalues().iter().copied().chain(std::iter::repeat(0.0));
    for (found, expected_value) in found.zip(&expected) {
        assert!((found - expected_value).abs() <= EIGENVALUES * expected[0]);
    }
    let expected = array("components");
    assert_eq!(pca.components().len(), components);
    for (index, component) in pca.components().enumerate() {
        for (channel, value) in component.iter().enumerate() {
            let expected = expected.values[channel * components + index];
            assert!((value - expected).abs() <= COORDINATES, "{layer}: {index} {channel}");
        }
    }
    assert_close("pca_a", &pca.project(&a).unwrap(), &array("pca_a"), COORDINATES);
}

fn check(file: &str) {
    let Some(mut golden) = Golden::open(file) else { return };
    let components = golden.array("n_components").usize()[0];
    let layers = |golden: &mut Golden, map: &str| {
        [0, 3, 6].map(|layer| feature_map(&golden.array(&format!("in_{map}_{layer}")))).to_vec()
    };
    for layer in [0, 3, 6] {
        check_layer(&mut golden, layer, components);
    }
    let (a, b) = (layers(&mut golden, "a"), layers(&mut golden, "b"));
    let (merged_a, merged_b) = reduce(&a, &b, Some(components)).unwrap();
    assert_close("merged_a", &merged_a, &golden.array("merged_a"), COORDINATES);
    assert_close("merged_b", &merged_b, &golden.array("merged_b"), COORDINATES);
}

#[test]
fn features_of_a_tiny_network() {
    check("rare/s6_pca_tiny.npz");
}

#[test]
fn features_with_a_known_spectrum() {
    check("rare/s6_pca_synth.npz");
}

#[test]
fn resized_maps() {
    let Some(mut golden) = Golden::open("rare/s6_resize_cases.npz") else { return };
    let map = feature_map(&golden.array("a"));
    for (name, height, width, corners) in [
        ("to_16x22", 16, 22, Corners::HalfPixel),
        ("to_32x44", 32, 44, Corners::HalfPixel),
        ("to_13x17", 13, 17, Corners::HalfPixel),
        ("to_5x6_plain", 5, 6, Corners::HalfPixel),
        ("to_48x64_aligncorners", 48, 64, Corners::Aligned),
    ] {
        let resized = resize_bilinear(&map, height, width, corners).unwrap();
        assert_close(name, &resized, &golden.array(name), RESIZED);
    }
    assert_eq!(resize_bilinear(&map, 8, 11, Corners::Aligned).unwrap(), map);
    assert!(resize_bilinear(&map, 0, 11, Corners::HalfPixel).is_err());
}
