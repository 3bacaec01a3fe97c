//! Predator (Huang, Gojcic, Usvyatsov, Wieser, Schindler: "Predator: Registration of 3D Point Clouds with Low Overlap",
//! CVPR 2021): features of all points, and how likely each lies where the clouds overlap and can be matched.
//!
//! | step | file | takes and gives |
//! |---|---|---|
//! | graph | `edge_convolution.rs` | coarse points of one cloud -> features that know their surroundings |
//! | attention | `overlap_attention.rs` | coarse features of both clouds -> what each has seen of the other |
//! | network | `network.rs` | clouds -> features and scores of all points |
//! | description | `describe.rs` | two clouds -> keypoints, correspondences and a pose |

mod config;
mod describe;
mod edge_convolution;
mod layout;
mod network;
mod overlap_attention;

pub use config::PredatorConfig;
pub use layout::layout;
pub use network::{Output, Predator};
