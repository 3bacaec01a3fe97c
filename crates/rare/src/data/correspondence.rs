//! Correspondences between two clouds.

use nalgebra::Point3;

/// A source point and the target point that it is believed to be, each in its own cloud's frame, metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Correspondence {
    /// Point of the source cloud, source frame.
    pub source: Point3<f64>,
    /// Point of the target (reference) cloud, target frame.
    pub target: Point3<f64>,
    /// How much the matcher trusts it, at least 0; 1 where nothing is known.
    pub score: f64,
}
