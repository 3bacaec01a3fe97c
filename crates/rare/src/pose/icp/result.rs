//! An aligned pose, its evidence, and the motions that the evidence says nothing about.

use nalgebra::{DMatrix, Matrix6, Point3, Vector3};

use crate::data::RigidTransform;
use crate::pose::normal_equations::NormalEquations;

/// An aligned pose and its evidence, all evaluated at exactly this pose with the last stage's settings. The target
/// points of the voxelised method are the means of its voxels.
#[derive(Debug, Clone, PartialEq)]
pub struct IcpResult {
    /// Moves points of the source into the target's frame.
    pub target_from_source: RigidTransform,
    /// Share of the (finite) source points with a target point closer than the last stage's distance, 0 to 1.
    pub fitness: f64,
    /// Root mean square distance of those points to their nearest target points, metres.
    pub inlier_rmse: f64,
    /// Share of the (finite) source points in pairs that trimming let through; the fitness if nothing is trimmed.
    pub overlap: f64,
    /// Root of the kernel-weighted mean square of what the method makes small, metres: distances between points, to
    /// tangent planes, or (the generalised methods) in the metric that counts them in full across surfaces.
    pub residual_rmse: f64,
    /// Rounds made in each stage.
    pub iterations: Vec<usize>,
    /// Whether the last stage ended because the step was small.
    pub converged: bool,
    /// The motions that the surfaces leave (nearly) open, those with the least turn first: two shifts and a turn for a
    /// single plane, a shift for a corridor, three turns for a ball, a shift and a turn for a cylinder. All
    /// methods but point-to-point rest there, so along these motions the pose is as good as the start; point-to-point
    /// follows the sampling of the points. Empty if every motion is determined.
    pub open_directions: Vec<OpenDirection>,
    /// `J^T W J` of the distances to the tangent planes (between the points, if the target has no normals) for a left
    /// increment `[rotation vector, translation]` at the origin of the target's frame, whatever the method. Divided by
    /// the variance of the residuals it is the inverse covariance of the pose.
    pub information: Matrix6<f64>,
}

/// A motion that changes the distances between the surfaces by next to nothing: a turn about `centre` and a shift, in
/// the amount that moves the points by one metre (root mean square) from the first order.
///
/// All in the target's frame. The motion `m` times as large is `p -> p + m * (rotation x (p - centre) + translation)`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OpenDirection {
    /// The centroid of the aligned source, metres.
    pub centre: Point3<f64>,
    /// Rotation vector, radians: along the axis, right-handed; about zero for a pure shift.
    pub rotation: Vector3<f64>,
    /// Shift of the centre, metres; about zero for a turn about an axis through it.
    pub translation: Vector3<f64>,
    /// Mean square change of the distances, square metres, kernel-weighted; at most 0.01, 1 for a motion straight
    /// across all surfaces.
    pub visibility: f64,
}

impl OpenDirection {
    /// The point closest to `centre` on the axis of the motion, target frame, metres; `None` if it is a mere shift
    /// (less than a tenth of the motion is a turn).
    #[must_use]
    pub fn point_on_axis(&self) -> Option<Point3<f64>> {
        let (square, shift) = (self.rotation.norm_squared(), self.translation.norm_squared());
        // The turn moves the points by a metre less what the shift does.
        (shift < 0.99 && square > 0.0)
            .then(|| self.centre + self.rotation.cross(&self.translation) / square)
    }
}

/// The open directions of the sums, in the basis that sets shifts apart from turns.
pub(super) fn open_directions(sums: &NormalEquations) -> Vec<OpenDirection> {
    let Some(eigen) = sums.eigen() else { return Vec::new() };
    let open: Vec<usize> = (0..6).filter(|&i| eigen.eigenvalues[i] <= sums.open_limit()).collect();
    if open.is_empty() {
        return Vec::new();
    }
    let basis = DMatrix::from_fn(6, open.len(), |i, j| eigen.eigenvectors[(i, open[j])]);
    // The eigenvectors of the turning part within the open space: eigenvalue 0 is a shift, 1 a turn about the centre.
    let turning = basis.rows(0, 3).tr_mul(&basis.rows(0, 3)).symmetric_eigen();
    let mut order: Vec<usize> = (0..open.len()).collect();
    order.sort_by(|&a, &b| turning.eigenvalues[a].total_cmp(&turning.eigenvalues[b]));
    let mixed = &basis * &turning.eigenvectors;
    let visibility = |j: usize| -> f64 {
        let shares = turning.eigenvectors.column(j);
        shares.iter().zip(&open).map(|(share, &i)| share * share * eigen.eigenvalues[i]).sum()
    };
    order
        .into_iter()
        .map(|j| {
            let part = |row: usize| {
                Vector3::new(mixed[(row, j)], mixed[(row + 1, j)], mixed[(row + 2, j)])
            };
            let (turn, shift) = (part(0), part(3));
            // Either sense is open: the one whose largest part is positive.
            let sign =
                if turn.norm() > shift.norm() { largest(&turn) } else { largest(&shift) }.signum();
            OpenDirection {
                centre: sums.centre,
                rotation: turn * (sign / sums.spread),
                translation: shift * sign,
                visibility: visibility(j).max(0.0) / sums.weight,
            }
        })
        .collect()
}

/// The component with the largest absolute value.
fn largest(v: &Vector3<f64>) -> f64 {
    v.iter()
        .copied()
        .fold(0.0, |best: f64, value| if value.abs() > best.abs() { value } else { best })
}
