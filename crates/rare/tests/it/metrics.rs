//! The errors of poses against the golden rotation and translation errors.

use rare::RigidTransform;
use rare::nalgebra::Matrix4;

use crate::shared::Golden;

#[test]
fn golden_rotation_and_translation_errors() {
    let Some(mut golden) = Golden::open("rare/s8_metrics.npz") else { return };
    let truth = RigidTransform::from_matrix(&golden.array("gt").matrix4()).unwrap();
    let estimates = golden.array("est").values;
    let angles = golden.array("true_angle_deg").values;
    let by_trace = golden.array("re_trace_deg").values;
    let distances = golden.array("te").values;
    assert_eq!(estimates.len(), 16 * angles.len());
    for (index, estimate) in estimates.chunks_exact(16).enumerate() {
        let estimate = RigidTransform::from_matrix(&Matrix4::from_row_slice(estimate)).unwrap();
        for error in [estimate.error_to(&truth), truth.error_to(&estimate)] {
            // The arc cosine of the trace loses half of the digits where the cosine is 1 or -1.
            let flat = angles[index] < 0.01 || angles[index] > 179.99;
            let tolerance = if flat { 1e-5 } else { 1e-6 };
            assert!((error.rotation_degrees - by_trace[index]).abs() < tolerance, "{error:?}");
            assert!((error.rotation_degrees - angles[index]).abs() < 1e-6, "{error:?}");
            assert!((error.translation - distances[index]).abs() < 1e-6, "{error:?}");
        }
    }
}
