//! Points with a feature vector each.

use nalgebra::Point3;

use crate::error::{Error, Result};

/// `N` points (metres, in their cloud's own frame) and an `N x dimension` row-major matrix of their features.
#[derive(Debug, Clone, PartialEq)]
pub struct PointFeatures {
    points: Vec<Point3<f64>>,
    dimension: usize,
    values: Vec<f32>,
}

impl PointFeatures {
    /// Takes points and their features, row by row.
    ///
    /// # Errors
    /// `InvalidInput` if the number of values is not points times dimension.
    pub fn new(
        points: Vec<Point3<f64>>,
        dimension: usize,
        values: Vec<f32>,
    ) -> Result<PointFeatures> {
        if points.len().checked_mul(dimension) != Some(values.len()) {
            return Err(Error::invalid(format!(
                "{} points with {dimension} features each need {} values, there are {}",
                points.len(),
                points.len().saturating_mul(dimension),
                values.len()
            )));
        }
        Ok(PointFeatures { points, dimension, values })
    }

    /// No points.
    #[must_use]
    pub fn empty(dimension: usize) -> PointFeatures {
        PointFeatures { points: Vec::new(), dimension, values: Vec::new() }
    }

    /// Number of points.
    #[must_use]
    pub fn len(&self) -> usize {
        self.points.len()
    }

    /// Whether there is no point.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.points.is_empty()
    }

    /// Length of a feature vector.
    #[must_use]
    pub fn dimension(&self) -> usize {
        self.dimension
    }

    /// The points, in their cloud's own frame, metres.
    #[must_use]
    pub fn points(&self) -> &[Point3<f64>] {
        &self.points
    }

    /// The features, row-major, `len x dimension`.
    #[must_use]
    pub fn values(&self) -> &[f32] {
        &self.values
    }

    /// The feature vector of point `index` (empty if there is no such point).
    #[must_use]
    pub fn feature(&self, index: usize) -> &[f32] {
        self.values.get(index * self.dimension..(index + 1) * self.dimension).unwrap_or(&[])
    }

    /// The same points with features of unit length (divided by their norm + 1e-5).
    #[must_use]
    pub fn normalised(&self) -> PointFeatures {
        let values = (0..self.len()).flat_map(|index| normalise(self.feature(index))).collect();
        PointFeatures { points: self.points.clone(), dimension: self.dimension, values }
    }

    /// The same features at moved points.
    #[must_use]
    pub fn map_points(mut self, move_point: impl Fn(&Point3<f64>) -> Point3<f64>) -> PointFeatures {
        self.points.iter_mut().for_each(|point| *point = move_point(point));
        self
    }

    /// The points and features at `indices`, in that order; indices out of range are passed over.
    #[must_use]
    pub fn select(&self, indices: &[usize]) -> PointFeatures {
        let kept: Vec<usize> =
            indices.iter().copied().filter(|&index| index < self.len()).collect();
        PointFeatures {
            points: kept.iter().map(|&index| self.points[index]).collect(),
            dimension: self.dimension,
            values: kept.iter().flat_map(|&index| self.feature(index)).copied().collect(),
        }
    }

    /// Appends a point; its feature is cut, or filled up with zeros, to the dimension.
    pub(crate) fn push(&mut self, point: Point3<f64>, feature: impl IntoIterator<Item = f32>) {
        self.points.push(point);
        self.values.extend(feature.into_iter().take(self.dimension));
        self.values.resize(self.points.len() * self.dimension, 0.0);
    }
}

/// What is added to norms before dividing by them (FreeReg).
const NORM_EPSILON: f64 = 1e-5;

/// A feature vector divided by its Euclidean norm + 1e-5.
pub(crate) fn normalise(feature: &[f32]) -> impl Iterator<Item = f32> + '_ {
    let squared_norm: f64 = feature.iter().map(|&value| f64::from(value).powi(2)).sum();
    let scale = (1.0 / (squared_norm.sqrt() + NORM_EPSILON)) as f32;
    feature.iter().map(move |value| value * scale)
}
