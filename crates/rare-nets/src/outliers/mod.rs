//! Networks that tell right correspondences from wrong ones.
//!
//! Each is a [`rare::pose::PoseEstimator`]: correspondences in, a rigid transform with evidence out. Both see the
//! coordinates of the pairs and nothing else, and attend from each pair to those that keep their distance to it.
//!
//! | module | network | pose around a seed |
//! |---|---|---|
//! | [`pointdsc`] | PointDSC (Bai et al., CVPR 2021) | its neighbours in feature space |
//! | [`vbreg`] | VBReg (Jiang et al., CVPR 2023) | those that the attention of all layers votes for |

mod compatibility;
mod encoder;
pub mod pointdsc;
mod seed_consensus;
pub mod vbreg;

pub use pointdsc::{PointDsc, PointDscConfig};
pub use seed_consensus::SeedConsensus;
pub use vbreg::{Vbreg, VbregConfig};
