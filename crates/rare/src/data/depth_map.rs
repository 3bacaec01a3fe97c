//! Depth maps.

use crate::data::Intrinsics;
use crate::error::{Error, Result};

/// A depth image and the inner geometry of the camera that it belongs to.
///
/// `depth` is row-major, `height x width`, metres along the camera's z axis; 0 means that nothing was seen.
#[derive(Debug, Clone, PartialEq)]
pub struct DepthMap {
    intrinsics: Intrinsics,
    depth: Vec<f32>,
}

impl DepthMap {
    /// Takes `height x width` depths in row-major order.
    ///
    /// # Errors
    /// `InvalidInput` if the number of depths is not the number of pixels.
    pub fn new(intrinsics: Intrinsics, depth: Vec<f32>) -> Result<DepthMap> {
        if depth.len() != intrinsics.width * intrinsics.height {
            return Err(Error::invalid(format!(
                "a depth map of {} x {} pixels has {} values",
                intrinsics.width,
                intrinsics.height,
                depth.len()
            )));
        }
        Ok(DepthMap { intrinsics, depth })
    }

    /// A map in which nothing was seen.
    #[must_use]
    pub fn empty(intrinsics: Intrinsics) -> DepthMap {
        DepthMap { intrinsics, depth: vec![0.0; intrinsics.width * intrinsics.height] }
    }

    /// The inner geometry of the camera.
    #[must_use]
    pub fn intrinsics(&self) -> &Intrinsics {
        &self.intrinsics
    }

    /// Columns.
    #[must_use]
    pub fn width(&self) -> usize {
        self.intrinsics.width
    }

    /// Rows.
    #[must_use]
    pub fn height(&self) -> usize {
        self.intrinsics.height
    }

    /// All depths, row-major, metres, 0 = nothing seen.
    #[must_use]
    pub fn depth(&self) -> &[f32] {
        &self.depth
    }

    /// All depths, to be changed in place.
    pub fn depth_mut(&mut self) -> &mut [f32] {
        &mut self.depth
    }

    /// The depth in column `u` and row `v`; 0 outside the image.
    #[must_use]
    pub fn at(&self, u: usize, v: usize) -> f32 {
        if u < self.width() && v < self.height() { self.depth[v * self.width() + u] } else { 0.0 }
    }
}
