//! FCGF against two references of its semantics that agree with each other: the arrays are theirs.

use rare::Result;
use rare::nalgebra::Point3;
use rare_nets::Matrix;
use rare_nets::backbones::Selection;
use rare_nets::backbones::fcgf::{Fcgf, FcgfConfig, layout};

use super::formula::{open_tensors, uniform};
use super::recorded::{described, finds_the_step, moved, official_layout};
use crate::shared::{GoldenTensors, relative_difference};

/// The largest relative difference of features.
const TOLERANCE: f64 = 1e-4;

fn tiny() -> FcgfConfig {
    FcgfConfig { voxel: 0.1, first_kernel: 5, ..FcgfConfig::three_d_match() }
}

/// The network with weights by the formula of the recorded arrays, of the sizes in `weights`; kernels with one offset have
/// `leading` sizes before the others.
pub(crate) fn load(weights: &FcgfConfig, leading: &[usize], config: FcgfConfig) -> Result<Fcgf> {
    let tensor = |(name, shape): (&String, &Vec<usize>)| {
        let values = uniform(name, shape.iter().product());
        let fan_in = match shape.as_slice() {
            [offsets, inputs, _] => offsets * inputs,
            [inputs, _] => *inputs,
            _ => 1,
        } as f32;
        let damped = if shape.len() == 3 { 0.8 } else { 1.0 };
        let (factor, summand) = match name.rsplit('.').next().unwrap() {
            "kernel" => (damped * (3.0 / fan_in).sqrt(), 0.0),
            "weight" => (0.2, 1.0),
            "running_var" => (0.25, 0.5),
            "num_batches_tracked" => (0.0, 1.0),
            _ => (0.1, 0.0),
        };
        let values = values.map(|value| factor * value as f32 + summand).collect();
        let leads = name.ends_with("kernel") && shape.len() == 2;
        let leading = if leads { leading } else { &[] };
        (name.clone(), [leading, shape].concat(), values)
    };
    let tensors: Vec<_> = layout(weights).iter().map(tensor).collect();
    let folder = tempfile::tempdir().unwrap();
    Fcgf::load(&open_tensors(folder.path(), &tensors), config)
}

fn points(values: &[f64]) -> Vec<Point3<f64>> {
    values.chunks_exact(3).map(|row| Point3::new(row[0], row[1], row[2])).collect()
}

/// A point in the middle of every recorded voxel: the references divide in single precision, which puts points on the
/// border of two voxels into the other one.
fn centres(golden: &GoldenTensors) -> Vec<Point3<f64>> {
    let coordinates = golden.array("in.coords").values;
    points(&coordinates.iter().map(|value| (value + 0.5) * 0.1).collect::<Vec<_>>())
}

fn compare(golden: &GoldenTensors, name: &str, features: &Matrix, tolerance: f64) {
    let expected = golden.array(name);
    assert_eq!([features.rows(), features.columns()], expected.shape[..], "{name}");
    let difference = relative_difference(features.values(), &expected.values);
    println!("fcgf {name}: {difference:.1e}");
    assert!(difference < tolerance, "{name}: {difference:.2e}");
}

#[test]
fn every_stage_is_that_of_the_references() {
    let Some(golden) = GoldenTensors::open("backbones/fcgf_tiny.safetensors") else { return };
    let network = load(&tiny(), &[], tiny()).unwrap();
    let output = network.run(&centres(&golden)).unwrap();
    for (coordinates, stride) in output.coordinates.iter().zip([1, 2, 4, 8]) {
        let flat: Vec<f64> = coordinates.iter().flatten().map(|&value| value.into()).collect();
        assert!(flat == golden.array(&format!("map.{stride}")).values, "stride {stride}");
    }
    for (features, name) in output.down.iter().skip(1).zip(["block2", "block3", "block4"]) {
        compare(&golden, name, features, TOLERANCE);
    }
    compare(&golden, "block1", &output.down[0], TOLERANCE);
    for (features, name) in output.up.iter().zip(["block2_tr", "block3_tr", "block4_tr"]) {
        compare(&golden, name, features, TOLERANCE);
    }
    compare(&golden, "out.out_raw", &output.raw, TOLERANCE);
    compare(&golden, "out.out", &output.features, TOLERANCE);
}

#[test]
fn tensors_are_those_of_the_official_model() {
    let Some(official) = official_layout("fcgf_resunetbn2c") else { return };
    assert!(layout(&FcgfConfig::three_d_match()) == official);
}

#[test]
fn the_first_point_of_every_voxel_is_kept() {
    let Some(golden) = GoldenTensors::open("backbones/fcgf_tiny.safetensors") else { return };
    let name = "backbones/geotransformer_full3dmatch.safetensors";
    let Some(pair) = GoldenTensors::open(name) else { return };
    let count = pair.array("in.lengths.0").usize()[0];
    // The references divide in single precision: done here, for voxels of 1 m.
    let scaled = pair.array("in.points.0").f32();
    let scaled: Vec<f64> = scaled[..3 * count].iter().map(|x| f64::from(x / 0.1)).collect();
    let network = load(&tiny(), &[], FcgfConfig { voxel: 1.0, ..tiny() }).unwrap();
    let kept = network.run(&points(&scaled)).unwrap().kept;
    assert!(kept == golden.array("in.sel").usize());
}

#[test]
fn kernels_with_a_leading_one_are_read_and_sizes_come_from_the_weights() {
    let Some(golden) = GoldenTensors::open("backbones/fcgf_tiny.safetensors") else { return };
    let config = FcgfConfig { features: 16, ..tiny() };
    let new = load(&config, &[], FcgfConfig::three_d_match()).unwrap();
    let old = load(&config, &[1], FcgfConfig::three_d_match()).unwrap();
    let cloud = &centres(&golden)[..300];
    let output = old.run(cloud).unwrap();
    assert_eq!(output.features.columns(), 16);
    assert!(output == new.run(cloud).unwrap());
    let error = load(&config, &[1, 1], config.clone()).err().unwrap().to_string();
    assert!(error.contains("not the weights of FCGF"), "{error}");
}

#[test]
fn two_clouds_are_described_whatever_the_number_of_threads() {
    let Some(golden) = GoldenTensors::open("backbones/fcgf_tiny.safetensors") else { return };
    let mut config = tiny();
    config.ransac.inlier_threshold = 0.15;
    let network = load(&config, &[], config.clone()).unwrap();
    let source = centres(&golden);
    let target = moved(&source);
    let selection = Selection { count: 900, ..Selection::default() };
    let description = described(|| network.describe(&source, &target, &selection).unwrap());
    assert_eq!(description.source.features.len(), 900);
    assert_eq!(description.target.features.dimension(), 32);
    finds_the_step(&description, 0.05);
    assert!(description.source != description.target);
}

#[test]
fn clouds_that_cannot_be_described_are_refused() {
    let network = load(&tiny(), &[], tiny()).unwrap();
    let refused = |cloud: &[Point3<f64>]| network.run(cloud).err().unwrap().to_string();
    assert!(refused(&[]).contains("has none"));
    assert!(refused(&[Point3::new(0.0, f64::NAN, 0.0)]).contains("NaN"));
    assert!(refused(&[Point3::new(0.0, 2e5, 0.0)]).contains("200000"));
    let alone = [Point3::new(0.05, 0.05, 0.05)];
    assert_eq!(network.run(&alone).unwrap().features.rows(), 1);
    let description = network.describe(&alone, &alone, &Selection::default()).unwrap();
    assert!(description.target_from_source.is_err() && description.warnings.is_empty());
    let sparse: Vec<_> = (0..9).map(|step| Point3::new(f64::from(step), 0.0, 0.0)).collect();
    let warnings = network.describe(&sparse, &alone, &Selection::default()).unwrap().warnings;
    assert!(warnings[0].contains("source's"), "{warnings:?}");
}
