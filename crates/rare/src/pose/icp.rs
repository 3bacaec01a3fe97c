//! Point-to-plane ICP with a robust kernel (Chen and Medioni 1991; kernels after Huber, Tukey and others).
//!
//! Each round pairs every source point with its nearest target point and makes one damped Gauss-Newton step on the
//! distances to the target's tangent planes, re-weighted by the kernel. The step is linearised about the centroid of
//! the matched points, in units of their spread, which keeps the 6 x 6 system well scaled wherever the clouds lie; a
//! direction that the surfaces leave open is damped to rest and reported. Poses are composed by `*` alone.

use nalgebra::{Matrix6, Point3, Vector3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::data::RigidTransform;
use crate::error::{Error, Result};
use crate::pose::normal_equations::NormalEquations;
use crate::pose::{IcpTarget, RobustKernel};

/// Points per unit of parallel work; independent of the number of threads, so that sums are too.
const CHUNK: usize = 1024;

/// Damping relative to the mean diagonal of the scaled system: far below what moves a determined direction, far above
/// the rounding that would move an open one.
const DAMPING: f64 = 1e-9;

/// One stage of a coarse-to-fine schedule.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct IcpStage {
    /// Source points without a target point closer than this take no part, metres.
    pub max_distance: f64,
    /// Width of the robust kernel, metres.
    pub kernel_width: f64,
}

/// Settings of point-to-plane ICP.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Icp {
    /// Shape of the robust kernel.
    pub kernel: RobustKernel,
    /// Run one after the other, coarse to fine; at least one.
    pub stages: Vec<IcpStage>,
    /// At most so many rounds in each stage.
    pub max_iterations: usize,
    /// A stage has converged when a step turns by less than this, radians, ...
    pub rotation_tolerance: f64,
    /// ... and moves the matched points' centroid by less than this, metres.
    pub translation_tolerance: f64,
}

impl Icp {
    /// The schedule for clouds sampled at `voxel` (metres): pairs up to three voxels apart, then two, then one and a
    /// half; Tukey kernels of the same widths; at most 30 rounds each.
    #[must_use]
    pub fn for_voxel(voxel: f64) -> Icp {
        let stage =
            |voxels: f64| IcpStage { max_distance: voxels * voxel, kernel_width: voxels * voxel };
        Icp {
            kernel: RobustKernel::Tukey,
            stages: vec![stage(3.0), stage(2.0), stage(1.5)],
            max_iterations: 30,
            rotation_tolerance: 1e-5,
            translation_tolerance: 1e-4 * voxel,
        }
    }
}

/// An aligned pose and its evidence, all evaluated at exactly this pose with the last stage's settings.
#[derive(Debug, Clone, PartialEq)]
pub struct IcpResult {
    /// Moves points of the source into the target's frame.
    pub target_from_source: RigidTransform,
    /// Share of the source points with a target point closer than the last stage's distance, 0 to 1.
    pub fitness: f64,
    /// Root mean square distance of those points to their nearest target points, metres.
    pub inlier_rmse: f64,
    /// Root of the kernel-weighted mean square distance to the tangent planes, metres.
    pub plane_rmse: f64,
    /// Rounds made over all stages.
    pub iterations: usize,
    /// Whether the last stage ended because the step was small.
    pub converged: bool,
    /// How many of the six directions of motion the surfaces leave (nearly) open: 3 for a single plane.
    pub open_directions: usize,
    /// `J^T W J` of the plane distances for a left increment `[rotation vector, translation]` at the origin of the
    /// target's frame. Divided by the variance of the residuals it is the inverse covariance of the pose.
    pub information: Matrix6<f64>,
}

impl Icp {
    /// Moves `source` (metres) onto `target` from the start pose `initial`.
    ///
    /// # Errors
    /// `InvalidInput` if there is no source point or a setting is not positive; `NoPose` if no source point comes
    /// close to the target or no pair has a say.
    pub fn align(
        &self,
        source: &[Point3<f64>],
        target: &IcpTarget,
        initial: &RigidTransform,
    ) -> Result<IcpResult> {
        let last = self.validated_last_stage(source)?;
        let mut run = Run::new(self.kernel, source, target);
        let mut pose = *initial;
        let (mut iterations, mut converged) = (0, false);
        for stage in &self.stages {
            let rounds;
            (pose, rounds, converged) = self.run_stage(&mut run, pose, stage);
            iterations += rounds;
        }
        let at_end = run.linearise(&pose, &last);
        if at_end.weight <= 0.0 {
            return Err(Error::no_pose(format!(
                "no source point lies within {} m of a target point with a normal after {iterations} rounds of icp",
                last.max_distance
            )));
        }
        Ok(IcpResult {
            target_from_source: pose,
            fitness: at_end.matched as f64 / source.len() as f64,
            inlier_rmse: (at_end.squared_distance / at_end.matched as f64).sqrt(),
            plane_rmse: (at_end.weighted_plane_error / at_end.weight).sqrt(),
            iterations,
            converged,
            open_directions: at_end.open_directions(),
            information: at_end.information(),
        })
    }

    /// Steps until one is small; the pose, the number of steps, and whether the last one was small.
    fn run_stage(
        &self,
        run: &mut Run,
        mut pose: RigidTransform,
        stage: &IcpStage,
    ) -> (RigidTransform, usize, bool) {
        for round in 0..self.max_iterations {
            let equations = run.linearise(&pose, stage);
            let Some(step) = equations.solve(DAMPING) else { return (pose, round, false) };
            pose = step.about(&equations.centre) * pose;
            if step.rotation.norm() < self.rotation_tolerance
                && step.translation.norm() < self.translation_tolerance
            {
                return (pose, round + 1, true);
            }
        }
        (pose, self.max_iterations, false)
    }

    fn validated_last_stage(&self, source: &[Point3<f64>]) -> Result<IcpStage> {
        if source.is_empty() {
            return Err(Error::invalid("icp was given no source points"));
        }
        for stage in &self.stages {
            if !(stage.max_distance > 0.0 && stage.kernel_width > 0.0) {
                return Err(Error::invalid(format!(
                    "an icp stage has the distance {} m and the kernel width {} m, both must be positive",
                    stage.max_distance, stage.kernel_width
                )));
            }
        }
        self.stages.last().copied().ok_or_else(|| Error::invalid("icp was given no stages"))
    }
}

/// What one alignment carries from round to round.
struct Run<'a> {
    kernel: RobustKernel,
    source: &'a [Point3<f64>],
    target: &'a IcpTarget,
    centroid: Point3<f64>,
    spread: f64,
    /// The target point that each source point was matched with last: a good first guess of the next one.
    guesses: Vec<u32>,
}

impl<'a> Run<'a> {
    fn new(kernel: RobustKernel, source: &'a [Point3<f64>], target: &'a IcpTarget) -> Run<'a> {
        let count = source.len() as f64;
        let centroid = Point3::from(source.iter().map(|p| p.coords).sum::<Vector3<f64>>() / count);
        let square = source.iter().map(|p| (p - centroid).norm_squared()).sum::<f64>() / count;
        // One point, or copies of it, have no spread: any unit will do.
        let spread = if square > 0.0 { square.sqrt() } else { 1.0 };
        Run { kernel, source, target, centroid, spread, guesses: vec![0; source.len()] }
    }

    /// Matches all points under `pose` and sums up their equations, chunk by chunk in fixed order.
    fn linearise(&mut self, pose: &RigidTransform, stage: &IcpStage) -> NormalEquations {
        let empty = NormalEquations::new(pose.apply(&self.centroid), self.spread);
        let (kernel, target) = (self.kernel, self.target);
        let sums: Vec<NormalEquations> = (self.source.par_chunks(CHUNK))
            .zip(self.guesses.par_chunks_mut(CHUNK))
            .map(|(points, guesses)| {
                let mut sums = empty.clone();
                for (point, guess) in points.iter().zip(guesses) {
                    let moved = pose.apply(point);
                    if let Some(found) = target.closest(&moved, *guess, stage.max_distance) {
                        *guess = found.index as u32;
                        target.add_pair(&mut sums, &moved, found, kernel, stage.kernel_width);
                    }
                }
                sums
            })
            .collect();
        sums.iter().fold(empty, NormalEquations::merge)
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Rotation3;

    use super::*;
    use crate::data::KdTree;
    use crate::features::estimate_normals;
    use crate::random::Random;

    /// A floor, two walls and a ball: every motion is determined.
    fn room(seed: u64, count: usize) -> Vec<Point3<f64>> {
        let mut random = Random::new(seed, 0);
        let mut point = |kind: usize| {
            let (a, b) = (4.0 * random.uniform(), 3.0 * random.uniform());
            match kind % 4 {
                0 => Point3::new(a, b, 0.0),
                1 => Point3::new(a, 0.0, b),
                2 => Point3::new(0.0, b, a * 0.7),
                _ => {
                    let direction = Vector3::from([0; 3].map(|_| random.normal())).normalize();
                    Point3::new(2.0, 1.5, 1.0) + direction * 0.5
                }
            }
        };
        (0..count).map(&mut point).collect()
    }

    fn target(points: Vec<Point3<f64>>) -> IcpTarget {
        let normals = estimate_normals(&points, &KdTree::new(&points), 0.2, 30);
        IcpTarget::new(points, normals).unwrap()
    }

    fn motion() -> RigidTransform {
        RigidTransform::new(
            Rotation3::new(Vector3::new(0.03, -0.05, 0.04)),
            Vector3::new(0.08, -0.05, 0.06),
        )
    }

    #[test]
    fn a_known_motion_is_recovered_and_the_claims_hold() {
        let truth = motion();
        let back = truth.inverse();
        let source: Vec<_> = room(1, 4000).iter().map(|point| back.apply(point)).collect();
        let target = target(room(2, 20_000));
        for kernel in [
            RobustKernel::Tukey,
            RobustKernel::Huber,
            RobustKernel::Cauchy,
            RobustKernel::GemanMcClure,
        ] {
            let icp = Icp { kernel, ..Icp::for_voxel(0.1) };
            let result = icp.align(&source, &target, &RigidTransform::identity()).unwrap();
            let error = result.target_from_source.error_to(&truth);
            assert!(
                error.rotation_degrees < 0.02 && error.translation < 5e-4,
                "{kernel:?} {error:?}"
            );
            assert!(result.converged && result.open_directions == 0 && result.fitness > 0.99);

            let squares: Vec<f64> = source
                .iter()
                .map(|point| result.target_from_source.apply(point))
                .filter_map(|moved| target.tree().nearest_within(&moved, 0.15))
                .map(|found| found.squared_distance)
                .collect();
            assert_eq!(result.fitness, squares.len() as f64 / 4000.0);
            let rmse = (squares.iter().sum::<f64>() / squares.len() as f64).sqrt();
            assert!((rmse - result.inlier_rmse).abs() < 1e-12);
        }
    }

    #[test]
    fn wrong_points_do_not_pull_a_tukey_kernel() {
        let truth = motion();
        let mut source: Vec<_> = room(1, 3000).iter().map(|p| truth.inverse().apply(p)).collect();
        // A cabinet that the target never saw, 20 cm in front of a wall.
        source.extend((0..400).map(|i| {
            let (y, z) = (f64::from(i % 20) * 0.06, f64::from(i / 20) * 0.06);
            truth.inverse().apply(&Point3::new(0.2, y, z))
        }));
        let target = target(room(2, 20_000));
        let result = Icp::for_voxel(0.1).align(&source, &target, &RigidTransform::identity());
        let error = result.unwrap().target_from_source.error_to(&truth);
        assert!(error.rotation_degrees < 0.2 && error.translation < 0.01, "{error:?}");
    }

    #[test]
    fn the_information_is_the_curvature_of_the_plane_error() {
        let target = target(room(2, 5000));
        let source = room(2, 500);
        let stage = IcpStage { max_distance: 0.5, kernel_width: 1e6 };
        let icp = Icp { stages: vec![stage], max_iterations: 0, ..Icp::for_voxel(0.1) };
        let information =
            icp.align(&source, &target, &RigidTransform::identity()).unwrap().information;
        let twist = nalgebra::Vector6::new(2e-5, -1e-5, 3e-5, 1e-5, 2e-5, -4e-5);
        let moved = RigidTransform::from_increment(&twist);
        let result = icp.align(&source, &target, &moved).unwrap();
        let error = result.plane_rmse.powi(2) * source.len() as f64;
        let predicted = twist.dot(&(information * twist));
        assert!((error / predicted - 1.0).abs() < 1e-3, "{error} {predicted}");
    }

    #[test]
    fn a_single_plane_is_reported_and_does_not_run_away() {
        let plane: Vec<_> = (0..2500)
            .map(|i| Point3::new(f64::from(i % 50) * 0.1 + 700.0, f64::from(i / 50) * 0.1, 0.0))
            .collect();
        let start = RigidTransform::from_translation(Vector3::new(0.0, 0.0, 0.05));
        let target = IcpTarget::new(plane.clone(), vec![Vector3::z(); 2500]).unwrap();
        let result = Icp::for_voxel(0.1).align(&plane, &target, &start).unwrap();
        assert_eq!(result.open_directions, 3);
        let error = result.target_from_source.error_to(&RigidTransform::identity());
        assert!(error.rotation_degrees < 1e-6 && error.translation < 1e-6, "{error:?}");
    }

    #[test]
    fn what_cannot_be_aligned_is_an_error() {
        let target = target(room(2, 1000));
        let far = [Point3::new(100.0, 0.0, 0.0)];
        let icp = Icp::for_voxel(0.1);
        let identity = RigidTransform::identity();
        let unstaged = Icp { stages: Vec::new(), ..icp.clone() };
        for (icp, source, word) in [
            (&icp, &far[..], "within 0.15"),
            (&icp, &[], "no source points"),
            (&unstaged, &far, "no stages"),
            (&Icp::for_voxel(-1.0), &far, "positive"),
        ] {
            let message = icp.align(source, &target, &identity).unwrap_err().to_string();
            assert!(message.contains(word), "{message}");
        }
        assert!(IcpTarget::new(far.to_vec(), Vec::new()).is_err());
        assert!(icp.align(&target.points()[..1], &target, &identity).is_ok());
    }

    #[test]
    fn the_number_of_threads_does_not_show() {
        let target = target(room(2, 5000));
        let source = room(1, 5000);
        let align = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| Icp::for_voxel(0.1).align(&source, &target, &motion()).unwrap())
        };
        assert_eq!(align(1), align(2));
    }
}
