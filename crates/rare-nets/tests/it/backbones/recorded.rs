//! Recorded pairs of clouds and stages of networks on them.

use rare_nets::Matrix;
use rare_nets::backbones::kpconv::{NeighbourLimits, Pyramid, PyramidConfig};
use rare_nets::checkpoint::Parameters;

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
