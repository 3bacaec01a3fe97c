//! The weighted least-squares system of one ICP step.

use nalgebra::{Matrix3, Matrix6, Point3, SymmetricEigen, Vector3, Vector6};

use crate::data::RigidTransform;

/// Below this share of the total weight a direction of motion counts as open: the distances change by less than a tenth
/// (root mean square) of the motion. Estimated normals err by so much where surfaces meet.
pub(super) const OPEN_SHARE: f64 = 1e-2;

/// Rows of the lower triangle of a symmetric 6 x 6 matrix.
const TRIANGLE: usize = 21;

/// Sums over the matched pairs, linearised about `centre` (target frame) in units of `spread` (metres), so that turning
/// by one unit moves a typical point as far as shifting by one unit does.
#[derive(Debug, Clone)]
pub(super) struct NormalEquations {
    pub(super) centre: Point3<f64>,
    pub(super) spread: f64,
    /// `J^T W J`, rotation first: the lower triangle, row by row.
    hessian: [f64; TRIANGLE],
    /// `J^T W r`.
    gradient: [f64; 6],
    /// Sum of the weights of the pairs that have a say.
    pub(super) weight: f64,
    /// Weighted sum of squared residuals, square metres.
    pub(super) weighted_square: f64,
}

/// A symmetric 3 x 3 matrix.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Symmetric3 {
    pub(super) xx: f64,
    pub(super) xy: f64,
    pub(super) xz: f64,
    pub(super) yy: f64,
    pub(super) yz: f64,
    pub(super) zz: f64,
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

    /// The transform that makes one half of the turn, shifts, and makes the other half (Rusinkiewicz 2019, section 3):
    /// the step of residuals that were linearised half-way between the clouds.
    pub(super) fn split_about(&self, centre: &Point3<f64>) -> RigidTransform {
        // The linear step is the tangent of the half angle, and its shift stands before the cosine.
        let tangent = self.rotation.norm() / 2.0;
        let angle = tangent.atan();
        let shrink = if tangent > 0.0 { angle / (2.0 * tangent) } else { 0.5 };
        let r = self.rotation * shrink;
        let half = RigidTransform::from_increment(&Vector6::new(r.x, r.y, r.z, 0.0, 0.0, 0.0));
        RigidTransform::from_translation(centre.coords)
            * half
            * RigidTransform::from_translation(self.translation * angle.cos())
            * half
            * RigidTransform::from_translation(-centre.coords)
    }
}

impl Symmetric3 {
    pub(super) const IDENTITY: Symmetric3 =
        Symmetric3 { xx: 1.0, xy: 0.0, xz: 0.0, yy: 1.0, yz: 0.0, zz: 1.0 };

    /// The matrix times a vector.
    pub(super) fn times(&self, v: &Vector3<f64>) -> Vector3<f64> {
        Vector3::new(
            self.xx * v.x + self.xy * v.y + self.xz * v.z,
            self.xy * v.x + self.yy * v.y + self.yz * v.z,
            self.xz * v.x + self.yz * v.y + self.zz * v.z,
        )
    }

    fn columns(&self) -> [Vector3<f64>; 3] {
        [
            Vector3::new(self.xx, self.xy, self.xz),
            Vector3::new(self.xy, self.yy, self.yz),
            Vector3::new(self.xz, self.yz, self.zz),
        ]
    }
}

impl NormalEquations {
    pub(super) fn new(centre: Point3<f64>, spread: f64) -> NormalEquations {
        NormalEquations {
            centre,
            spread,
            hessian: [0.0; TRIANGLE],
            gradient: [0.0; 6],
            weight: 0.0,
            weighted_square: 0.0,
        }
    }

    /// Adds the distance `residual` of `point` (target frame) to a tangent plane with this `normal`.
    #[inline]
    pub(super) fn add_plane(
        &mut self,
        point: &Point3<f64>,
        normal: &Vector3<f64>,
        residual: f64,
        weight: f64,
    ) {
        // r(w, t) = r + n . (w x (p - c) + t) = r + ((p - c) x n) . w + n . t
        let turning = ((point - self.centre) / self.spread).cross(normal);
        let row = [turning.x, turning.y, turning.z, normal.x, normal.y, normal.z];
        let weighted = row.map(|value| value * weight);
        let mut sums = self.hessian.iter_mut();
        for (i, &left) in row.iter().enumerate() {
            for (&right, sum) in weighted[..=i].iter().zip(&mut sums) {
                *sum += left * right;
            }
        }
        for (sum, value) in self.gradient.iter_mut().zip(row) {
            *sum += value * (residual * weight);
        }
        self.weight += weight;
        self.weighted_square += weight * residual * residual;
    }

    /// Adds the difference `residual` of `point` (target frame) from its partner, measured by `metric`: the sum of
    /// squares grows by `weight * residual^T metric residual`.
    #[inline]
    pub(super) fn add_difference(
        &mut self,
        point: &Point3<f64>,
        residual: &Vector3<f64>,
        metric: &Symmetric3,
        weight: f64,
    ) {
        // r(w, t) = r + w x (p - c) + t: turning block [p - c]x M [p - c]x^T, mixed block M [p - c]x^T.
        let lever = (point - self.centre) / self.spread;
        let [a, b, c] = metric.columns().map(|column| lever.cross(&column));
        let rows =
            [Vector3::new(a.x, b.x, c.x), Vector3::new(a.y, b.y, c.y), Vector3::new(a.z, b.z, c.z)];
        let [x, y, z] = rows.map(|row| lever.cross(&row));
        let lower = [
            [x.x, 0.0, 0.0, 0.0, 0.0, 0.0],
            [y.x, y.y, 0.0, 0.0, 0.0, 0.0],
            [z.x, z.y, z.z, 0.0, 0.0, 0.0],
            [a.x, a.y, a.z, metric.xx, 0.0, 0.0],
            [b.x, b.y, b.z, metric.xy, metric.yy, 0.0],
            [c.x, c.y, c.z, metric.xz, metric.yz, metric.zz],
        ];
        let mut sums = self.hessian.iter_mut();
        for (i, row) in lower.iter().enumerate() {
            for (value, sum) in row[..=i].iter().zip(&mut sums) {
                *sum += weight * value;
            }
        }
        let pull = metric.times(residual);
        let turn = lever.cross(&pull);
        let gradient = [turn.x, turn.y, turn.z, pull.x, pull.y, pull.z];
        for (sum, value) in self.gradient.iter_mut().zip(gradient) {
            *sum += weight * value;
        }
        self.weight += weight;
        self.weighted_square += weight * residual.dot(&pull);
    }

    /// Adds the sums of other pairs about the same centre.
    pub(super) fn merge(mut self, other: &NormalEquations) -> NormalEquations {
        let sums = self.hessian.iter_mut().chain(&mut self.gradient);
        for (sum, value) in sums.zip(other.hessian.iter().chain(&other.gradient)) {
            *sum += value;
        }
        self.weight += other.weight;
        self.weighted_square += other.weighted_square;
        self
    }

    fn matrix(&self) -> Matrix6<f64> {
        Matrix6::from_fn(|i, j| {
            let (row, column) = (i.max(j), i.min(j));
            self.hessian[row * (row + 1) / 2 + column]
        })
    }

    /// The damped Gauss-Newton step; `None` if no pair has a say. `damping` is relative to the mean diagonal.
    pub(super) fn solve(&self, damping: f64) -> Option<Step> {
        let hessian = self.matrix();
        let lift = damping * hessian.trace() / 6.0;
        let damped = hessian + Matrix6::from_diagonal_element(lift);
        self.step(-damped.cholesky()?.solve(&Vector6::from(self.gradient)))
    }

    /// As [`NormalEquations::solve`], but at rest along directions whose share of what shifts show is at most `rest`:
    /// what noise says there is not followed (Zhang, Kaess and Singh 2016).
    pub(super) fn solve_determined(&self, damping: f64, rest: f64) -> Option<Step> {
        // The trace of the shifting block: of planes it is the weight.
        let limit = rest * (self.hessian[9] + self.hessian[14] + self.hessian[20]);
        let Some(eigen) = self.eigen().filter(|eigen| eigen.eigenvalues.min() <= limit) else {
            return self.solve(damping);
        };
        let gradient = Vector6::from(self.gradient);
        let determined = (0..6).filter(|&i| eigen.eigenvalues[i] > limit);
        self.step(determined.fold(Vector6::zeros(), |step, i| {
            let direction = eigen.eigenvectors.column(i);
            step - direction * (direction.dot(&gradient) / eigen.eigenvalues[i])
        }))
    }

    /// From units of the spread to radians.
    fn step(&self, step: Vector6<f64>) -> Option<Step> {
        let finite = self.weight > 0.0 && step.iter().all(|value| value.is_finite());
        finite.then(|| Step {
            rotation: Vector3::new(step[0], step[1], step[2]) / self.spread,
            translation: Vector3::new(step[3], step[4], step[5]),
        })
    }

    /// The eigenvalue up to which a direction counts as open.
    pub(super) fn open_limit(&self) -> f64 {
        OPEN_SHARE * self.weight
    }

    /// The principal directions of motion about the centre in units of the spread; `None` if a sum is not finite.
    pub(super) fn eigen(&self) -> Option<SymmetricEigen<f64, nalgebra::Const<6>>> {
        self.is_finite().then(|| self.matrix().symmetric_eigen())
    }

    /// Whether no sum has overflowed.
    pub(super) fn is_finite(&self) -> bool {
        let sums = self.hessian.iter().chain(&self.gradient);
        sums.chain([&self.weight, &self.weighted_square]).all(|value| value.is_finite())
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
        at_centre.transpose() * self.matrix() * at_centre
    }
}
