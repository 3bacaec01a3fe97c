//! The cloud that ICP aligns to.

use nalgebra::{Point3, Vector3};

use crate::data::{KdTree, Neighbour};
use crate::error::{Error, Result};
use crate::pose::RobustKernel;
use crate::pose::normal_equations::NormalEquations;

/// A target cloud prepared once for any number of alignments.
#[derive(Debug, Clone)]
pub struct IcpTarget {
    points: Vec<Point3<f64>>,
    normals: Vec<Vector3<f64>>,
    tree: KdTree,
}

impl IcpTarget {
    /// Takes points (metres) and a unit normal each (either sign; zero where there is none: such points are found but
    /// pull at nothing).
    ///
    /// # Errors
    /// `InvalidInput` if there is no point, or not one normal per point.
    pub fn new(points: Vec<Point3<f64>>, normals: Vec<Vector3<f64>>) -> Result<IcpTarget> {
        if points.is_empty() || points.len() != normals.len() {
            return Err(Error::invalid(format!(
                "an icp target needs points and one normal for each, got {} points and {} normals",
                points.len(),
                normals.len()
            )));
        }
        let tree = KdTree::new(&points);
        Ok(IcpTarget { points, normals, tree })
    }

    /// The points, metres.
    #[must_use]
    pub fn points(&self) -> &[Point3<f64>] {
        &self.points
    }

    /// The index over the points.
    #[must_use]
    pub fn tree(&self) -> &KdTree {
        &self.tree
    }

    /// The nearest target point closer than `radius`, sought with an earlier match as the guess.
    pub(super) fn closest(
        &self,
        point: &Point3<f64>,
        guess: u32,
        radius: f64,
    ) -> Option<Neighbour> {
        let guess = Neighbour::of(&self.points, guess as usize, point)?;
        if guess.squared_distance < radius * radius {
            Some(self.tree.nearest_from(point, guess))
        } else {
            self.tree.nearest_within(point, radius)
        }
    }

    pub(super) fn add_pair(
        &self,
        sums: &mut NormalEquations,
        point: &Point3<f64>,
        found: Neighbour,
        kernel: RobustKernel,
        width: f64,
    ) {
        sums.add_match(found.squared_distance);
        let (target, normal) = (self.points[found.index], self.normals[found.index]);
        let residual = (point - target).dot(&normal);
        let weight = kernel.weight(residual, width);
        if weight > 0.0 && normal != Vector3::zeros() {
            sums.add_plane(point, &normal, residual, weight);
        }
    }
}
