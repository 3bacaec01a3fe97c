//! Symmetric robust ICP that correspondences hold where the surfaces slide.
//!
//! Where two clouds share little more than a floor or a table, surfaces fit as well after they slid along one another.
//! A few dozen matched features, the anchors, say where along. Both clouds are matched against each other, so that
//! neither one's density or extent decides; a pair pulls across the mean of its two normals (Rusinkiewicz 2019), an
//! anchor pulls in all directions. All anchors together weigh a fixed share of all surface pairs, however many there
//! are of either: what the surfaces determine they determine far better than features do, and the rest is theirs alone.

mod held;
mod surfaces;

use nalgebra::{Point3, Vector3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use self::held::HeldAnchors;
use self::surfaces::{SurfacePair, Surfaces};
use crate::data::{Correspondence, RigidTransform};
use crate::error::{Error, Result};
use crate::pose::normal_equations::{NormalEquations, OPEN_SHARE, Step};
use crate::pose::partners::CHUNK;
use crate::pose::{IcpStage, IcpTarget};

/// How far apart the rings of a rotating scanner may lie, in voxels.
pub(crate) const RING_REACH: f64 = 6.0;
/// Damping relative to the mean diagonal of the scaled system: far below what moves a determined direction, far above
/// the rounding that would move an open one.
const DAMPING: f64 = 1e-9;

/// Settings of symmetric robust ICP between two clouds that correspondences hold in place.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct AnchoredIcp {
    /// Run one after the other, coarse to fine; at least one. The kernel is Tukey's, of the distance of two points.
    pub stages: Vec<IcpStage>,
    /// At most so many rounds in each stage.
    pub max_iterations: usize,
    /// A stage has converged when a step turns by less than this, radians, ...
    pub rotation_tolerance: f64,
    /// ... and moves the centroid of the pairs by less than this, metres.
    pub translation_tolerance: f64,
    /// Weight of all anchors together relative to that of all surface pairs together; 0 ignores the anchors. However
    /// small it is, a direction that no surface shows is held by the anchors alone.
    pub anchor_weight: f64,
    /// Width of the anchors' Tukey kernel, metres: anchors that are further off have no say.
    pub anchor_width: f64,
}

/// What [`AnchoredIcp`] found.
#[derive(Debug, Clone, PartialEq)]
pub struct AnchoredIcpResult {
    /// Moves points of the source into the target's frame.
    pub target_from_source: RigidTransform,
    /// Surface pairs that have a say at the pose in the last stage, counted from both clouds; at least 1.
    pub pairs: usize,
    /// Anchors that have a say at the pose; 0 if they were ignored.
    pub anchors: usize,
    /// Steps made in each stage.
    pub iterations: Vec<usize>,
    /// Whether the last stage came to rest.
    pub converged: bool,
}

impl AnchoredIcp {
    /// For clouds sampled at `voxel` (metres): pairs up to three voxels apart, then one and a half, then one; Tukey
    /// kernels of the same widths; at most 10 rounds each; anchors up to four voxels off, a tenth of all weight.
    #[must_use]
    pub fn for_voxel(voxel: f64) -> AnchoredIcp {
        let stage =
            |voxels: f64| IcpStage { max_distance: voxels * voxel, kernel_width: voxels * voxel };
        AnchoredIcp {
            stages: vec![stage(3.0), stage(1.5), stage(1.0)],
            max_iterations: 10,
            rotation_tolerance: 1e-4,
            translation_tolerance: 0.002 * voxel,
            anchor_weight: 0.1,
            anchor_width: 4.0 * voxel,
        }
    }

    /// For scans of a rotating scanner, sampled at `voxel` (metres). Its rings lie metres apart, and so do the points of
    /// one and the same road: pairs up to six voxels apart, with a Tukey kernel of that width; else like
    /// [`AnchoredIcp::for_voxel`].
    #[must_use]
    pub fn for_rotating_scanner(voxel: f64) -> AnchoredIcp {
        let reach = RING_REACH * voxel;
        AnchoredIcp {
            stages: vec![IcpStage { max_distance: reach, kernel_width: reach }],
            max_iterations: 30,
            ..AnchoredIcp::for_voxel(voxel)
        }
    }

    /// Moves `source` onto `target` (metres, either sign of the normals) from the start pose `initial`. The points of
    /// the source with the indices `source_sample` seek their nearest target points, and those of the target with
    /// `target_sample` their nearest source points; one of the two may be empty. Pairs whose normals are more than 60
    /// degrees apart, points without a normal and points that are not finite take no part. `anchors` pull at
    /// their points whatever their scores, unless their weights under the kernel sum up to less than 5; then, or if
    /// `anchor_weight` is 0, directions that the surfaces leave open stay as they are.
    ///
    /// # Errors
    /// `InvalidInput` if a setting makes no sense, an index lies beyond its cloud or no sampled point is finite;
    /// `NoPose` if no pair of surface points is found.
    pub fn align(
        &self,
        source: &IcpTarget,
        target: &IcpTarget,
        source_sample: &[usize],
        target_sample: &[usize],
        anchors: &[Correspondence],
        initial: &RigidTransform,
    ) -> Result<AnchoredIcpResult> {
        let last = self.validated_last_stage()?;
        let mut surfaces = Surfaces::new(source, target, source_sample, target_sample)?;
        let mut pose = *initial;
        let (mut iterations, mut converged) = (Vec::new(), false);
        for stage in &self.stages {
            let rounds;
            (pose, rounds, converged) = self.run_stage(&mut surfaces, anchors, pose, stage);
            iterations.push(rounds);
        }
        let pairs = surfaces.pairs(&pose, &last);
        ensure_support(&pairs, &last)?;
        let anchors = self.held(anchors, &pose).map_or(0, |held| held.len());
        let pairs = pairs.len();
        Ok(AnchoredIcpResult { target_from_source: pose, pairs, anchors, iterations, converged })
    }

    /// Steps until one is small; the pose, the number of steps, and whether the last one was small.
    fn run_stage(
        &self,
        surfaces: &mut Surfaces<'_>,
        anchors: &[Correspondence],
        mut pose: RigidTransform,
        stage: &IcpStage,
    ) -> (RigidTransform, usize, bool) {
        for round in 0..self.max_iterations {
            let pairs = surfaces.pairs(&pose, stage);
            let Some((step, centre)) = self.step(&pairs, anchors, &pose) else {
                return (pose, round, false);
            };
            pose = step.about(&centre) * pose;
            if step.rotation.norm() < self.rotation_tolerance
                && step.translation.norm() < self.translation_tolerance
            {
                return (pose, round + 1, true);
            }
        }
        (pose, self.max_iterations, false)
    }

    /// The next step and the centre that it turns about; `None` if no pair has a say.
    fn step(
        &self,
        pairs: &[SurfacePair],
        anchors: &[Correspondence],
        pose: &RigidTransform,
    ) -> Option<(Step, Point3<f64>)> {
        let mut sums = surface_sums(pairs)?;
        let step = match self.held(anchors, pose) {
            Some(held) => {
                held.add_to(&mut sums, self.anchor_weight);
                sums.solve(DAMPING)
            }
            // Nothing holds what the surfaces leave open, and what noise says there is not followed.
            None => sums.solve_determined(DAMPING, OPEN_SHARE),
        };
        step.map(|step| (step, sums.centre))
    }

    /// The anchors that have a say at `pose`; `None` if they are ignored.
    fn held(&self, anchors: &[Correspondence], pose: &RigidTransform) -> Option<HeldAnchors> {
        let asked = self.anchor_weight > 0.0;
        asked.then(|| HeldAnchors::at(pose, anchors, self.anchor_width)).flatten()
    }

    fn validated_last_stage(&self) -> Result<IcpStage> {
        let (turn, shift) = (self.rotation_tolerance, self.translation_tolerance);
        let (weight, width) = (self.anchor_weight, self.anchor_width);
        for (what, value, makes_sense) in [
            ("rotation tolerance", turn, turn >= 0.0),
            ("translation tolerance", shift, shift >= 0.0),
            ("anchor weight", weight, (0.0..f64::INFINITY).contains(&weight)),
            ("anchor width", width, width > 0.0),
        ] {
            if !makes_sense {
                return Err(Error::invalid(format!(
                    "the {what} of anchored icp is {value}: the width must be positive, the weight finite and at least 0, the tolerances at least 0"
                )));
            }
        }
        self.stages.iter().try_for_each(IcpStage::check)?;
        self.stages
            .last()
            .copied()
            .ok_or_else(|| Error::invalid("anchored icp was given no stages"))
    }
}

/// # Errors
/// `NoPose` if there is no pair or a sum over them overflows.
fn ensure_support(pairs: &[SurfacePair], last: &IcpStage) -> Result<()> {
    let Some(sums) = surface_sums(pairs) else {
        return Err(Error::no_pose(format!(
            "no sampled point lies within {} m of a point of the other cloud with a normal less than 60 degrees off",
            last.max_distance.min(last.kernel_width)
        )));
    };
    if !(sums.is_finite() && sums.spread.is_finite()) {
        return Err(Error::no_pose("the coordinates of the clouds are too large to be squared"));
    }
    Ok(())
}

/// Sums up what the pairs say, linearised about their weighted centroid, chunk by chunk in fixed order; `None` if there
/// is no pair.
fn surface_sums(pairs: &[SurfacePair]) -> Option<NormalEquations> {
    let weight: f64 = pairs.iter().map(|pair| pair.weight).sum();
    let moment: Vector3<f64> = pairs.iter().map(|pair| pair.point.coords * pair.weight).sum();
    if weight <= 0.0 {
        return None;
    }
    let centre = Point3::from(moment / weight);
    let square = |pair: &SurfacePair| (pair.point - centre).norm_squared() * pair.weight;
    let variance = pairs.iter().map(square).sum::<f64>() / weight;
    // One pair, or copies of it, have no spread: any unit will do.
    let spread = if variance > 0.0 { variance.sqrt() } else { 1.0 };
    let empty = NormalEquations::new(centre, spread);
    let sums: Vec<NormalEquations> = pairs
        .par_chunks(CHUNK)
        .map(|pairs| {
            let mut sums = empty.clone();
            for pair in pairs {
                sums.add_plane(&pair.point, &pair.normal, pair.residual, pair.weight);
            }
            sums
        })
        .collect();
    Some(sums.iter().fold(empty, NormalEquations::merge))
}

#[cfg(test)]
mod tests;
