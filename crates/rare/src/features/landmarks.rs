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

#[cfg(test)]
mod tests {
    use super::*;

    const VOXEL: f64 = 0.05;

    /// A bumpy sheet 2 m before the origin.
    fn sheet() -> Vec<Point3<f64>> {
        let at = |i: i32| f64::from(i) * VOXEL;
        let grid = (-10..10).flat_map(|x| (-10..10).map(move |y| (at(x), at(y))));
        grid.map(|(x, y)| Point3::new(x, y, 2.0 + 0.1 * (7.0 * x).sin() * (5.0 * y).cos()))
            .collect()
    }

    #[test]
    fn the_chosen_points_are_described_in_their_order() {
        let points = sheet();
        let chosen = [210, 7, 399];
        let landmarks = Landmarks::describe(&points, &chosen, VOXEL, None).unwrap();
        assert_eq!(landmarks.points(), chosen.map(|index| points[index]));
        assert_eq!((landmarks.normals().len(), landmarks.features().dimension()), (3, 33));
        for (number, &index) in chosen.iter().enumerate() {
            let found = landmarks.tree().nearest_within(&points[index], 1e-9).unwrap();
            assert_eq!(found.index, number);
            let feature = landmarks.features().feature(number);
            let length: f32 = feature.iter().map(|value| value * value).sum();
            assert!((length - 1.0).abs() < 1e-5, "{length}");
        }
        // The neighbours are those of the whole cloud, not of the chosen points.
        let all: Vec<usize> = (0..points.len()).collect();
        let described = Landmarks::describe(&points, &all, VOXEL, None).unwrap();
        assert_eq!(described.features().feature(210), landmarks.features().feature(0));
        assert_eq!(described.normals()[7], landmarks.normals()[1]);
    }

    #[test]
    fn normals_point_to_the_sensor() {
        let points = sheet();
        let all: Vec<usize> = (0..points.len()).collect();
        for sensor in [Point3::origin(), Point3::new(0.0, 0.0, 4.0)] {
            let landmarks = Landmarks::describe(&points, &all, VOXEL, Some(&sensor)).unwrap();
            for (normal, point) in landmarks.normals().iter().zip(&points) {
                assert!((normal.norm() - 1.0).abs() < 1e-9);
                assert!(normal.dot(&(sensor - point)) > 0.0, "{point} {normal}");
            }
        }
    }

    #[test]
    fn indices_out_of_range_are_refused() {
        let points = sheet();
        let error = Landmarks::describe(&points, &[0, points.len()], VOXEL, None).unwrap_err();
        assert!(error.to_string().contains("400"), "{error}");
        let none = Landmarks::describe(&points, &[], VOXEL, None).unwrap();
        assert!(none.points().is_empty() && none.normals().is_empty());
    }
}
