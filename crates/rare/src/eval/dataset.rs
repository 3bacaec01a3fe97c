//! Benchmarks as they lie on disk: which clouds make a pair, and the truth of it.

mod folder;
mod kitti;
mod three_d_match;

use std::path::PathBuf;

pub use folder::{read_folder, read_folder_starts};
pub use kitti::{KittiTruth, read_kitti};
use nalgebra::Matrix4;
pub use three_d_match::read_three_d_match;

use super::protocol::Protocol;
use super::scored::TruePair;

/// A benchmark on disk.
#[derive(Debug, Clone, PartialEq)]
pub struct Dataset {
    /// As tables name it.
    pub name: String,
    /// The protocol under which its numbers are usually published.
    pub protocol: Protocol,
    /// In the order of its list.
    pub pairs: Vec<DatasetPair>,
}

/// A pair of clouds and its truth.
#[derive(Debug, Clone, PartialEq)]
pub struct DatasetPair {
    /// The truth.
    pub truth: TruePair,
    /// The file of the source, for [`crate::io::read_cloud`].
    pub source: PathBuf,
    /// The file of the reference.
    pub reference: PathBuf,
}

/// An initial transform for a pair.
#[derive(Debug, Clone, PartialEq)]
pub struct StartPose {
    /// The scene; empty where a file knows of none.
    pub scene: String,
    /// Number of the source.
    pub source: usize,
    /// Number of the reference.
    pub reference: usize,
    /// Moves the source into the frame of the reference.
    pub target_from_source: Matrix4<f64>,
}
