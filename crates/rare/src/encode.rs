//! Step 3: depth maps become dense features (paper section "Stable Diffusion and ControlNet", "Depth Diffusion
//! Feature Extraction").
//!
//! [`DepthEncoder`] is the seam between the geometry of this crate and whatever makes features of a depth map: a
//! diffusion network, the built-in features, or a file ([`Recorded`]).

mod arrays;
mod recorded;

use std::sync::Arc;

pub use recorded::{MapSummary, Recorded, Recording, map_names};

use crate::data::{DepthMap, LayeredFeatures};
use crate::error::Result;

/// The maps of the paper's two views, in the order of encoding: for each virtual view, first what it sees of the
/// reference cloud, then what it sees of the source cloud.
pub const MAP_NAMES: [&str; 4] = ["refview_ref", "refview_src", "srcview_ref", "srcview_src"];

/// Makes dense features of depth maps.
///
/// The maps of one registration have an order: for each virtual view, the map of the reference cloud, then that of the
/// source cloud (see [`MAP_NAMES`]). So the map at position `index` is seen by view `index / 2` and shows the reference
/// if `index` is even. An encoder that draws random numbers takes its stream from the position.
pub trait DepthEncoder: Send + Sync {
    /// Encodes some of the maps of a registration, each with its position: one [`LayeredFeatures`] per map in the order
    /// given, all with the same number of layers. What is made of a map does not depend on the others.
    ///
    /// # Errors
    /// Whatever keeps the encoder from working, in the words of [`crate::Error`].
    fn encode_at(&self, maps: &[(usize, &DepthMap)]) -> Result<Vec<LayeredFeatures>>;

    /// Encodes all maps of one registration, in their order.
    ///
    /// # Errors
    /// As [`DepthEncoder::encode_at`].
    fn encode(&self, maps: &[DepthMap]) -> Result<Vec<LayeredFeatures>> {
        let numbered: Vec<(usize, &DepthMap)> = maps.iter().enumerate().collect();
        self.encode_at(&numbered)
    }
}

/// An encoder that its owner goes on asking questions while a [`crate::Refiner`] uses it.
impl<E: DepthEncoder + ?Sized> DepthEncoder for Arc<E> {
    fn encode_at(&self, maps: &[(usize, &DepthMap)]) -> Result<Vec<LayeredFeatures>> {
        (**self).encode_at(maps)
    }

    fn encode(&self, maps: &[DepthMap]) -> Result<Vec<LayeredFeatures>> {
        (**self).encode(maps)
    }
}
