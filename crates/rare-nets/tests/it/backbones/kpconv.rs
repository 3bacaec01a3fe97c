//! Pyramids and convolutions against golden ones.

use rare_nets::backbones::kpconv::{
    NeighbourLimits, Neighbours, Point, Pyramid, PyramidConfig, StagePoints, calibrate, subsample,
};

use crate::shared::{Array, GoldenTensors};

const ROOM: PyramidConfig = PyramidConfig { voxel: 0.025, stages: 4, radius: 2.5, sigma: 2.0 };

/// The golden pyramids: file, sizes, limits.
fn cases() -> [(&'static str, PyramidConfig, NeighbourLimits); 3] {
    let limits = || NeighbourLimits(vec![24; 4]);
    [
        ("tiny", PyramidConfig { voxel: 0.1, ..ROOM }, limits()),
        ("small", PyramidConfig { voxel: 0.05, ..ROOM }, limits()),
        ("full3dmatch", ROOM, NeighbourLimits::three_d_match()),
    ]
}

pub(super) fn golden_points(golden: &GoldenTensors, stage: usize) -> StagePoints {
    let points = golden.array(&format!("in.points.{stage}")).f32();
    let lengths = golden.array(&format!("in.lengths.{stage}")).usize();
    StagePoints {
        points: points.chunks_exact(3).map(|point| point.try_into().unwrap()).collect(),
        lengths: lengths.try_into().unwrap(),
    }
}

/// The pyramid over the points of the file, in their order.
pub(super) fn golden_pyramid(
    golden: &GoldenTensors,
    config: &PyramidConfig,
    limits: &NeighbourLimits,
) -> Pyramid {
    let points = (0..config.stages).map(|stage| golden_points(golden, stage)).collect();
    Pyramid::over(points, config, limits).unwrap()
}

fn sorted_bits(points: &[Point]) -> Vec<[u32; 3]> {
    let mut bits: Vec<[u32; 3]> = points.iter().map(|point| point.map(f32::to_bits)).collect();
    bits.sort_unstable();
    bits
}

#[test]
fn stages_have_the_points_of_the_released_code_to_the_last_bit() {
    for (name, config, _) in cases() {
        let file = format!("backbones/geotransformer_{name}.safetensors");
        let Some(golden) = GoldenTensors::open(&file) else { return };
        let mut same_order = 0;
        for stage in 1..config.stages {
            let finer = golden_points(&golden, stage - 1);
            let expected = golden_points(&golden, stage);
            for (cloud, expected) in finer.clouds().into_iter().zip(expected.clouds()) {
                let thinned = subsample(cloud, config.voxel(stage) as f32).unwrap();
                let (found, golden) = (sorted_bits(&thinned), sorted_bits(expected));
                let wrong: Vec<_> =
                    found.iter().zip(&golden).filter(|(a, b)| a != b).take(3).collect();
                assert!(
                    found.len() == golden.len() && wrong.is_empty(),
                    "{name} {stage}: {wrong:?}"
                );
                same_order += usize::from(thinned == expected);
            }
        }
        let first = golden_points(&golden, 0);
        let stages = StagePoints::new(first.clouds(), &config).unwrap();
        let counts: Vec<[usize; 2]> = stages.iter().map(|stage| stage.lengths).collect();
        println!("{name}: {counts:?}, {same_order} of 6 in the same order");
        let golden_counts: Vec<[usize; 2]> =
            (0..config.stages).map(|stage| golden_points(&golden, stage).lengths).collect();
        assert_eq!(counts, golden_counts, "{name}");
    }
}

/// Squared distances in single precision, as the search computes them.
fn squared_distance(a: &Point, b: &Point) -> f32 {
    let [x, y, z] = [0, 1, 2].map(|axis| a[axis] - b[axis]);
    x * x + y * y + z * z
}

/// Compares rows of indices; those at exactly equal distances may stand for each other. Gives the number of rows that
/// differ because of that.
fn compare(found: &Neighbours, golden: &Array, queries: &[Point], support: &[Point]) -> usize {
    let width = golden.shape[1];
    assert_eq!([found.len(), found.width()], [queries.len(), width]);
    let mut swapped = 0;
    for (index, query) in queries.iter().enumerate() {
        let expected: Vec<u32> = golden.values[index * width..(index + 1) * width]
            .iter()
            .map(|&value| value as u32)
            .collect();
        let row = found.row(index);
        if row == expected {
            continue;
        }
        let distances = |row: &[u32]| -> Vec<f32> {
            let distance = |&index: &u32| {
                support
                    .get(index as usize)
                    .map_or(f32::INFINITY, |point| squared_distance(query, point))
            };
            row.iter().map(distance).collect()
        };
        assert_eq!(distances(row), distances(&expected), "row {index}: {row:?} {expected:?}");
        swapped += 1;
    }
    swapped
}

#[test]
fn neighbours_are_those_of_the_released_code() {
    for (name, config, limits) in cases() {
        let file = format!("backbones/geotransformer_{name}.safetensors");
        let Some(golden) = GoldenTensors::open(&file) else { return };
        let pyramid = golden_pyramid(&golden, &config, &limits);
        let (mut swapped, mut rows) = (0, 0);
        for (level, stage) in pyramid.stages.iter().enumerate() {
            let array = golden.array(&format!("in.neighbors.{level}"));
            swapped += compare(&stage.neighbours, &array, &stage.points, &stage.points);
            rows += stage.points.len();
            let Some(coarser) = pyramid.stages.get(level + 1) else { continue };
            let array = golden.array(&format!("in.subsampling.{level}"));
            let subsampling = stage.subsampling.as_ref().unwrap();
            swapped += compare(subsampling, &array, &coarser.points, &stage.points);
            let array = golden.array(&format!("in.upsampling.{level}"));
            for (index, (&found, query)) in stage.upsampling.iter().zip(&stage.points).enumerate() {
                let expected = array.values[index * array.shape[1]] as u32;
                let distance = |index: u32| {
                    coarser.points.get(index as usize).map(|point| squared_distance(query, point))
                };
                assert_eq!(distance(found), distance(expected), "{name} {level} {index}");
                swapped += usize::from(found != expected);
            }
            rows += coarser.points.len() + stage.points.len();
        }
        println!("{name}: {swapped} of {rows} rows differ in the order of equal distances");
    }
}

#[test]
fn limits_are_calibrated_by_the_rule_of_the_training_code() {
    let Some(golden) = GoldenTensors::open("backbones/geotransformer_full3dmatch.safetensors")
    else {
        return;
    };
    let first = golden_points(&golden, 0);
    // Each stage needs more than 2000 points: one pair has 710 in the last, so the fourth is never looked at.
    let mut taken = 0;
    let pairs = std::iter::repeat_n(first.clouds(), 4).inspect(|_| taken += 1);
    let limits = calibrate(pairs, &ROOM).unwrap();
    println!("limits {limits:?}");
    assert_eq!(taken, 3);
    // The histogram of the golden neighbours themselves, which are cut off at the published limits.
    let published = NeighbourLimits::three_d_match();
    for (found, published) in limits.0.iter().zip(&published.0) {
        assert!(found.abs_diff(*published) <= 6, "{found} {published}");
    }
    assert!(calibrate(std::iter::empty(), &ROOM).is_err());
}
