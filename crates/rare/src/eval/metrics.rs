//! How far an estimated transform is from the true one: the formulas of the benchmarks.
//!
//! They take matrices as files hold them: the ground truth of 3DMatch is printed with nine digits and orthonormal only
//! to `5e-4`, and published numbers are computed from it as it is.

use nalgebra::{Matrix3, Matrix4, Matrix6, SymmetricEigen, Vector3, Vector6};

use crate::data::Correspondence;

/// The angle between two rotations by the formula of the official scripts, `acos((tr(A^T B) - 1) / 2)`, degrees.
///
/// Matrices that are not exactly orthonormal give angles of up to some degrees where there is none.
#[must_use]
pub fn official_rotation_error(estimate: &Matrix4<f64>, truth: &Matrix4<f64>) -> f64 {
    let trace = (rotation(estimate).transpose() * rotation(truth)).trace();
    // The scripts turn radians into degrees by a pi in single precision.
    ((trace - 1.0) / 2.0).clamp(-1.0, 1.0).acos() * 180.0 / f64::from(std::f32::consts::PI)
}

/// The angle between the rotations that are nearest to two matrices, degrees; accurate for small angles too.
#[must_use]
pub fn rotation_error(estimate: &Matrix4<f64>, truth: &Matrix4<f64>) -> f64 {
    let between = orthonormal(&rotation(estimate)).transpose() * orthonormal(&rotation(truth));
    let sine = Vector3::new(
        between[(2, 1)] - between[(1, 2)],
        between[(0, 2)] - between[(2, 0)],
        between[(1, 0)] - between[(0, 1)],
    );
    sine.norm().atan2(between.trace() - 1.0).to_degrees()
}

/// The distance between two translations, metres.
#[must_use]
pub fn translation_error(estimate: &Matrix4<f64>, truth: &Matrix4<f64>) -> f64 {
    (translation(estimate) - translation(truth)).norm()
}

/// The root mean square distance between true and estimated positions of the overlapping points, metres, as the
/// Redwood and 3DMatch benchmarks approximate it: `x^T I x / I_00` with `x = [t, q_x, q_y, q_z]` of `truth^-1 estimate`
/// and the 6 x 6 information matrix `I` of the pair (Choi, Zhou and Koltun, CVPR 2015).
///
/// `None` if the truth cannot be inverted or the information counts no point (3DLoMatch has such a pair; nothing solves it).
#[must_use]
pub fn registration_rmse(
    estimate: &Matrix4<f64>,
    truth: &Matrix4<f64>,
    information: &Matrix6<f64>,
) -> Option<f64> {
    let difference = truth.try_inverse()? * estimate;
    let (t, q) = (translation(&difference), quaternion_vector(&rotation(&difference)));
    let error = Vector6::new(t.x, t.y, t.z, q.x, q.y, q.z);
    let square = error.dot(&(information * error)) / information[(0, 0)];
    square.is_finite().then(|| square.max(0.0).sqrt())
}

/// The share of correspondences that the true transform brings closer than `threshold` metres (0.1 indoors, 1 on KITTI);
/// `None` without correspondences.
#[must_use]
pub fn inlier_ratio(pairs: &[Correspondence], truth: &Matrix4<f64>, threshold: f64) -> Option<f64> {
    let is_inlier = |pair: &&Correspondence| {
        let moved = rotation(truth) * pair.source.coords + translation(truth);
        (moved - pair.target.coords).norm() < threshold
    };
    let inliers = pairs.iter().filter(is_inlier).count();
    (!pairs.is_empty()).then(|| inliers as f64 / pairs.len() as f64)
}

/// Feature matching recall: the share of pairs whose inlier ratio is above `threshold` (0.05 in publications).
#[must_use]
pub fn feature_matching_recall(inlier_ratios: &[f64], threshold: f64) -> Option<f64> {
    let matched = inlier_ratios.iter().filter(|&&ratio| ratio > threshold).count();
    (!inlier_ratios.is_empty()).then(|| matched as f64 / inlier_ratios.len() as f64)
}

fn rotation(matrix: &Matrix4<f64>) -> Matrix3<f64> {
    matrix.fixed_view::<3, 3>(0, 0).into_owned()
}

fn translation(matrix: &Matrix4<f64>) -> Vector3<f64> {
    matrix.fixed_view::<3, 1>(0, 3).into_owned()
}

/// The rotation nearest to a matrix.
fn orthonormal(matrix: &Matrix3<f64>) -> Matrix3<f64> {
    let decomposition = matrix.svd(true, true);
    let (Some(u), Some(v)) = (decomposition.u, decomposition.v_t) else { return *matrix };
    let mut signs = Matrix3::identity();
    signs[(2, 2)] = (u * v).determinant().signum();
    u * signs * v
}

/// The vector part of the unit quaternion with a scalar part of at least 0 that fits a matrix best (Bar-Itzhack 2000),
/// which works for matrices that are not quite rotations.
fn quaternion_vector(m: &Matrix3<f64>) -> Vector3<f64> {
    #[rustfmt::skip]
    let symmetric = Matrix4::new(
        m[(0, 0)] - m[(1, 1)] - m[(2, 2)], m[(0, 1)] + m[(1, 0)], m[(0, 2)] + m[(2, 0)], m[(2, 1)] - m[(1, 2)],
        m[(0, 1)] + m[(1, 0)], m[(1, 1)] - m[(0, 0)] - m[(2, 2)], m[(1, 2)] + m[(2, 1)], m[(0, 2)] - m[(2, 0)],
        m[(0, 2)] + m[(2, 0)], m[(1, 2)] + m[(2, 1)], m[(2, 2)] - m[(0, 0)] - m[(1, 1)], m[(1, 0)] - m[(0, 1)],
        m[(2, 1)] - m[(1, 2)], m[(0, 2)] - m[(2, 0)], m[(1, 0)] - m[(0, 1)], m.trace(),
    );
    let eigen = SymmetricEigen::new(symmetric / 3.0);
    let quaternion = eigen.eigenvectors.column(eigen.eigenvalues.imax()).into_owned();
    let sign = if quaternion[3] < 0.0 { -1.0 } else { 1.0 };
    quaternion.fixed_rows::<3>(0) * sign
}

#[cfg(test)]
mod tests {
    use nalgebra::{Point3, Rotation3};

    use super::*;

    fn turned(degrees: f64, shift: f64) -> Matrix4<f64> {
        let axis = Vector3::new(1.0, -2.0, 0.5).normalize();
        let mut matrix = Rotation3::new(axis * degrees.to_radians()).to_homogeneous();
        matrix[(0, 3)] = shift;
        matrix
    }

    #[test]
    fn angles_and_distances_are_those_between_the_transforms() {
        let (a, b) = (turned(10.0, 1.0), turned(13.0, 1.25));
        assert!((official_rotation_error(&a, &b) - 3.0).abs() < 1e-7);
        assert!((rotation_error(&a, &b) - 3.0).abs() < 1e-12);
        assert_eq!(translation_error(&a, &b), 0.25);
        // The formula of the scripts takes a lack of orthonormality for an angle.
        let stretched = a * 0.9999;
        assert!(official_rotation_error(&stretched, &stretched) > 0.5);
        assert!(rotation_error(&stretched, &a) < 1e-6);
    }

    #[test]
    fn the_rmse_is_that_of_the_points_for_small_motions() {
        let points: Vec<Vector3<f64>> = (0..50)
            .map(|i| Vector3::new(f64::from(i % 7), f64::from(i % 5), f64::from(i)))
            .collect();
        let mut information = Matrix6::zeros();
        for p in &points {
            #[rustfmt::skip]
            let rows = nalgebra::Matrix3x6::new(
                1.0, 0.0, 0.0, 0.0, 2.0 * p.z, -2.0 * p.y,
                0.0, 1.0, 0.0, -2.0 * p.z, 0.0, 2.0 * p.x,
                0.0, 0.0, 1.0, 2.0 * p.y, -2.0 * p.x, 0.0,
            );
            information += rows.transpose() * rows;
        }
        let motion = turned(0.05, 0.02);
        let moved = |p: &Vector3<f64>| (motion * p.push(1.0)).xyz();
        let squares: f64 = points.iter().map(|p| (moved(p) - p).norm_squared()).sum();
        let expected = (squares / points.len() as f64).sqrt();
        let rmse = registration_rmse(&motion, &Matrix4::identity(), &information).unwrap();
        assert!((rmse / expected - 1.0).abs() < 1e-3, "{rmse} {expected}");
        assert_eq!(registration_rmse(&motion, &Matrix4::zeros(), &information), None);
        assert_eq!(registration_rmse(&motion, &motion, &Matrix6::zeros()), None);
    }

    #[test]
    fn ratios_count_what_lies_below_and_above_their_thresholds() {
        let pair = |distance| Correspondence {
            source: Point3::origin(),
            target: Point3::new(1.0, distance, 0.0),
            score: 1.0,
        };
        let pairs = [pair(0.05), pair(0.1), pair(0.2), pair(0.0)];
        assert_eq!(inlier_ratio(&pairs, &turned(7.0, 1.0), 0.1), Some(0.5));
        assert_eq!(inlier_ratio(&[], &turned(7.0, 1.0), 0.1), None);
        assert_eq!(feature_matching_recall(&[0.05, 0.06, 0.0, 1.0], 0.05), Some(0.5));
        assert_eq!(feature_matching_recall(&[], 0.05), None);
    }
}
