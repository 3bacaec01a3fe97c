//! The ICP family: five methods, robust kernels, trimming, schedules, and an account of what stayed open.
//!
//! Each round pairs every source point with its nearest target point (or the voxel it lies in) and makes one damped
//! Gauss-Newton step on what the method makes small, re-weighted by the kernel. The step is linearised about the
//! centroid of the source, in units of its spread, which keeps the 6 x 6 system well scaled wherever the clouds lie; a
//! direction that the surfaces leave open is reported, and not followed by the methods that would slide along it. Poses
//! are composed by `*` alone.

mod gaussian_voxels;
mod method;
mod multi_scale;
mod result;
mod run;
mod trim;

pub(super) use gaussian_voxels::GaussianVoxels;
pub use method::IcpMethod;
pub use multi_scale::MultiScaleIcp;
pub use result::{IcpResult, OpenDirection};
pub use trim::Trim;

use nalgebra::{Point3, Vector3};
use serde::{Deserialize, Serialize};

use self::run::Run;
use crate::data::RigidTransform;
use crate::error::{Error, Result};
use crate::pose::{IcpSource, IcpTarget, RobustKernel};

/// Damping relative to the mean diagonal of the scaled system: far below what moves a determined direction, far above
/// the rounding that would move an open one.
const DAMPING: f64 = 1e-9;

/// Neighbours that the source's normals are estimated from where they are needed and not given.
const NEIGHBOURS: usize = 20;

/// One stage of a coarse-to-fine schedule.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct IcpStage {
    /// Source points without a target point closer than this take no part, metres.
    pub max_distance: f64,
    /// Width of the robust kernel, metres.
    pub kernel_width: f64,
}

/// Settings of ICP on clouds of one sampling distance; see [`MultiScaleIcp`] for several.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Icp {
    /// Which distances are made small.
    pub method: IcpMethod,
    /// Shape of the robust kernel.
    pub kernel: RobustKernel,
    /// Which pairs have a say.
    pub trim: Trim,
    /// Run one after the other, coarse to fine; at least one.
    pub stages: Vec<IcpStage>,
    /// At most so many rounds in each stage.
    pub max_iterations: usize,
    /// A stage has converged when a step turns by less than this, radians, ...
    pub rotation_tolerance: f64,
    /// ... and moves the source's centroid by less than this, metres.
    pub translation_tolerance: f64,
}

impl IcpStage {
    /// # Errors
    /// `InvalidInput` unless both lengths are positive.
    pub(super) fn check(&self) -> Result<()> {
        if self.max_distance > 0.0 && self.kernel_width > 0.0 {
            return Ok(());
        }
        Err(Error::invalid(format!(
            "an icp stage has the distance {} m and the kernel width {} m, both must be positive",
            self.max_distance, self.kernel_width
        )))
    }
}

impl Icp {
    /// Point-to-plane for clouds sampled at `voxel` (metres): pairs up to three voxels apart, then two, then one and a
    /// half; Tukey kernels of the same widths; at most 30 rounds each.
    #[must_use]
    pub fn for_voxel(voxel: f64) -> Icp {
        Icp::for_method(IcpMethod::PointToPlane, voxel)
    }

    /// The schedule of [`Icp::for_voxel`] with another method.
    #[must_use]
    pub fn for_method(method: IcpMethod, voxel: f64) -> Icp {
        let stage =
            |voxels: f64| IcpStage { max_distance: voxels * voxel, kernel_width: voxels * voxel };
        Icp {
            method,
            kernel: RobustKernel::Tukey,
            trim: Trim::Off,
            stages: vec![stage(3.0), stage(2.0), stage(1.5)],
            max_iterations: 30,
            rotation_tolerance: 1e-5,
            translation_tolerance: 1e-4 * voxel,
        }
    }

    /// The textbook method: one stage of pairs up to `max_distance` (metres) apart, all with the same weight, at most
    /// 50 rounds, until a step is below 0.1 degrees and 1 mm.
    #[must_use]
    pub fn plain(method: IcpMethod, max_distance: f64) -> Icp {
        Icp {
            method,
            kernel: RobustKernel::None,
            trim: Trim::Off,
            stages: vec![IcpStage { max_distance, kernel_width: max_distance }],
            max_iterations: 50,
            rotation_tolerance: 0.1_f64.to_radians(),
            translation_tolerance: 1e-3,
        }
    }

    /// The same with all lengths multiplied by `factor`.
    #[must_use]
    pub fn scaled(&self, factor: f64) -> Icp {
        let scale = |stage: &IcpStage| IcpStage {
            max_distance: stage.max_distance * factor,
            kernel_width: stage.kernel_width * factor,
        };
        Icp {
            stages: self.stages.iter().map(scale).collect(),
            translation_tolerance: self.translation_tolerance * factor,
            ..self.clone()
        }
    }

    /// Moves `source` (metres) onto `target` from the start pose `initial`. Points that are not finite take no part.
    /// Where the method needs normals of the source, they are estimated from 20 neighbours; to align one source more
    /// than once, prepare it and use [`Icp::align_prepared`].
    ///
    /// # Errors
    /// `InvalidInput` if there is no finite source point, a setting is not positive or the target lacks the voxels of
    /// its method; `NoPose` if no source point comes close to the target or no pair has a say.
    pub fn align(
        &self,
        source: &[Point3<f64>],
        target: &IcpTarget,
        initial: &RigidTransform,
    ) -> Result<IcpResult> {
        if self.method.needs_source_normals() && !source.is_empty() {
            let source = IcpSource::with_estimated_normals(source.to_vec(), NEIGHBOURS)?;
            return self.align_prepared(&source, target, initial);
        }
        self.run(source, &[], target, initial)
    }

    /// As [`Icp::align`], with a source whose normals are known.
    ///
    /// # Errors
    /// As [`Icp::align`].
    pub fn align_prepared(
        &self,
        source: &IcpSource,
        target: &IcpTarget,
        initial: &RigidTransform,
    ) -> Result<IcpResult> {
        self.run(source.points(), source.normals(), target, initial)
    }

    fn run(
        &self,
        points: &[Point3<f64>],
        normals: &[Vector3<f64>],
        target: &IcpTarget,
        initial: &RigidTransform,
    ) -> Result<IcpResult> {
        let last = self.validated_last_stage(target)?;
        let mut run = Run::new(self, points, normals, target);
        if run.extent.finite == 0 {
            return Err(Error::invalid("icp was given no source points that are finite"));
        }
        let mut pose = *initial;
        let (mut iterations, mut converged) = (Vec::new(), false);
        for stage in &self.stages {
            let rounds;
            (pose, rounds, converged) = self.run_stage(&mut run, pose, stage);
            iterations.push(rounds);
        }
        let result = evaluate(&mut run, pose, &last)?;
        Ok(IcpResult { iterations, converged, ..result })
    }

    /// Steps until one is small; the pose, the number of steps, and whether the last one was small.
    fn run_stage(
        &self,
        run: &mut Run<'_>,
        mut pose: RigidTransform,
        stage: &IcpStage,
    ) -> (RigidTransform, usize, bool) {
        for round in 0..self.max_iterations {
            let equations = run.round(&pose, stage);
            let Some(step) = self.method.step(&equations, DAMPING) else {
                return (pose, round, false);
            };
            pose = match self.method {
                IcpMethod::Symmetric => step.split_about(&equations.centre) * pose,
                _ => step.about(&equations.centre) * pose,
            };
            if step.rotation.norm() < self.rotation_tolerance
                && step.translation.norm() < self.translation_tolerance
            {
                return (pose, round + 1, true);
            }
        }
        (pose, self.max_iterations, false)
    }

    fn validated_last_stage(&self, target: &IcpTarget) -> Result<IcpStage> {
        if self.method == IcpMethod::VoxelisedGeneralised && target.voxels().is_none() {
            return Err(Error::invalid(
                "voxelised generalised icp was given a target without voxels: prepare it by IcpTarget::with_voxels",
            ));
        }
        if let Trim::Overlap(share) = self.trim
            && !(share > 0.0 && share <= 1.0)
        {
            return Err(Error::invalid(format!(
                "the overlap that icp trims to is {share}, it must be above 0 and at most 1"
            )));
        }
        self.stages.iter().try_for_each(IcpStage::check)?;
        self.stages.last().copied().ok_or_else(|| Error::invalid("icp was given no stages"))
    }
}

/// The evidence at a pose.
fn evaluate(run: &mut Run<'_>, pose: RigidTransform, last: &IcpStage) -> Result<IcpResult> {
    let own = run.round(&pose, last);
    let fit = run.fit();
    if own.weight <= 0.0 || fit.matched == 0 {
        return Err(Error::no_pose(format!(
            "no source point lies within {} m of a target point that icp can use (one with a normal, if the method needs it)",
            last.max_distance
        )));
    }
    let planes = run.sums(IcpMethod::PointToPlane, &pose, last, fit.limit);
    let surface = if planes.weight > 0.0 {
        planes
    } else {
        run.sums(IcpMethod::PointToPoint, &pose, last, fit.limit)
    };
    if !(own.is_finite() && surface.is_finite()) {
        return Err(Error::no_pose("the coordinates of the clouds are too large to be squared"));
    }
    let count = run.extent.finite as f64;
    Ok(IcpResult {
        target_from_source: pose,
        fitness: fit.matched as f64 / count,
        inlier_rmse: (fit.squared_distance / fit.matched as f64).sqrt(),
        overlap: fit.kept as f64 / count,
        residual_rmse: (own.weighted_square / own.weight).sqrt(),
        iterations: Vec::new(),
        converged: false,
        open_directions: result::open_directions(&surface),
        information: surface.information(),
    })
}

#[cfg(test)]
mod tests;
