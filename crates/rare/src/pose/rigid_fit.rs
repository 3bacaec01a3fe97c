//! The rigid transform that best aligns weighted pairs of points (Kabsch 1976; Umeyama 1991 without scale).
//!
//! The singular vectors come from a one-sided Jacobi iteration on the 3 x 3 cross-covariance: accurate down to rank 2
//! and without allocation, because the estimators call this thousands of times. Only the two leading pairs of singular
//! vectors are used; the third is their cross product on either side, so that the result is a rotation by construction
//! and a reflection in the data turns the weakest direction, as the determinant correction of the textbook does.

use nalgebra::{Matrix3, Point3, Rotation3, Vector3};

use crate::data::RigidTransform;
use crate::error::{Error, Result};

/// Below this ratio of the second to the first singular value the pairs count as collinear: they are about 3 * 10^4
/// times as long as wide.
const RANK_TOLERANCE: f64 = 1e-9;

/// Two columns count as orthogonal below this cosine.
const ORTHOGONAL: f64 = 1e-15;

/// Sweeps after which the Jacobi iteration ends in any case; four or five are enough in practice.
const MAX_SWEEPS: usize = 20;

/// The transform that minimises `sum of weight * |target - (R source + t)|^2` over (source, target, weight) triples.
///
/// Points in metres, each in its own frame; negative and NaN weights count as 0. The weights are divided by their exact
/// sum, so their scale does not matter.
///
/// # Errors
/// `NoPose` if the rotation is not determined: the weights vanish, or the weighted points are fewer than three or
/// collinear.
pub fn fit_weighted<I>(pairs: I) -> Result<RigidTransform>
where
    I: Iterator<Item = (Point3<f64>, Point3<f64>, f64)> + Clone,
{
    let mut weight_sum = 0.0;
    let mut source_sum = Vector3::zeros();
    let mut target_sum = Vector3::zeros();
    for (source, target, weight) in pairs.clone() {
        let weight = weight.max(0.0);
        weight_sum += weight;
        source_sum += source.coords * weight;
        target_sum += target.coords * weight;
    }
    if weight_sum.is_nan() || weight_sum <= 0.0 {
        return Err(Error::no_pose(format!("the weights of the pairs sum to {weight_sum}")));
    }
    let (source_centroid, target_centroid) = (source_sum / weight_sum, target_sum / weight_sum);
    // H = sum of w (p - p_mean) (q - q_mean)^T
    let mut covariance = Matrix3::zeros();
    for (source, target, weight) in pairs {
        let source = (source.coords - source_centroid) * weight.max(0.0);
        covariance += source * (target.coords - target_centroid).transpose();
    }
    let rotation = best_rotation(&covariance).ok_or_else(|| {
        Error::no_pose(
            "the pairs do not determine a rotation: they are fewer than three or collinear",
        )
    })?;
    Ok(RigidTransform::new(rotation, target_centroid - rotation * source_centroid))
}

/// The rotation `R` that maximises `trace(R H)`; `None` if the rank of `H` is below 2 or a number is not finite.
fn best_rotation(covariance: &Matrix3<f64>) -> Option<Rotation3<f64>> {
    let scale = covariance.amax();
    if scale == 0.0 || covariance.iter().any(|value| !value.is_finite()) {
        return None;
    }
    // H V = U S
    let (scaled_left, right) = orthogonalise(covariance / scale);
    let mut lengths = [0, 1, 2].map(|i| (scaled_left[i].norm(), i));
    lengths.sort_by(|a, b| b.0.total_cmp(&a.0));
    let [(first, i), (second, j), _] = lengths;
    if second <= RANK_TOLERANCE * first {
        return None;
    }
    // R = V diag(1, 1, det) U^T
    let left = [scaled_left[i] / first, scaled_left[j] / second];
    let left = Matrix3::from_columns(&[left[0], left[1], left[0].cross(&left[1])]);
    let right = Matrix3::from_columns(&[right[i], right[j], right[i].cross(&right[j])]);
    Some(Rotation3::from_matrix_unchecked(right * left.transpose()))
}

/// One-sided Jacobi: rotates the columns of a matrix in pairs until they are orthogonal. Returns them and the columns
/// of the rotation that was applied from the right.
fn orthogonalise(matrix: Matrix3<f64>) -> ([Vector3<f64>; 3], [Vector3<f64>; 3]) {
    let mut columns = [0, 1, 2].map(|i| matrix.column(i).into_owned());
    let mut right = [Vector3::x(), Vector3::y(), Vector3::z()];
    for _ in 0..MAX_SWEEPS {
        let mut rotated = false;
        for (i, j) in [(0, 1), (0, 2), (1, 2)] {
            let (a, b) = (columns[i].norm_squared(), columns[j].norm_squared());
            let product = columns[i].dot(&columns[j]);
            // Also ends where a column has vanished.
            if product * product > ORTHOGONAL * ORTHOGONAL * a * b {
                let zeta = (b - a) / (2.0 * product);
                let tangent = 1.0_f64.copysign(zeta) / (zeta.abs() + zeta.hypot(1.0));
                let cosine = 1.0 / tangent.hypot(1.0);
                rotate(&mut columns, i, j, cosine, cosine * tangent);
                rotate(&mut right, i, j, cosine, cosine * tangent);
                rotated = true;
            }
        }
        if !rotated {
            break;
        }
    }
    (columns, right)
}

fn rotate(columns: &mut [Vector3<f64>; 3], i: usize, j: usize, cosine: f64, sine: f64) {
    let (a, b) = (columns[i], columns[j]);
    columns[i] = a * cosine - b * sine;
    columns[j] = a * sine + b * cosine;
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn a_random_motion_is_recovered(
            points in prop::collection::vec(prop::array::uniform3(-2.0..2.0), 4..30),
            turn in prop::array::uniform3(-3.0..3.0),
            shift in prop::array::uniform3(-100.0..100.0),
        ) {
            let truth = RigidTransform::new(Rotation3::new(Vector3::from(turn)), Vector3::from(shift));
            let pairs = points.iter().enumerate().map(|(i, &p)| {
                let source = Point3::from(p);
                (source, truth.apply(&source), 0.1 + i as f64)
            });
            let error = fit_weighted(pairs).unwrap().error_to(&truth);
            prop_assert!(error.rotation_degrees < 1e-6 && error.translation < 1e-6, "{error:?}");
        }

        #[test]
        fn any_matrix_gives_a_rotation_or_none(values in prop::array::uniform9(prop::num::f64::ANY)) {
            if let Some(rotation) = best_rotation(&Matrix3::from_iterator(values)) {
                let residual = rotation.matrix().transpose() * rotation.matrix() - Matrix3::identity();
                prop_assert!(residual.amax() < 1e-9 && rotation.matrix().determinant() > 0.0);
            }
        }
    }

    #[test]
    fn what_determines_no_pose_is_an_error() {
        let at = |x: f64| Point3::new(x, 2.0 * x, -x);
        let fit = |points: &[f64], weight: f64| {
            fit_weighted(points.iter().map(|&x| (at(x), at(x), weight)))
        };
        for (points, weight, word) in [
            (&[] as &[f64], 1.0, "sum to 0"),
            (&[1.0, 2.0, 5.0], 0.0, "sum to 0"),
            (&[1.0, 2.0, 5.0], f64::NAN, "sum to 0"),
            (&[1.0, 2.0, 5.0], 1.0, "collinear"),
            (&[1.0, 1.0, 1.0], 1.0, "collinear"),
        ] {
            let message = fit(points, weight).unwrap_err().to_string();
            assert!(message.contains(word), "{message}");
        }
    }
}
