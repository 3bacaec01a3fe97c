//! Registration refinement for point clouds after RARE (ICCV 2025).
#![forbid(unsafe_code)]

pub mod data;
pub mod densify;
pub mod error;
<<<<<<< HEAD
pub mod project;
pub mod random;
pub mod scale;
pub mod viewpoints;
=======
pub mod features;
pub mod matching;
pub mod pose;
pub mod random;
pub mod transfer;
>>>>>>> matching

pub use data::{
    Camera, Correspondence, DepthMap, FeatureMap, Intrinsics, PointCloud, PointFeatures,
    RigidTransform,
};
pub use error::{Error, Result};
pub use nalgebra;
