//! Registration refinement for point clouds after RARE (ICCV 2025).
#![forbid(unsafe_code)]

pub mod aggregate;
pub mod data;
pub mod error;
pub mod features;
pub mod fuse;
pub mod matching;
pub mod pose;
pub mod random;
pub mod transfer;

pub use data::{
    Camera, Correspondence, CorrespondenceSet, CorrespondenceSets, DepthMap, FeatureMap,
    Intrinsics, PointCloud, PointFeatures, RigidTransform, SetName,
};
pub use error::{Error, Result};
pub use nalgebra;
