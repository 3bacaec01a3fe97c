//! Registration refinement for point clouds after RARE (ICCV 2025).
#![forbid(unsafe_code)]

pub mod data;
pub mod error;
pub mod random;
pub mod synthetic;

pub use data::{
    Camera, Correspondence, DepthMap, FeatureMap, Intrinsics, PointCloud, PointFeatures,
    RigidTransform,
};
pub use error::{Error, Result};
pub use nalgebra;
