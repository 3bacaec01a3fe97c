//! The target of voxelised generalised ICP: the mean point and mean covariance of every occupied voxel.

use std::collections::HashMap;
use std::hash::BuildHasherDefault;

use nalgebra::{Matrix3, Point3, Vector3};

use crate::data::{Cell, CellHasher, VoxelGrid};
use crate::error::Result;
use crate::features::smallest_eigenvector;
use crate::pose::icp::method::covariance_across;
use crate::pose::normal_equations::Symmetric3;

/// Voxels in the order in which their first points came, and where each stands.
#[derive(Debug, Clone)]
pub(crate) struct GaussianVoxels {
    grid: VoxelGrid,
    /// Only asked, never iterated: its order cannot show.
    slots: HashMap<Cell, u32, BuildHasherDefault<CellHasher>>,
    voxels: Vec<GaussianVoxel>,
}

#[derive(Debug, Clone, Copy)]
pub(crate) struct GaussianVoxel {
    pub(super) mean: Point3<f64>,
    pub(super) covariance: Symmetric3,
    /// Across the surface: the direction of least variance.
    pub(super) normal: Vector3<f64>,
}

impl GaussianVoxels {
    /// Sums up the finite points and the covariances across their normals.
    pub(crate) fn new(
        points: &[Point3<f64>],
        normals: &[Vector3<f64>],
        voxel: f64,
    ) -> Result<GaussianVoxels> {
        let is_finite = |point: &Point3<f64>| point.iter().all(|value| value.is_finite());
        let finite: Vec<_> = points.iter().copied().filter(is_finite).collect();
        let grid = VoxelGrid::over(&finite, voxel)?;
        let mut slots = HashMap::<Cell, u32, BuildHasherDefault<CellHasher>>::default();
        let mut voxels: Vec<VoxelSums> = Vec::new();
        let members = points.iter().zip(normals).filter(|(point, _)| is_finite(point));
        for (point, normal) in members {
            let slot = *slots.entry(grid.cell(point)).or_insert(voxels.len() as u32) as usize;
            if slot == voxels.len() {
                voxels.push(VoxelSums::starting_at(point));
            }
            if let Some(sums) = voxels.get_mut(slot) {
                sums.add(point, normal);
            }
        }
        let voxels = voxels.iter().map(VoxelSums::mean).collect();
        Ok(GaussianVoxels { grid, slots, voxels })
    }

    /// The voxel that `point` lies in and its position, if target points lie there too.
    #[inline]
    pub(super) fn find(&self, point: &Point3<f64>) -> Option<(u32, &GaussianVoxel)> {
        let index = *self.slots.get(&self.grid.cell_of_any(point)?)?;
        Some((index, self.get(index as usize)?))
    }

    /// The voxel at a position.
    pub(super) fn get(&self, index: usize) -> Option<&GaussianVoxel> {
        self.voxels.get(index)
    }
}

/// A voxel under construction.
struct VoxelSums {
    /// The first point: sums are taken about it, so that points far from the origin keep their digits.
    first: Point3<f64>,
    count: f64,
    offset: Vector3<f64>,
    covariance: Symmetric3,
}

impl VoxelSums {
    fn starting_at(first: &Point3<f64>) -> VoxelSums {
        let covariance = Symmetric3 { xx: 0.0, xy: 0.0, xz: 0.0, yy: 0.0, yz: 0.0, zz: 0.0 };
        VoxelSums { first: *first, count: 0.0, offset: Vector3::zeros(), covariance }
    }

    fn add(&mut self, point: &Point3<f64>, normal: &Vector3<f64>) {
        let (sum, one) = (&mut self.covariance, covariance_across(normal));
        self.count += 1.0;
        self.offset += point - self.first;
        sum.xx += one.xx;
        sum.xy += one.xy;
        sum.xz += one.xz;
        sum.yy += one.yy;
        sum.yz += one.yz;
        sum.zz += one.zz;
    }

    fn mean(&self) -> GaussianVoxel {
        let (sum, count) = (&self.covariance, self.count);
        let covariance = Symmetric3 {
            xx: sum.xx / count,
            xy: sum.xy / count,
            xz: sum.xz / count,
            yy: sum.yy / count,
            yz: sum.yz / count,
            zz: sum.zz / count,
        };
        let c = &covariance;
        let dense = Matrix3::new(c.xx, c.xy, c.xz, c.xy, c.yy, c.yz, c.xz, c.yz, c.zz);
        // Where no point has a normal the covariance is the identity, and there is no surface.
        let known = dense != Matrix3::identity();
        let normal = if known { smallest_eigenvector(&dense) } else { Vector3::zeros() };
        GaussianVoxel { mean: self.first + self.offset / count, covariance, normal }
    }
}
