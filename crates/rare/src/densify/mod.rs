//! Step 2: sparse depth maps become dense ones by erosion and dilation (paper section "Stable Diffusion and
//! ControlNet": "as discussed in FreeReg, we apply traditional erosion and dilation operations").
//!
//! Both filters are FreeReg's, after Ku, Harakeh and Waslander, "In defense of classical image processing: fast depth
//! completion on the CPU" (CRV 2018). They work on inverted depth, so that dilation lets the nearer surface win.

mod bilateral;
mod fast;
mod image;
mod median;
mod morphology;
mod multiscale;

use serde::{Deserialize, Serialize};

pub use bilateral::bilateral5;
pub use image::Image;
pub use median::median5;
pub use morphology::{close_full, dilate_cross, dilate_diamond, dilate_full};

use crate::data::DepthMap;

/// Depths (and inverted depths) up to this, metres, count as empty.
const EMPTY: f32 = 0.1;

/// Which filter fills the gaps between the projected points.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Densifier {
    /// One pass with a 7 x 7 diamond, for rooms and objects; reaches to 15 m.
    #[default]
    Fast,
    /// Near points are spread wider than far ones, and columns are filled below their highest point, for streets seen
    /// by a LiDAR; reaches to 100 m.
    Multiscale,
    /// Nothing is filled.
    None,
}

/// How a dense map shows pixels in which nothing was seen.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Holes {
    /// As 0, which is what a [`DepthMap`] means by "nothing seen" (FreeReg's `fast`).
    #[default]
    Zero,
    /// As something very far away, at 2.55 times the largest depth (FreeReg's `multiscale`: 255 m). Only for what is
    /// drawn for a network: everything else takes such a pixel for a surface.
    FarAway,
}

/// What may be chosen about densification.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, rename_all = "kebab-case")]
pub struct DensifyOptions {
    /// Points beyond this depth, metres, are dropped; unset, the recipe's: 15 for `fast`, 100 for `multiscale`. The
    /// near, middle and far range of `multiscale` end at 15 %, 30 % and 100 % of it.
    pub max_depth: Option<f32>,
    /// How holes look.
    pub holes: Holes,
}

impl Densifier {
    /// Fills the gaps of a map with the recipe's numbers; holes that remain are 0.
    #[must_use]
    pub fn densify(self, map: &DepthMap) -> DepthMap {
        self.densify_with(map, &DensifyOptions::default())
    }

    /// Fills the gaps of a map.
    #[must_use]
    pub fn densify_with(self, map: &DepthMap, options: &DensifyOptions) -> DepthMap {
        self.densify_observed(map, options, &mut |_, _| {})
    }

    /// Fills the gaps of a map and shows `observe` the image after each step, together with the step's name. The last
    /// image of `fast` is FreeReg's to the letter, where depths up to 0.1 m remain as noise around holes; in the map
    /// that is returned they are holes.
    #[must_use]
    pub fn densify_observed(
        self,
        map: &DepthMap,
        options: &DensifyOptions,
        observe: &mut dyn FnMut(&'static str, &Image),
    ) -> DepthMap {
        let max_depth = options.max_depth.unwrap_or(self.default_max_depth());
        let mut image = Image::from_rows(map.width(), map.depth().to_vec());
        match self {
            Densifier::Fast => fast::densify(&mut image, max_depth, observe),
            Densifier::Multiscale => multiscale::densify(&mut image, max_depth, observe),
            Densifier::None => {}
        }
        let hole = match options.holes {
            Holes::Zero => 0.0,
            Holes::FarAway => max_depth * 51.0 / 20.0,
        };
        let mut filled = DepthMap::empty(*map.intrinsics());
        for (filled, &depth) in filled.depth_mut().iter_mut().zip(image.values()) {
            *filled = if depth >= EMPTY { depth } else { hole };
        }
        filled
    }

    /// The largest depth of the recipe, metres.
    fn default_max_depth(self) -> f32 {
        match self {
            Densifier::Fast => 15.0,
            Densifier::Multiscale | Densifier::None => 100.0,
        }
    }
}

/// Near becomes large and far becomes small, so that dilation lets the near win; what is empty or beyond `max_depth`
/// becomes 0.
fn invert(depth: f32, max_depth: f32) -> f32 {
    if depth > EMPTY && depth <= max_depth { max_depth - depth } else { 0.0 }
}

/// Undoes [`invert`]; what is empty stays as it is.
fn revert(inverted: f32, max_depth: f32) -> f32 {
    if inverted > EMPTY { max_depth - inverted } else { inverted }
}
