//! The weighted least-squares system of one point-to-plane step.

use nalgebra::{Matrix3, Matrix6, Point3, Vector3, Vector6};

use crate::data::RigidTransform;

/// Below this share of the total weight a direction of motion counts as open.
const OPEN_DIRECTION: f64 = 1e-3;

/// Sums over the matched pairs, linearised about `centre` (target frame) in units of `spread` (metres), so that turning
/// by one unit moves a typical point as far as shifting by one unit does.
#[derive(Debug, Clone)]
pub(super) struct NormalEquations {
    pub(super) centre: Point3<f64>,
    spread: f64,
    /// `J^T W J`, rotation first.
    hessian: Matrix6<f64>,
    /// `J^T W r`.
    gradient: Vector6<f64>,
    /// Sum of the weights of the pairs that have a normal.
    pub(super) weight: f64,
    pub(super) weighted_plane_error: f64,
    pub(super) matched: usize,
    pub(super) squared_distance: f64,
}

/// A small motion about a centre: radians and metres.
#[derive(Debug, Clone, Copy)]
pub(super) struct Step {
    pub(super) rotation: Vector3<f64>,
    pub(super) translation: Vector3<f64>,
}

impl Step {
    /// The transform that turns about `centre` and then shifts.
    pub(super) fn about(&self, centre: &Point3<f64>) -> RigidTransform {
        let (r, t) = (&self.rotation, &self.translation);
        RigidTransform::from_translation(centre.coords)
            * RigidTransform::from_increment(&Vector6::new(r.x, r.y, r.z, t.x, t.y, t.z))
            * RigidTransform::from_translation(-centre.coords)
    }
}

impl NormalEquations {
    pub(super) fn new(centre: Point3<f64>, spread: f64) -> NormalEquations {
        NormalEquations {
            centre,
            spread,
            hessian: Matrix6::zeros(),
            gradient: Vector6::zeros(),
            weight: 0.0,
            weighted_plane_error: 0.0,
            matched: 0,
            squared_distance: 0.0,
        }
    }

    /// Counts a pair whose points are this far apart.
    pub(super) fn add_match(&mut self, squared_distance: f64) {
        self.matched += 1;
        self.squared_distance += squared_distance;
    }

    /// Adds the distance `residual` of `point` (target frame) to a tangent plane with this `normal`.
    pub(super) fn add_plane(
        &mut self,
        point: &Point3<f64>,
        normal: &Vector3<f64>,
        residual: f64,
        weight: f64,
    ) {
        // r(w, t) = r + n . (w x (p - c) + t) = r + ((p - c) x n) . w + n . t
        let turning = ((point - self.centre) / self.spread).cross(normal);
        let row = Vector6::new(turning.x, turning.y, turning.z, normal.x, normal.y, normal.z);
        self.hessian += row * (row * weight).transpose();
        self.gradient += row * (residual * weight);
        self.weight += weight;
        self.weighted_plane_error += weight * residual * residual;
    }

    /// Adds the sums of other pairs about the same centre.
    pub(super) fn merge(mut self, other: &NormalEquations) -> NormalEquations {
        self.hessian += other.hessian;
        self.gradient += other.gradient;
        self.weight += other.weight;
        self.weighted_plane_error += other.weighted_plane_error;
        self.matched += other.matched;
        self.squared_distance += other.squared_distance;
        self
    }

    /// The damped Gauss-Newton step; `None` if no pair has a say. `damping` is relative to the mean diagonal.
    pub(super) fn solve(&self, damping: f64) -> Option<Step> {
        let lift = damping * self.hessian.trace() / 6.0;
        let damped = self.hessian + Matrix6::from_diagonal_element(lift);
        let step = -damped.cholesky()?.solve(&self.gradient);
        step.iter().all(|value| value.is_finite()).then(|| Step {
            rotation: Vector3::new(step[0], step[1], step[2]) / self.spread,
            translation: Vector3::new(step[3], step[4], step[5]),
        })
    }

    /// How many directions of motion change the distances by next to nothing.
    pub(super) fn open_directions(&self) -> usize {
        let limit = OPEN_DIRECTION * self.weight;
        self.hessian.symmetric_eigenvalues().iter().filter(|&&value| value <= limit).count()
    }

    /// `J^T W J` in radians and metres for a left increment at the origin of the target's frame.
    pub(super) fn information(&self) -> Matrix6<f64> {
        // Turning by w and shifting by t at the origin turns by w and shifts by t + w x c at the centre c, and the
        // sums count turns in units of 1 / spread.
        let mut at_centre = Matrix6::identity();
        let turn = Matrix3::from_diagonal_element(self.spread);
        let shift = -self.centre.coords.cross_matrix();
        at_centre.fixed_view_mut::<3, 3>(0, 0).copy_from(&turn);
        at_centre.fixed_view_mut::<3, 3>(3, 0).copy_from(&shift);
        at_centre.transpose() * self.hessian * at_centre
    }
}
