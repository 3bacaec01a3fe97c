//! The weighted rigid fit against an `f64` reference.

use nalgebra::Point3;
use rare::RigidTransform;
use rare::pose::fit_weighted;

use crate::shared::Golden;

struct Case {
    source: Vec<Point3<f64>>,
    target: Vec<Point3<f64>>,
    weights: Vec<f64>,
}

impl Case {
    fn read(golden: &mut Golden, name: &str) -> Case {
        Case {
            source: golden.array(&format!("{name}_src")).points(),
            target: golden.array(&format!("{name}_ref")).points(),
            weights: golden.array(&format!("{name}_weights")).values,
        }
    }

    fn fit(&self) -> rare::Result<RigidTransform> {
        fit_weighted(
            (0..self.source.len()).map(|i| (self.source[i], self.target[i], self.weights[i])),
        )
    }
}

#[test]
fn every_determined_case_agrees_with_the_reference() {
    let Some(mut golden) = Golden::open("rare/s8_weighted_svd.npz") else { return };
    for (name, translation_tolerance) in [
        ("exact", 1e-5),
        ("weighted_noisy", 1e-5),
        ("three_points", 1e-5),
        ("planar", 1e-5),
        ("reflection", 1e-5),
        ("near_planar_noise_reflection", 1e-5),
        ("far_from_origin_f32", 2e-4),
    ] {
        let pose = Case::read(&mut golden, name).fit().unwrap().to_matrix();
        let difference = (pose - golden.array(&format!("{name}_T")).matrix4()).abs();
        let rotation = difference.fixed_view::<3, 3>(0, 0).max();
        let translation = difference.fixed_view::<3, 1>(0, 3).max();
        assert!(rotation < 1e-5, "{name}: rotation differs by {rotation}");
        assert!(
            translation < translation_tolerance,
            "{name}: translation differs by {translation}"
        );
        assert!((pose.fixed_view::<3, 3>(0, 0).determinant() - 1.0).abs() < 1e-12, "{name}");
    }
}

#[test]
fn degenerate_cases_are_errors() {
    let Some(mut golden) = Golden::open("rare/s8_weighted_svd.npz") else { return };
    for name in ["collinear", "two_points", "all_same_point", "zero_weights"] {
        let outcome = Case::read(&mut golden, name).fit();
        assert!(matches!(outcome, Err(rare::Error::NoPose { .. })), "{name}: {outcome:?}");
    }
}
