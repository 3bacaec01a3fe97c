//! The nouns: what the steps of the pipeline take and give.

mod camera;
mod cloud;
mod correspondence;
mod depth_map;
mod feature_map;
mod point_features;
mod transform;

pub use camera::{Camera, DepthRange, Intrinsics};
pub use cloud::PointCloud;
pub(crate) use cloud::bounds;
pub use correspondence::Correspondence;
pub use depth_map::DepthMap;
pub use feature_map::{FeatureMap, LayeredFeatures};
pub use point_features::PointFeatures;
pub use transform::{PoseError, RigidTransform};
