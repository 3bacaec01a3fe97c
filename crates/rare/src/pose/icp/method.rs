//! What one matched pair says, method by method.

use nalgebra::{Point3, Vector3};
use serde::{Deserialize, Serialize};

use crate::pose::RobustKernel;
use crate::pose::normal_equations::{NormalEquations, OPEN_SHARE, Step, Symmetric3};

/// Variance of a surface point across its surface, where its variance along the surface is 1 (Segal et al. 2009).
const THICKNESS: f64 = 1e-3;

/// Which distances ICP makes small.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum IcpMethod {
    /// Between matched points (Besl 1992). Needs no normals.
    PointToPoint,
    /// From the source points to the target's tangent planes (Chen and Medioni 1991). Needs the target's normals.
    PointToPlane,
    /// Across the mean of both points' normals, linearised half-way between the clouds (Rusinkiewicz 2019). Needs both
    /// clouds' normals.
    Symmetric,
    /// Between matched points, in units of both points' covariances: flat ones across their normals, with the
    /// variances 0.001, 1 and 1 (Segal et al. 2009). Needs both clouds' normals; a point without one has the same
    /// variance in all directions.
    Generalised,
    /// As `Generalised`, against the mean and the mean covariance of the target points in one voxel (Koide et al.
    /// 2021): the voxel that the source point lies in, so that no neighbour is sought. Needs
    /// [`crate::pose::IcpTarget::with_voxels`].
    VoxelisedGeneralised,
}

/// A source point under the current pose and its partner, all in the target's frame.
#[derive(Debug, Clone, Copy)]
pub(super) struct Pair {
    pub(super) moved: Point3<f64>,
    pub(super) target: Point3<f64>,
    /// The source point's normal, turned; zero where there is none or it is not needed.
    pub(super) moved_normal: Vector3<f64>,
    pub(super) target_normal: Vector3<f64>,
}

impl IcpMethod {
    /// Whether the source needs normals.
    pub(super) fn needs_source_normals(self) -> bool {
        !matches!(self, IcpMethod::PointToPoint | IcpMethod::PointToPlane)
    }

    /// The next step, damped relative to the mean diagonal of the system; `None` if no pair has a say.
    pub(super) fn step(self, sums: &NormalEquations, damping: f64) -> Option<Step> {
        match self {
            IcpMethod::PointToPoint => sums.solve(damping),
            IcpMethod::PointToPlane | IcpMethod::Symmetric => {
                sums.solve_determined(damping, OPEN_SHARE)
            }
            // Flat covariances pull along the surface too, with the weight of their thickness.
            _ => sums.solve_determined(damping, OPEN_SHARE + 2.0 * THICKNESS),
        }
    }

    /// Adds what `pair` says under a kernel of this width (metres) to the sums.
    #[inline]
    pub(super) fn add(
        self,
        sums: &mut NormalEquations,
        pair: &Pair,
        kernel: RobustKernel,
        width: f64,
    ) {
        match self {
            IcpMethod::PointToPoint => {
                let metric = Symmetric3::IDENTITY;
                add_difference(sums, &pair.moved, &pair.target, &metric, kernel, width);
            }
            IcpMethod::PointToPlane => {
                let normal = pair.target_normal;
                add_plane(sums, &pair.moved, pair, &normal, kernel, width);
            }
            IcpMethod::Symmetric => {
                let middle = nalgebra::center(&pair.moved, &pair.target);
                add_plane(sums, &middle, pair, &pair.mean_normal(), kernel, width);
            }
            IcpMethod::Generalised | IcpMethod::VoxelisedGeneralised => {
                let metric = plane_to_plane(&pair.target_normal, &pair.moved_normal);
                add_difference(sums, &pair.moved, &pair.target, &metric, kernel, width);
            }
        }
    }
}

impl Pair {
    /// Half the sum of the normals, whose signs are arbitrary; zero unless both are known.
    fn mean_normal(&self) -> Vector3<f64> {
        let (a, b) = (self.moved_normal, self.target_normal);
        if a == Vector3::zeros() || b == Vector3::zeros() {
            return Vector3::zeros();
        }
        if a.dot(&b) < 0.0 { (b - a) * 0.5 } else { (b + a) * 0.5 }
    }
}

#[inline]
fn add_plane(
    sums: &mut NormalEquations,
    at: &Point3<f64>,
    pair: &Pair,
    normal: &Vector3<f64>,
    kernel: RobustKernel,
    width: f64,
) {
    let residual = (pair.moved - pair.target).dot(normal);
    let weight = kernel.weight(residual, width);
    if weight > 0.0 && *normal != Vector3::zeros() {
        sums.add_plane(at, normal, residual, weight);
    }
}

/// Adds the difference between two points under a metric whose largest eigenvalue is about 1, so that kernel widths
/// are metres.
#[inline]
pub(super) fn add_difference(
    sums: &mut NormalEquations,
    moved: &Point3<f64>,
    target: &Point3<f64>,
    metric: &Symmetric3,
    kernel: RobustKernel,
    width: f64,
) {
    let residual = moved - target;
    let square = residual.dot(&metric.times(&residual));
    let weight = kernel.weight(square.max(0.0).sqrt(), width);
    if weight > 0.0 {
        sums.add_difference(moved, &residual, metric, weight);
    }
}

/// `2 THICKNESS (A + B)^-1`, where `A = I - (1 - THICKNESS) n n^T` is the covariance of a surface across `n` and `B`
/// that across `m`; for equal normals 1 across and `THICKNESS` along the surface. By the Woodbury identity.
#[inline]
fn plane_to_plane(n: &Vector3<f64>, m: &Vector3<f64>) -> Symmetric3 {
    const K: f64 = 2.0 / (1.0 - THICKNESS);
    let (a, b, c) = (K - m.norm_squared(), K - n.norm_squared(), n.dot(m));
    let factor = THICKNESS / (a * b - c * c);
    let (a, b, c) = (a * factor, b * factor, c * factor);
    let entry =
        |i: usize, j: usize| a * n[i] * n[j] + b * m[i] * m[j] + c * (n[i] * m[j] + m[i] * n[j]);
    Symmetric3 {
        xx: entry(0, 0) + THICKNESS,
        xy: entry(0, 1),
        xz: entry(0, 2),
        yy: entry(1, 1) + THICKNESS,
        yz: entry(1, 2),
        zz: entry(2, 2) + THICKNESS,
    }
}

/// As [`plane_to_plane`], where `A` is a mean of such covariances.
#[inline]
pub(super) fn voxel_to_plane(covariance: &Symmetric3, m: &Vector3<f64>) -> Symmetric3 {
    let c = covariance;
    let flat = 1.0 - THICKNESS;
    let sum = Symmetric3 {
        xx: c.xx + 1.0 - flat * m.x * m.x,
        xy: c.xy - flat * m.x * m.y,
        xz: c.xz - flat * m.x * m.z,
        yy: c.yy + 1.0 - flat * m.y * m.y,
        yz: c.yz - flat * m.y * m.z,
        zz: c.zz + 1.0 - flat * m.z * m.z,
    };
    // The cofactors over the determinant; the eigenvalues of the sum lie between 2 THICKNESS and 2.
    let xx = sum.yy * sum.zz - sum.yz * sum.yz;
    let xy = sum.xz * sum.yz - sum.xy * sum.zz;
    let xz = sum.xy * sum.yz - sum.xz * sum.yy;
    let scale = 2.0 * THICKNESS / (sum.xx * xx + sum.xy * xy + sum.xz * xz);
    Symmetric3 {
        xx: xx * scale,
        xy: xy * scale,
        xz: xz * scale,
        yy: (sum.xx * sum.zz - sum.xz * sum.xz) * scale,
        yz: (sum.xy * sum.xz - sum.xx * sum.yz) * scale,
        zz: (sum.xx * sum.yy - sum.xy * sum.xy) * scale,
    }
}

/// The covariance of a surface across the unit normal `n`, or the identity for a zero `n`.
pub(super) fn covariance_across(n: &Vector3<f64>) -> Symmetric3 {
    let flat = 1.0 - THICKNESS;
    Symmetric3 {
        xx: 1.0 - flat * n.x * n.x,
        xy: -flat * n.x * n.y,
        xz: -flat * n.x * n.z,
        yy: 1.0 - flat * n.y * n.y,
        yz: -flat * n.y * n.z,
        zz: 1.0 - flat * n.z * n.z,
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Matrix3;

    use super::*;

    fn dense(m: &Symmetric3) -> Matrix3<f64> {
        Matrix3::new(m.xx, m.xy, m.xz, m.xy, m.yy, m.yz, m.xz, m.yz, m.zz)
    }

    #[test]
    fn both_metrics_are_the_inverse_of_the_summed_covariances() {
        let normals = [
            Vector3::zeros(),
            Vector3::z(),
            Vector3::new(1.0, 2.0, -2.0) / 3.0,
            Vector3::new(-6.0, 2.0, 3.0) / 7.0,
        ];
        for n in &normals {
            for m in &normals {
                let sum = dense(&covariance_across(n)) + dense(&covariance_across(m));
                let expected = sum.try_inverse().unwrap() * (2.0 * THICKNESS);
                for metric in [plane_to_plane(n, m), voxel_to_plane(&covariance_across(n), m)] {
                    assert!((dense(&metric) - expected).amax() < 1e-12, "{n} {m}");
                }
            }
        }
    }
}
