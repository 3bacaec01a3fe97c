//! A cloud with the 3D features that some registration method computed for it.

use crate::data::{PointCloud, PointFeatures};

/// One side of a registration: "any registration method" enters as data.
#[derive(Debug, Clone, PartialEq)]
pub struct Scan {
    /// The cloud.
    pub cloud: PointCloud,
    /// 3D keypoints with features, in the caller's frame (metres); without them, fast point feature histograms are
    /// computed at seeded voxel points.
    pub features: Option<PointFeatures>,
}

impl From<PointCloud> for Scan {
    fn from(cloud: PointCloud) -> Scan {
        Scan { cloud, features: None }
    }
}
