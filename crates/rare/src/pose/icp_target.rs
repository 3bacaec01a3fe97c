//! The clouds that ICP aligns, prepared once for any number of alignments.

use nalgebra::{Point3, Vector3};

use crate::data::KdTree;
use crate::error::{Error, Result};
use crate::features::estimate_normals;
use crate::pose::icp::GaussianVoxels;

/// A target cloud with its normals and search structures.
#[derive(Debug, Clone)]
pub struct IcpTarget {
    points: Vec<Point3<f64>>,
    normals: Vec<Vector3<f64>>,
    tree: KdTree,
    voxels: Option<GaussianVoxels>,
}

/// A source cloud with its normals, which the symmetric and the generalised methods need.
#[derive(Debug, Clone)]
pub struct IcpSource {
    points: Vec<Point3<f64>>,
    normals: Vec<Vector3<f64>>,
}

impl IcpTarget {
    /// Takes points (metres) and a unit normal each (either sign; zero or not finite where there is none: such points
    /// are found but pull at no plane). Points that are not finite are never found.
    ///
    /// # Errors
    /// `InvalidInput` if there is no point, or not one normal per point.
    pub fn new(points: Vec<Point3<f64>>, normals: Vec<Vector3<f64>>) -> Result<IcpTarget> {
        let normals = checked("target", &points, normals)?;
        let tree = KdTree::new(&points);
        Ok(IcpTarget { points, normals, tree, voxels: None })
    }

    /// Takes points (metres) and estimates each normal from its `neighbours` nearest points, itself included (20 is
    /// usual). The plane across it is the covariance of the generalised methods, see [`crate::pose::IcpMethod`].
    ///
    /// # Errors
    /// `InvalidInput` if there is no point.
    pub fn with_estimated_normals(
        points: Vec<Point3<f64>>,
        neighbours: usize,
    ) -> Result<IcpTarget> {
        let tree = KdTree::new(&points);
        let normals = estimate_normals(&points, &tree, f64::INFINITY, neighbours);
        let normals = checked("target", &points, normals)?;
        Ok(IcpTarget { points, normals, tree, voxels: None })
    }

    /// Adds the voxels (edge `voxel`, metres) that [`crate::pose::IcpMethod::VoxelisedGeneralised`] matches with.
    ///
    /// # Errors
    /// `InvalidInput` if `voxel` is not a positive number, or so small that the cloud spans more than `2^32` voxels.
    pub fn with_voxels(mut self, voxel: f64) -> Result<IcpTarget> {
        self.voxels = Some(GaussianVoxels::new(&self.points, &self.normals, voxel)?);
        Ok(self)
    }

    /// The points, metres.
    #[must_use]
    pub fn points(&self) -> &[Point3<f64>] {
        &self.points
    }

    /// One normal per point: of unit length, or zero where there is none.
    #[must_use]
    pub fn normals(&self) -> &[Vector3<f64>] {
        &self.normals
    }

    /// The index over the points.
    #[must_use]
    pub fn tree(&self) -> &KdTree {
        &self.tree
    }

    pub(super) fn voxels(&self) -> Option<&GaussianVoxels> {
        self.voxels.as_ref()
    }
}

impl IcpSource {
    /// Takes points (metres) and a unit normal each (either sign; zero or not finite where there is none). Points that
    /// are not finite take no part.
    ///
    /// # Errors
    /// `InvalidInput` if there is no point, or not one normal per point.
    pub fn new(points: Vec<Point3<f64>>, normals: Vec<Vector3<f64>>) -> Result<IcpSource> {
        let normals = checked("source", &points, normals)?;
        Ok(IcpSource { points, normals })
    }

    /// Takes points (metres) and estimates each normal from its `neighbours` nearest points, itself included.
    ///
    /// # Errors
    /// `InvalidInput` if there is no point.
    pub fn with_estimated_normals(
        points: Vec<Point3<f64>>,
        neighbours: usize,
    ) -> Result<IcpSource> {
        let normals = estimate_normals(&points, &KdTree::new(&points), f64::INFINITY, neighbours);
        IcpSource::new(points, normals)
    }

    /// The points, metres.
    #[must_use]
    pub fn points(&self) -> &[Point3<f64>] {
        &self.points
    }

    /// One normal per point: of unit length, or zero where there is none.
    #[must_use]
    pub fn normals(&self) -> &[Vector3<f64>] {
        &self.normals
    }
}

/// One normal per point, zero instead of what is not finite.
fn checked(
    role: &str,
    points: &[Point3<f64>],
    mut normals: Vec<Vector3<f64>>,
) -> Result<Vec<Vector3<f64>>> {
    if points.is_empty() || points.len() != normals.len() {
        return Err(Error::invalid(format!(
            "an icp {role} needs points and one normal for each, got {} points and {} normals",
            points.len(),
            normals.len()
        )));
    }
    for normal in &mut normals {
        if !normal.iter().all(|value| value.is_finite()) {
            *normal = Vector3::zeros();
        }
    }
    Ok(normals)
}
