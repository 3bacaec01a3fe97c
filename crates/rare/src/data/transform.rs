//! Rigid transforms. The variable's name carries the frames: `target_from_source.apply(point_in_source)`.

use std::ops::Mul;

use nalgebra::{Matrix3, Matrix4, Point3, Rotation3, Vector3, Vector6};
use serde::{Deserialize, Serialize};

use crate::error::{Error, Result};

/// The largest deviation of `R^T R` from the identity that still counts as a rotation printed with few digits.
const ORTHONORMALITY_TOLERANCE: f64 = 1e-2;

/// A rotation followed by a translation, in `f64`. Composed only by `*`; always a proper rotation (determinant +1).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RigidTransform {
    rotation: Rotation3<f64>,
    translation: Vector3<f64>,
}

/// How far a pose is from another one.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PoseError {
    /// Geodesic angle between the rotations, degrees.
    pub rotation_degrees: f64,
    /// Length of the difference of the translations, metres.
    pub translation: f64,
}

impl RigidTransform {
    /// The transform that moves nothing.
    #[must_use]
    pub fn identity() -> RigidTransform {
        RigidTransform { rotation: Rotation3::identity(), translation: Vector3::zeros() }
    }

    /// The transform `p -> rotation * p + translation`.
    #[must_use]
    pub fn new(rotation: Rotation3<f64>, translation: Vector3<f64>) -> RigidTransform {
        RigidTransform { rotation, translation }
    }

    /// The transform that only moves by `translation`.
    #[must_use]
    pub fn from_translation(translation: Vector3<f64>) -> RigidTransform {
        RigidTransform { rotation: Rotation3::identity(), translation }
    }

    /// Reads a homogeneous 4 x 4 matrix and projects its rotation part onto SO(3).
    ///
    /// # Errors
    /// `InvalidInput` if a number is not finite, the last row is not `0 0 0 1`, or the upper left block is further
    /// than 0.01 from a rotation (a scale, a shear or a reflection).
    pub fn from_matrix(matrix: &Matrix4<f64>) -> Result<RigidTransform> {
        if matrix.iter().any(|value| !value.is_finite()) {
            return Err(Error::invalid("the transform has a number that is not finite"));
        }
        let last = matrix.row(3);
        if (last[0].abs() + last[1].abs() + last[2].abs() + (last[3] - 1.0).abs()) > 1e-6 {
            return Err(Error::invalid(format!(
                "the last row of the transform is {} {} {} {}, it must be 0 0 0 1 (is the matrix transposed?)",
                last[0], last[1], last[2], last[3]
            )));
        }
        let linear: Matrix3<f64> = matrix.fixed_view::<3, 3>(0, 0).into_owned();
        let translation: Vector3<f64> = matrix.fixed_view::<3, 1>(0, 3).into_owned();
        Ok(RigidTransform { rotation: nearest_rotation(&linear)?, translation })
    }

    /// The homogeneous 4 x 4 matrix.
    #[must_use]
    pub fn to_matrix(&self) -> Matrix4<f64> {
        let mut matrix = self.rotation.to_homogeneous();
        matrix.fixed_view_mut::<3, 1>(0, 3).copy_from(&self.translation);
        matrix
    }

    /// The rotation.
    #[must_use]
    pub fn rotation(&self) -> &Rotation3<f64> {
        &self.rotation
    }

    /// The translation, metres.
    #[must_use]
    pub fn translation(&self) -> &Vector3<f64> {
        &self.translation
    }

    /// The transform of the opposite direction.
    #[must_use]
    pub fn inverse(&self) -> RigidTransform {
        let rotation = self.rotation.inverse();
        RigidTransform { rotation, translation: -(rotation * self.translation) }
    }

    /// Moves a point.
    #[must_use]
    pub fn apply(&self, point: &Point3<f64>) -> Point3<f64> {
        self.rotation * point + self.translation
    }

    /// Moves many points.
    #[must_use]
    pub fn apply_all(&self, points: &[Point3<f64>]) -> Vec<Point3<f64>> {
        points.iter().map(|point| self.apply(point)).collect()
    }

    /// Turns a direction.
    #[must_use]
    pub fn rotate(&self, direction: &Vector3<f64>) -> Vector3<f64> {
        self.rotation * direction
    }

    /// The small motion of a twist (rotation vector in radians, then translation in metres): the rotation is the
    /// exponential of its vector, the translation is taken as it is. Applied on the left, `increment * pose`.
    #[must_use]
    pub fn from_increment(twist: &Vector6<f64>) -> RigidTransform {
        RigidTransform {
            rotation: Rotation3::new(Vector3::new(twist[0], twist[1], twist[2])),
            translation: Vector3::new(twist[3], twist[4], twist[5]),
        }
    }

    /// How far this pose is from `truth` (rotation angle and distance of the translations).
    #[must_use]
    pub fn error_to(&self, truth: &RigidTransform) -> PoseError {
        // atan2 of sine and cosine stays exact near 0, where the arc cosine of the trace does not.
        let difference = (self.rotation.inverse() * truth.rotation).into_inner();
        let sine = Vector3::new(
            difference[(2, 1)] - difference[(1, 2)],
            difference[(0, 2)] - difference[(2, 0)],
            difference[(1, 0)] - difference[(0, 1)],
        )
        .norm()
            / 2.0;
        PoseError {
            rotation_degrees: sine.atan2((difference.trace() - 1.0) / 2.0).to_degrees(),
            translation: (self.translation - truth.translation).norm(),
        }
    }
}

impl Mul for RigidTransform {
    type Output = RigidTransform;

    /// `c_from_b * b_from_a = c_from_a`.
    fn mul(self, right: RigidTransform) -> RigidTransform {
        RigidTransform {
            rotation: self.rotation * right.rotation,
            translation: self.rotation * right.translation + self.translation,
        }
    }
}

/// The rotation nearest to a matrix that is one up to printing.
fn nearest_rotation(linear: &Matrix3<f64>) -> Result<Rotation3<f64>> {
    let deviation = (linear.transpose() * linear - Matrix3::identity()).abs().max();
    if deviation > ORTHONORMALITY_TOLERANCE {
        return Err(Error::invalid(format!(
            "the upper left 3 x 3 block of the transform is not a rotation: R^T R differs from the identity by {deviation:.3}"
        )));
    }
    if linear.determinant() < 0.0 {
        return Err(Error::invalid(
            "the upper left 3 x 3 block of the transform is a reflection (determinant -1)",
        ));
    }
    let svd = linear.svd(true, true);
    match (svd.u, svd.v_t) {
        (Some(u), Some(v_t)) => Ok(Rotation3::from_matrix_unchecked(u * v_t)),
        _ => Err(Error::Internal(
            "a singular value decomposition came without its vectors".to_owned(),
        )),
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn transforms() -> impl Strategy<Value = RigidTransform> {
        (prop::array::uniform3(-3.0..3.0), prop::array::uniform3(-50.0..50.0)).prop_map(
            |(r, t): ([f64; 3], [f64; 3])| {
                RigidTransform::new(Rotation3::new(Vector3::from(r)), Vector3::from(t))
            },
        )
    }

    proptest! {
        #[test]
        fn composition_is_application_in_turn(a in transforms(), b in transforms(), p in prop::array::uniform3(-10.0..10.0)) {
            let point = Point3::from(p);
            prop_assert!(((a * b).apply(&point) - a.apply(&b.apply(&point))).norm() < 1e-10);
        }

        #[test]
        fn the_inverse_undoes(a in transforms()) {
            let error = (a.inverse() * a).error_to(&RigidTransform::identity());
            prop_assert!(error.rotation_degrees < 1e-10 && error.translation < 1e-10);
        }

        #[test]
        fn a_matrix_reads_back(a in transforms()) {
            let error = RigidTransform::from_matrix(&a.to_matrix()).unwrap().error_to(&a);
            prop_assert!(error.rotation_degrees < 1e-10 && error.translation < 1e-12);
        }
    }

    #[test]
    fn the_error_is_the_angle_and_the_distance() {
        let a = RigidTransform::new(
            Rotation3::from_axis_angle(&Vector3::y_axis(), 0.3),
            Vector3::new(1.0, 2.0, 3.0),
        );
        let b = RigidTransform::new(
            Rotation3::from_axis_angle(&Vector3::y_axis(), 0.1),
            Vector3::new(1.0, 2.0, 1.0),
        );
        let error = a.error_to(&b);
        assert!((error.rotation_degrees - 0.2_f64.to_degrees()).abs() < 1e-10);
        assert!((error.translation - 2.0).abs() < 1e-12);
    }

    #[test]
    fn what_is_not_rigid_is_refused() {
        let mut scaled = Matrix4::identity();
        scaled[(0, 0)] = 1.1;
        let mut mirrored = Matrix4::identity();
        mirrored[(0, 0)] = -1.0;
        let mut projective = Matrix4::identity();
        projective[(3, 0)] = 1.0;
        let mut broken = Matrix4::identity();
        broken[(1, 3)] = f64::NAN;
        for (matrix, word) in [
            (scaled, "not a rotation"),
            (mirrored, "reflection"),
            (projective, "last row"),
            (broken, "finite"),
        ] {
            let message = RigidTransform::from_matrix(&matrix).unwrap_err().to_string();
            assert!(message.contains(word), "{message}");
        }
    }
}
