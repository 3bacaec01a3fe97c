//! Registration refinement for point clouds after RARE (ICCV 2025).
#![forbid(unsafe_code)]

pub mod aggregate;
pub mod data;
pub mod densify;
pub mod depth_features;
pub mod encode;
pub mod error;
pub mod features;
pub mod fuse;
pub mod hint;
pub mod io;
pub mod matching;
pub mod pose;
pub mod project;
pub mod random;
pub mod reduce;
pub mod refine;
pub mod scale;
pub mod synthetic;
pub mod transfer;
pub mod verify;
pub mod viewpoints;

pub use data::{
    Camera, Correspondence, CorrespondenceSet, CorrespondenceSets, DepthMap, FeatureMap,
    Intrinsics, PointCloud, PointFeatures, RigidTransform, Scan, SetName,
};
pub use error::{Error, Result};
pub use nalgebra;
pub use refine::{InitialMethod, Recipe, Refinement, Refiner, RefinerConfig};
