//! Points of a cloud that can be recognised: with normal and descriptor, and an index over their places.

use nalgebra::{Point3, Vector3};

use crate::data::{KdTree, PointFeatures};
use crate::error::Result;
use crate::features::{estimate_normals, fpfh_at, orient_towards};

/// Points with fast point feature histograms and normals; lengths as the points have them.
#[derive(Debug, Clone)]
pub struct Landmarks {
    features: PointFeatures,
    normals: Vec<Vector3<f64>>,
    tree: KdTree,
}

impl Landmarks {
    /// Describes the points at `indices` of a cloud sampled at about `voxel`: normals from the 30 nearest points within
    /// two voxels, histograms from the 100 nearest within five, as the official evaluations have it, scaled to unit
    /// length. Normals point to the `sensor`, if there was one.
    ///
    /// # Errors
    /// `InvalidInput` if an index is out of range.
    pub fn describe(
        points: &[Point3<f64>],
        indices: &[usize],
        voxel: f64,
        sensor: Option<&Point3<f64>>,
    ) -> Result<Landmarks> {
        let tree = KdTree::new(points);
        let mut normals = estimate_normals(points, &tree, 2.0 * voxel, 30);
        if let Some(sensor) = sensor {
            orient_towards(&mut normals, points, sensor);
        }
        let features = fpfh_at(points, &normals, &tree, 5.0 * voxel, 100, indices)?.normalised();
        let normals = indices.iter().map(|&index| normals[index]).collect();
        let tree = KdTree::new(features.points());
        Ok(Landmarks { features, normals, tree })
    }

    /// The points with their descriptors.
    #[must_use]
    pub fn features(&self) -> &PointFeatures {
        &self.features
    }

    /// The places.
    #[must_use]
    pub fn points(&self) -> &[Point3<f64>] {
        self.features.points()
    }

    /// One normal per landmark, zero where none is known.
    #[must_use]
    pub fn normals(&self) -> &[Vector3<f64>] {
        &self.normals
    }

    /// The index over [`Landmarks::points`].
    #[must_use]
    pub fn tree(&self) -> &KdTree {
        &self.tree
    }
}
