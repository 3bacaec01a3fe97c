//! Coarse to fine: both clouds are thinned anew for every scale.

use nalgebra::Point3;
use serde::{Deserialize, Serialize};

use crate::data::{RigidTransform, voxel_downsample};
use crate::error::{Error, Result};
use crate::pose::{Icp, IcpMethod, IcpResult, IcpSource, IcpTarget};

/// ICP over several sampling distances: coarse clouds reach far and are cheap, fine ones are accurate.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MultiScaleIcp {
    /// Sampling distances of both clouds, coarse to fine, metres; at least one.
    pub voxels: Vec<f64>,
    /// The settings for clouds sampled at 1 metre: all its lengths are multiplied by the sampling distance.
    pub per_voxel: Icp,
    /// Nearest points, the point itself included, that each normal is estimated from.
    pub neighbours: usize,
    /// Edge of the voxels of [`IcpMethod::VoxelisedGeneralised`], sampling distances.
    pub gaussian_voxel: f64,
}

impl MultiScaleIcp {
    /// Twice `voxel` (metres), then `voxel`, with [`Icp::for_method`]. A coarser scale would reach so far that parts
    /// without a counterpart pull at low overlap.
    #[must_use]
    pub fn for_voxel(method: IcpMethod, voxel: f64) -> MultiScaleIcp {
        MultiScaleIcp {
            voxels: vec![2.0 * voxel, voxel],
            per_voxel: Icp::for_method(method, 1.0),
            neighbours: 20,
            gaussian_voxel: 4.0,
        }
    }

    /// Moves `source` (raw points, metres) onto `target` from the start pose `initial`. The evidence is that of the
    /// last scale; `iterations` lists the stages of all scales.
    ///
    /// # Errors
    /// `InvalidInput` if a cloud has no finite point, there is no scale or a setting is not positive; `NoPose` if no
    /// source point comes close to the target at some scale.
    pub fn align(
        &self,
        source: &[Point3<f64>],
        target: &[Point3<f64>],
        initial: &RigidTransform,
    ) -> Result<IcpResult> {
        let (source, target) = (finite(source), finite(target));
        let mut result: Option<IcpResult> = None;
        for &voxel in &self.voxels {
            let start = result.as_ref().map_or(*initial, |before| before.target_from_source);
            let mut aligned = self.align_at(voxel, &source, &target, &start)?;
            let mut iterations = result.map_or_else(Vec::new, |before| before.iterations);
            iterations.append(&mut aligned.iterations);
            result = Some(IcpResult { iterations, ..aligned });
        }
        result.ok_or_else(|| Error::invalid("multi-scale icp was given no sampling distances"))
    }

    fn align_at(
        &self,
        voxel: f64,
        source: &[Point3<f64>],
        target: &[Point3<f64>],
        start: &RigidTransform,
    ) -> Result<IcpResult> {
        let icp = self.per_voxel.scaled(voxel);
        let points = voxel_downsample(target, voxel)?;
        let mut target = IcpTarget::with_estimated_normals(points, self.neighbours)?;
        if icp.method == IcpMethod::VoxelisedGeneralised {
            target = target.with_voxels(self.gaussian_voxel * voxel)?;
        }
        let points = voxel_downsample(source, voxel)?;
        if icp.method.needs_source_normals() {
            let source = IcpSource::with_estimated_normals(points, self.neighbours)?;
            icp.align_prepared(&source, &target, start)
        } else {
            icp.align(&points, &target, start)
        }
    }
}

fn finite(points: &[Point3<f64>]) -> Vec<Point3<f64>> {
    let is_finite = |point: &&Point3<f64>| point.iter().all(|value| value.is_finite());
    points.iter().filter(is_finite).copied().collect()
}
