//! The picture of a depth map that a ControlNet is conditioned on, which the field calls the hint (paper section
//! "Stable Diffusion and ControlNet": "these depth maps are then input into ControlNet"; the numbers are FreeReg's).

mod resample;

use serde::{Deserialize, Serialize};

use crate::data::{DepthMap, FeatureMap};
use crate::error::{Error, Result};

/// The shorter side of the hint, pixels.
pub const RESOLUTION: usize = 512;

/// Sides of the hint are multiples of this: the network halves its maps six times.
const MULTIPLE: f64 = 64.0;

/// A hint is at most this many times as wide as high (FreeReg's rule for KITTI).
const WIDEST: f64 = 2.5;

/// Neither side of a hint may be longer, pixels: it bounds the memory that a very narrow map asks for.
const LONGEST: usize = 16_384;

/// The percentiles of depth between which the picture goes from white (near) to black (far).
const NEAR_PERCENTILE: f64 = 2.0;
const FAR_PERCENTILE: f64 = 85.0;

/// Which pixels the percentiles are taken of.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Percentiles {
    /// Of all pixels, holes included, as FreeReg does. Holes of depth 0 are painted white, as the nearest of all.
    #[default]
    AllPixels,
    /// Of pixels in which something was seen; holes (depth 0) are painted black, as far away.
    ValidOnly,
}

/// A picture of one channel, row-major, `u8`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GrayImage {
    width: usize,
    height: usize,
    values: Vec<u8>,
}

impl GrayImage {
    /// Takes `height x width` values in row-major order.
    ///
    /// # Errors
    /// `InvalidInput` if a side is 0 or the number of values is not the number of pixels.
    pub fn new(width: usize, height: usize, values: Vec<u8>) -> Result<GrayImage> {
        if width.checked_mul(height) != Some(values.len()) || values.is_empty() {
            return Err(Error::invalid(format!(
                "a picture of {width} x {height} pixels has {} values",
                values.len()
            )));
        }
        Ok(GrayImage { width, height, values })
    }

    /// Columns.
    #[must_use]
    pub fn width(&self) -> usize {
        self.width
    }

    /// Rows.
    #[must_use]
    pub fn height(&self) -> usize {
        self.height
    }

    /// All values, row by row.
    #[must_use]
    pub fn values(&self) -> &[u8] {
        &self.values
    }

    /// What a network takes: three equal channels in `[0, 1]`, `3 x height x width`.
    ///
    /// # Errors
    /// None in practice: the sizes fit by construction.
    pub fn to_channels(&self) -> Result<FeatureMap> {
        let channel = self.values.iter().map(|&value| f32::from(value) / 255.0);
        let values = channel.clone().chain(channel.clone()).chain(channel).collect();
        FeatureMap::new(3, self.height, self.width, values)
    }
}

/// Draws the hint of a dense depth map: normalised, then resized so that its shorter side is 512 pixels.
///
/// # Errors
/// `InvalidInput` if the map has no pixels or is too narrow.
pub fn hint(map: &DepthMap, percentiles: Percentiles) -> Result<GrayImage> {
    resize_image(&normalize_depth(map, percentiles)?, RESOLUTION)
}

/// The depths (metres) between which [`normalize_depth`] goes from white to black; `None` if no pixel counts.
#[must_use]
pub fn depth_range(map: &DepthMap, percentiles: Percentiles) -> Option<(f64, f64)> {
    let mut depths = map.depth().to_vec();
    if percentiles == Percentiles::ValidOnly {
        depths.retain(|&depth| depth > 0.0);
    }
    let near = percentile(&mut depths, NEAR_PERCENTILE)?;
    Some((near, percentile(&mut depths, FAR_PERCENTILE)?))
}

/// Paints near white and far black. A map without contrast becomes black.
///
/// # Errors
/// `InvalidInput` if the map has no pixels.
pub fn normalize_depth(map: &DepthMap, percentiles: Percentiles) -> Result<GrayImage> {
    let (near, far) = depth_range(map, percentiles).unwrap_or((0.0, 0.0));
    let paint = |&depth: &f32| {
        let hole = percentiles == Percentiles::ValidOnly && depth <= 0.0;
        if hole || near == far {
            return 0;
        }
        let brightness = 1.0 - (f64::from(depth) - near) / (far - near);
        (255.0 * brightness).clamp(0.0, 255.0) as u8
    };
    GrayImage::new(map.width(), map.height(), map.depth().iter().map(paint).collect())
}

/// Resizes a picture so that its shorter side is about `resolution` pixels, both sides are multiples of 64, and it is
/// at most 2.5 times as wide as high: with Lanczos' filter of 8 taps where it grows, by areas where it does not.
///
/// # Errors
/// `InvalidInput` if `resolution` is below 32 (it would round to 0) or a side would be longer than 16384 pixels.
pub fn resize_image(image: &GrayImage, resolution: usize) -> Result<GrayImage> {
    let scale = resolution as f64 / image.height.min(image.width) as f64;
    let side = |old: usize| ((old as f64 * scale / MULTIPLE).round_ties_even() * MULTIPLE) as usize;
    let height = side(image.height);
    let width = side(image.width).min((WIDEST * height as f64) as usize);
    if !(1..=LONGEST).contains(&height) || !(1..=LONGEST).contains(&width) {
        return Err(Error::invalid(format!(
            "a picture of {} x {} pixels cannot be resized to {resolution}: it would be {width} x {height}, sides must be 64 to {LONGEST}",
            image.width, image.height
        )));
    }
    Ok(if scale > 1.0 {
        resize_lanczos4(image, height, width)
    } else {
        resize_area(image, height, width)
    })
}

/// Resizes by Lanczos' filter of 8 taps; pixels outside repeat the edge.
#[must_use]
pub fn resize_lanczos4(image: &GrayImage, height: usize, width: usize) -> GrayImage {
    let rows = resample::lanczos4(image.height, height);
    resample::resample(image, &rows, &resample::lanczos4(image.width, width))
}

/// Resizes so that each new pixel is the mean of the area that it covers.
#[must_use]
pub fn resize_area(image: &GrayImage, height: usize, width: usize) -> GrayImage {
    let rows = resample::area(image.height, height);
    resample::resample(image, &rows, &resample::area(image.width, width))
}

/// The value below which `percent` of the values lie, linear between two of them; reorders the values. `None` if there
/// are none.
fn percentile(values: &mut [f32], percent: f64) -> Option<f64> {
    let position = percent / 100.0 * values.len().checked_sub(1)? as f64;
    let (_, &mut low, above) = values.select_nth_unstable_by(position as usize, f32::total_cmp);
    let high = above.iter().copied().min_by(f32::total_cmp).unwrap_or(low);
    Some(f64::from(low) + (f64::from(high) - f64::from(low)) * position.fract())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::Intrinsics;

    fn map(depth: &[f32]) -> DepthMap {
        let intrinsics = Intrinsics { width: depth.len(), height: 1, ..Intrinsics::indoor() };
        DepthMap::new(intrinsics, depth.to_vec()).unwrap()
    }

    #[test]
    fn percentiles_are_linear_between_values() {
        assert_eq!(percentile(&mut [4.0, 1.0, 3.0, 2.0], 50.0), Some(2.5));
        assert_eq!(percentile(&mut [4.0, 1.0, 3.0, 2.0, 5.0], 85.0), Some(4.4));
        assert_eq!(percentile(&mut [7.0], 85.0), Some(7.0));
        assert_eq!(percentile(&mut [], 2.0), None);
    }

    #[test]
    fn holes_are_near_or_far() {
        let depth = [0.0, 0.0, 1.0, 2.0, 3.0, 0.0];
        let painted = |percentiles| normalize_depth(&map(&depth), percentiles).unwrap().values;
        assert_eq!(painted(Percentiles::AllPixels)[0], 255);
        let valid = painted(Percentiles::ValidOnly);
        assert_eq!((valid[0], valid[2], valid[4]), (0, 255, 0));
        assert!((100..200).contains(&valid[3]));
    }

    #[test]
    fn maps_without_contrast_or_with_odd_numbers_are_painted() {
        for depth in [[0.0; 3], [2.0; 3], [f32::NAN; 3], [f32::INFINITY; 3], [-1.0; 3]] {
            for percentiles in [Percentiles::AllPixels, Percentiles::ValidOnly] {
                let painted = normalize_depth(&map(&depth), percentiles).unwrap();
                assert_eq!(painted.values, [0; 3], "{depth:?}");
            }
        }
        assert!(hint(&map(&[]), Percentiles::AllPixels).is_err());
    }

    #[test]
    fn pictures_too_narrow_to_resize_are_refused() {
        let image = GrayImage::new(1, 100, vec![0; 100]).unwrap();
        assert!(resize_image(&image, 512).unwrap_err().to_string().contains("512 x 51200"));
        assert!(resize_image(&image, 0).is_err());
    }
}
