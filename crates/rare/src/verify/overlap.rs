//! How much of the source lies on the reference, in the form that benchmarks ask for.

use nalgebra::{Matrix3x6, Matrix6, Point3};

use crate::data::{KdTree, RigidTransform};

/// How much of the source lies on the reference under a pose, and how well that determines the pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Overlap {
    /// Share of the source points with a reference point within the distance, 0 to 1.
    pub share: f64,
    /// Sum of `G^T G` over those source points moved into the reference frame, `G = [I | -[p]x]`: the 6 x 6 matrix
    /// of 3DMatch's `gt.info`, translation first, metres. Element (0, 0) is the number of points.
    pub information: Matrix6<f64>,
}

/// Measures the overlap of evenly spaced (voxel) clouds under a pose, with `distance` in the clouds' unit of `unit`
/// metres.
#[must_use]
pub fn overlap(
    reference: &KdTree,
    source: &[Point3<f64>],
    reference_from_source: &RigidTransform,
    distance: f64,
    unit: f64,
) -> Overlap {
    let mut information = Matrix6::zeros();
    let mut count = 0_usize;
    for point in source {
        let moved = reference_from_source.apply(point);
        if reference.nearest_within(&moved, distance).is_some() {
            count += 1;
            let mut jacobian = Matrix3x6::zeros();
            jacobian.fixed_view_mut::<3, 3>(0, 0).fill_with_identity();
            jacobian.fixed_view_mut::<3, 3>(0, 3).copy_from(&-(moved.coords * unit).cross_matrix());
            information += jacobian.transpose() * jacobian;
        }
    }
    Overlap { share: count as f64 / source.len().max(1) as f64, information }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Rotation3, Vector3};

    use super::*;

    #[test]
    fn overlap_is_the_share_of_source_points_near_the_reference() {
        let reference = KdTree::new(&[Point3::new(1.0, 0.0, 0.0), Point3::new(5.0, 0.0, 0.0)]);
        let source = [0.0, 0.09, 0.11, 4.0, 9.0].map(|x| Point3::new(x, 0.0, 0.0));
        let found =
            overlap(&reference, &source, &RigidTransform::from_translation(Vector3::x()), 0.1, 1.0);
        assert_eq!(found.share, 0.6);
        assert_eq!(found.information[(0, 0)], 3.0);
        let nothing = overlap(&reference, &[], &RigidTransform::identity(), 0.1, 1.0);
        assert_eq!((nothing.share, nothing.information), (0.0, Matrix6::zeros()));
    }

    /// `G = [I | -[p]x]` written out for the moved point, as 3DMatch's evaluation has it.
    #[test]
    fn the_information_of_a_point_is_that_of_3dmatch() {
        let pose = RigidTransform::new(Rotation3::new(Vector3::new(0.3, -0.2, 0.9)), Vector3::x());
        let source = Point3::new(0.2, 1.4, -0.7);
        let (moved, unit) = (pose.apply(&source), 0.5);
        let (x, y, z) = (moved.x * unit, moved.y * unit, moved.z * unit);
        #[rustfmt::skip]
        let g = Matrix3x6::new(
            1.0, 0.0, 0.0, 0.0, z, -y,
            0.0, 1.0, 0.0, -z, 0.0, x,
            0.0, 0.0, 1.0, y, -x, 0.0,
        );
        let found = overlap(&KdTree::new(&[moved]), &[source], &pose, 0.1, unit).information;
        assert!((found - g.transpose() * g).abs().max() < 1e-12, "{found}");
        assert_eq!(found, found.transpose());
        // A small twist moves the point by G times it: the rows and columns are translation first.
        let turned = Rotation3::new(Vector3::new(1e-6, 2e-6, -1e-6)) * Point3::new(x, y, z);
        let step = g * nalgebra::Vector6::new(0.0, 0.0, 0.0, 1e-6, 2e-6, -1e-6);
        assert!((turned - Point3::new(x, y, z) - step).norm() < 1e-11);
    }
}
