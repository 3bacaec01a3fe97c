#![doc = include_str!("../README.md")]
//!
//! # The pipeline
//!
//! | step | module | what it does |
//! |---|---|---|
//! | before | [`scale`], [`viewpoints`] | every length from one voxel size; virtual cameras |
//! | 1 | [`project`] | a cloud seen by a camera becomes a depth map |
//! | 2 | [`densify`] | gaps between the points are closed |
//! | 3 | [`encode`], [`depth_features`], [`hint`] | depth maps become dense features |
//! | 4 | [`reduce`] | joint principal components per layer and view |
//! | 5 | [`transfer`] | pixels become points; common points |
//! | 6 | [`fuse`] | 2D and 3D features side by side |
//! | 7 | [`matching`] | features become correspondences |
//! | 8 | [`aggregate`] | five sets become one transform |
//! | 9 | [`verify`] | is it believable |
//! | all | [`refine`] | the order of the steps: [`Refiner`] |
//!
//! Around it: [`data`] (the nouns), [`pose`] (estimators), [`eval`] (benchmarks), [`features`] (normals, histograms), [`io`] (files),
//! [`synthetic`] (simulated scans), [`random`], [`error`].
#![forbid(unsafe_code)]

pub mod aggregate;
pub mod data;
pub mod densify;
pub mod depth_features;
pub mod encode;
pub mod error;
pub mod eval;
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
pub use refine::{
    EncodedViews, Hypothesis, InitialMethod, Recipe, Refinement, Refiner, RefinerConfig,
    SetEvidence,
};
