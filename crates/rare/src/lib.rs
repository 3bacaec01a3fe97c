//! Registration refinement for point clouds after RARE (ICCV 2025).
#![forbid(unsafe_code)]

pub mod data;
pub mod densify;
pub mod encode;
pub mod error;
pub mod hint;
pub mod project;
pub mod random;
pub mod reduce;

pub use data::{
    Camera, Correspondence, DepthMap, FeatureMap, Intrinsics, PointCloud, PointFeatures,
    RigidTransform,
};
pub use error::{Error, Result};
pub use nalgebra;
