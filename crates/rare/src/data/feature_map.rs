//! Dense feature maps.

use crate::error::{Error, Result};

/// A dense feature map: `values` is `channels x height x width`, row-major (the width runs fastest).
#[derive(Debug, Clone, PartialEq)]
pub struct FeatureMap {
    channels: usize,
    height: usize,
    width: usize,
    values: Vec<f32>,
}

impl FeatureMap {
    /// Takes `channels x height x width` values.
    ///
    /// # Errors
    /// `InvalidInput` if a size is 0 or the number of values is not their product.
    pub fn new(
        channels: usize,
        height: usize,
        width: usize,
        values: Vec<f32>,
    ) -> Result<FeatureMap> {
        let expected = channels.checked_mul(height).and_then(|size| size.checked_mul(width));
        if expected != Some(values.len()) || values.is_empty() {
            return Err(Error::invalid(format!(
                "a feature map of {channels} x {height} x {width} (channels, rows, columns) has {} values",
                values.len()
            )));
        }
        Ok(FeatureMap { channels, height, width, values })
    }

    /// Number of channels.
    #[must_use]
    pub fn channels(&self) -> usize {
        self.channels
    }

    /// Rows.
    #[must_use]
    pub fn height(&self) -> usize {
        self.height
    }

    /// Columns.
    #[must_use]
    pub fn width(&self) -> usize {
        self.width
    }

    /// All values, channel by channel.
    #[must_use]
    pub fn values(&self) -> &[f32] {
        &self.values
    }

    /// The image of one channel, `height x width`.
    ///
    /// # Errors
    /// `InvalidInput` if there is no such channel.
    pub fn channel(&self, channel: usize) -> Result<&[f32]> {
        let size = self.height * self.width;
        self.values.get(channel * size..(channel + 1) * size).ok_or_else(|| {
            Error::invalid(format!("no channel {channel}: the map has {}", self.channels))
        })
    }
}

/// What an encoder makes of one depth map: one feature map per layer, in the order the layers were asked for.
pub type LayeredFeatures = Vec<FeatureMap>;
