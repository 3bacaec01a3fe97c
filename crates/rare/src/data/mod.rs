//! The nouns: what the steps of the pipeline take and give.

mod camera;
mod cloud;
mod correspondence;
mod correspondence_sets;
mod depth_map;
mod feature_map;
mod kd_tree;
mod point_features;
mod scan;
mod transform;
mod voxel_grid;

pub use camera::{Camera, DepthRange, Intrinsics};
pub use cloud::PointCloud;
pub(crate) use cloud::bounds;
pub use correspondence::Correspondence;
pub use correspondence_sets::{CorrespondenceSet, CorrespondenceSets, SetName};
pub use depth_map::DepthMap;
pub use feature_map::{FeatureMap, LayeredFeatures};
pub use kd_tree::{KdTree, Neighbour};
pub use point_features::PointFeatures;
pub(crate) use point_features::normalise;
pub use scan::Scan;
pub use transform::{PoseError, RigidTransform};
pub(crate) use voxel_grid::{Cell, CellHasher, VoxelGrid, first_of_every_voxel};
pub use voxel_grid::{resolution, voxel_downsample};
