//! `CoFiNet` (Yu, Li, Saleh, Busam, Ilic: "CoFiNet: Reliable Coarse-to-fine Correspondences for Robust Point Cloud
//! Registration", `NeurIPS` 2021): coarse points of two clouds are matched first, then the fine points around them.
//!
//! | step | file | takes and gives |
//! |---|---|---|
//! | features | `network.rs` | clouds -> features of coarse and fine points |
//! | coarse matches | `coarse.rs` | features of coarse points -> pairs of them |
//! | patches | `patches.rs` | coarse and fine points -> the fine points around each coarse one |
//! | fine matches | `sinkhorn.rs`, `fine.rs` | pairs of patches -> pairs of fine points |
//! | description | `describe.rs` | two clouds -> correspondences and a pose |

mod coarse;
mod config;
mod describe;
mod fine;
mod layout;
mod network;
mod patches;
mod sinkhorn;

pub use coarse::CoarsePair;
pub use config::CoFiNetConfig;
pub use fine::FinePair;
pub use layout::layout;
pub use network::{CoFiNet, Output};
pub use patches::Patches;
