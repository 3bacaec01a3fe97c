//! Recorded pairs of clouds and stages of networks on them.

use rare::nalgebra::{Point3, Vector3};
use rare::{Correspondence, RigidTransform};
use rare_nets::Matrix;
use rare_nets::backbones::Description;
use rare_nets::backbones::kpconv::{NeighbourLimits, Pyramid, PyramidConfig};
use rare_nets::checkpoint::{Layout, Parameters};

use super::kpconv::golden_pyramid;
use crate::shared::{self, GoldenTensors, relative_difference};

/// The largest relative difference of features.
pub(crate) const TOLERANCE: f64 = 1e-4;

/// The weights of `golden/backbones/<name>.weights.safetensors`.
pub(crate) fn weights(name: &str) -> Option<Parameters> {
    let path = shared::path(&format!("golden/backbones/{name}.weights.safetensors"))?;
    let strip = |name: &str| name.strip_prefix("w.").map(str::to_owned);
    Some(Parameters::open(&path).unwrap().renamed(strip).unwrap())
}

/// The recorded points of all stages, and their neighbours found anew.
pub(crate) fn pyramid(golden: &GoldenTensors, config: &PyramidConfig) -> Pyramid {
    let limits = NeighbourLimits(vec![24; config.stages]);
    golden_pyramid(golden, config, &limits)
}

/// The recorded source and target, metres.
pub(crate) fn clouds(golden: &GoldenTensors) -> [Vec<Point3<f64>>; 2] {
    let values = golden.array("in.points.0").values;
    let points: Vec<_> = values.chunks_exact(3).map(|p| Point3::new(p[0], p[1], p[2])).collect();
    let (first, second) = points.split_at(golden.array("in.lengths.0").usize()[0]);
    [first.to_vec(), second.to_vec()]
}

/// Describes clouds in pools of 1 and of 3 threads, and makes sure that both say the same.
pub(crate) fn described(describe: impl Fn() -> Description + Sync) -> Description {
    let with = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(&describe)
    };
    let (one, three) = (with(1), with(3));
    assert!(one.source == three.source && one.target == three.target);
    assert!(one.correspondences == three.correspondences);
    assert!(one.target_from_source.as_ref().ok() == three.target_from_source.as_ref().ok());
    assert!(one.correspondences.is_sorted_by(|a, b| a.score >= b.score));
    one
}

/// Between the recorded source and where `moved` puts it. Whole voxels of all stages, so that the grids are the same.
const STEP: [f64; 3] = [1.6, -0.8, 2.4];

/// A cloud somewhere else.
pub(crate) fn moved(cloud: &[Point3<f64>]) -> Vec<Point3<f64>> {
    cloud.iter().map(|point| point + Vector3::from(STEP)).collect()
}

/// Makes sure that a description of a cloud and the moved one finds where it went, within so many metres.
pub(crate) fn finds_the_step(description: &Description, tolerance: f64) {
    let pose = description.target_from_source.as_ref().unwrap();
    let truth = RigidTransform::from_translation(Vector3::from(STEP));
    let error = pose.error_to(&truth);
    println!("pose: {:.1e} degrees, {:.1e} m", error.rotation_degrees, error.translation);
    assert!(error.rotation_degrees < 0.5 && error.translation < tolerance, "{error:?}");
    let exact = |pair: &&Correspondence| {
        (pair.target - pair.source - truth.translation()).norm() < tolerance
    };
    let exact = description.correspondences.iter().filter(exact).count();
    assert!(2 * exact > description.correspondences.len(), "{exact}");
}

/// Compares features with a recorded array, whose rows may be the channels of sequences.
pub(crate) fn compare(golden: &GoldenTensors, name: &str, features: &Matrix) {
    let expected = golden.array(name);
    let values = match expected.shape[..] {
        [1, channels, points] => {
            assert_eq!([points, channels], [features.rows(), features.columns()], "{name}");
            let at = |index| expected.values[index % channels * points + index / channels];
            (0..channels * points).map(at).collect()
        }
        _ => {
            assert_eq!(expected.shape[..], [features.rows(), features.columns()], "{name}");
            expected.values
        }
    };
    let difference = relative_difference(features.values(), &values);
    println!("{name}: {difference:.1e}");
    assert!(difference < TOLERANCE, "{name}: {difference:.2e}");
}

/// Compares what a step added to features.
pub(crate) fn compare_change(golden: &GoldenTensors, name: &str, after: &Matrix, before: &Matrix) {
    let values = after.values().iter().zip(before.values()).map(|(a, b)| a - b).collect();
    compare(golden, name, &Matrix::new(after.rows(), after.columns(), values).unwrap());
}

/// The tensors of an official checkpoint: `golden/backbones/<name>.state_dict.txt`.
pub(crate) fn official_layout(name: &str) -> Option<Layout> {
    let path = shared::path(&format!("golden/backbones/{name}.state_dict.txt"))?;
    let text = std::fs::read_to_string(path).unwrap();
    let entry = |line: &str| {
        let (name, shape) = line.split_once(char::is_whitespace).unwrap();
        let sizes = shape.trim().trim_matches(['(', ')']).split(',');
        let sizes = sizes.map(str::trim).filter(|size| !size.is_empty());
        (name.to_owned(), sizes.map(|size| size.parse().unwrap()).collect())
    };
    Some(text.lines().filter(|line| !line.trim().is_empty()).map(entry).collect())
}
