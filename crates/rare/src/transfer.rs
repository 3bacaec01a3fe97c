//! Step 5: from pixels to points (section 3.3, "Pixel-to-point Feature Transfer").
//!
//! A regular grid of pixels, one per cell of the feature map, is lifted to 3-D by the densified depth; each pixel takes
//! the feature that the map has there. A 3-D keypoint with such a lifted keypoint near by is a *common point*: it owns
//! a feature of either kind.

use nalgebra::Point3;
use serde::{Deserialize, Serialize};

use crate::data::{DepthMap, DepthRange, FeatureMap, KdTree, PointFeatures, normalise};

/// How the feature of a keypoint is taken from the map.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Sampling {
    /// Bilinear between cells, with the corners of map and image aligned, as FreeReg does.
    AlignedCorners,
    /// The keypoint's own cell: for encoders whose cells are centred where [`keypoint_grid`] puts the keypoints.
    OwnCell,
}

/// The keypoints of one view of one cloud.
#[derive(Debug, Clone, PartialEq)]
pub struct Lifted {
    /// Points in the *camera's* frame, metres, with features of unit length.
    pub keypoints: PointFeatures,
    /// Column and row of each keypoint in the depth map.
    pub pixels: Vec<(usize, usize)>,
}

/// The pixels (column, row) of a `image_width x image_height` image at which a map of `map_width x map_height` cells is
/// sampled: near the centre of every cell, row by row. Empty if a size is 0.
///
/// ```
/// let grid = rare::transfer::keypoint_grid(64, 48, 4, 3);
/// assert_eq!(grid.len(), 12);
/// assert_eq!((grid[0], grid[1], grid[4]), ((8, 8), (24, 8), (8, 24)));
/// ```
#[must_use]
pub fn keypoint_grid(
    image_width: usize,
    image_height: usize,
    map_width: usize,
    map_height: usize,
) -> Vec<(usize, usize)> {
    let columns = grid_axis(image_width, map_width);
    let rows = grid_axis(image_height, map_height);
    rows.iter().flat_map(|&v| columns.iter().map(move |&u| (u, v))).collect()
}

/// FreeReg's spacing: whole pixels, the remainder stays unsampled at the far end. A map finer than the image is sampled
/// once per pixel.
fn grid_axis(pixels: usize, cells: usize) -> Vec<usize> {
    let spacing = pixels.checked_div(cells).unwrap_or(0).max(1);
    (0..cells.min(pixels)).map(|cell| cell * spacing + spacing / 2).collect()
}

/// Lifts the grid pixels of `map` at which `depth` (densified) lies in `range` to points with features.
///
/// Features are taken as `sampling` says, then divided by their norm + 1e-5.
/// Pixels whose feature is all zero or not finite are left out: the encoder knew nothing there.
///
/// ```
/// use rare::data::DepthRange;
/// use rare::{DepthMap, FeatureMap, Intrinsics, transfer};
/// use rare::transfer::Sampling;
/// let intrinsics = Intrinsics { width: 8, height: 6, fx: 8.0, fy: 8.0, cx: 4.0, cy: 3.0 };
/// let mut depth = DepthMap::empty(intrinsics);
/// depth.depth_mut()[8 * 3 + 4] = 2.0;
/// let map = FeatureMap::new(1, 3, 4, (0..12).map(|i| i as f32).collect())?;
/// let lifted = transfer::lift(&map, &depth, DepthRange::indoor(), Sampling::AlignedCorners);
/// // Twelve grid pixels, two by two pixels apart; the only one seen is (5, 3).
/// assert!(lifted.keypoints.is_empty());
/// depth.depth_mut()[8 * 3 + 5] = 2.0;
/// let lifted = transfer::lift(&map, &depth, DepthRange::indoor(), Sampling::AlignedCorners);
/// assert_eq!(lifted.pixels, [(5, 3)]);
/// assert_eq!(lifted.keypoints.points()[0].coords.as_slice(), [0.25, 0.0, 2.0]);
/// # Ok::<(), rare::Error>(())
/// ```
#[must_use]
pub fn lift(map: &FeatureMap, depth: &DepthMap, range: DepthRange, sampling: Sampling) -> Lifted {
    let (width, height) = (depth.width(), depth.height());
    let values = channels_last(map);
    let mut lifted = Lifted { keypoints: PointFeatures::empty(map.channels()), pixels: Vec::new() };
    let mut feature = vec![0.0; map.channels()];
    // A map finer than the image has cells without a keypoint at the far end of its rows.
    let columns = map.width().min(width);
    let grid = keypoint_grid(width, height, map.width(), map.height());
    for (index, (u, v)) in grid.into_iter().enumerate() {
        let seen = f64::from(depth.at(u, v));
        if !range.contains(seen) {
            continue;
        }
        let (x, y) = match sampling {
            Sampling::AlignedCorners => {
                (Tap::new(u, width, map.width()), Tap::new(v, height, map.height()))
            }
            Sampling::OwnCell => (Tap::at(index % columns), Tap::at(index / columns)),
        };
        interpolate(&values, map, x, y, &mut feature);
        if feature.iter().all(|value| value.is_finite()) && feature.iter().any(|&x| x != 0.0) {
            let point = depth.intrinsics().back_project(u as f64, v as f64, seen);
            lifted.keypoints.push(point, normalise(&feature));
            lifted.pixels.push((u, v));
        }
    }
    lifted
}

/// The 3-D keypoints that have a lifted keypoint of the same cloud nearer than `max_distance` (the paper's "predefined
/// threshold", metres), each with its nearest one: (index into `keypoints`, index into `lifted`), in the order of
/// `keypoints`. Both in the cloud's own frame.
///
/// ```
/// use rare::{nalgebra::Point3, transfer};
/// let line = |start: f64| (0..5).map(|i| Point3::new(start + f64::from(i), 0.0, 2.0)).collect::<Vec<_>>();
/// let common = transfer::common_points(&line(0.0), &line(1.02), 0.05);
/// assert_eq!(common, [(1, 0), (2, 1), (3, 2), (4, 3)]);
/// ```
#[must_use]
pub fn common_points(
    keypoints: &[Point3<f64>],
    lifted: &[Point3<f64>],
    max_distance: f64,
) -> Vec<(usize, usize)> {
    let tree = KdTree::new(lifted);
    let nearest = |point: &Point3<f64>| Some(tree.nearest_within(point, max_distance)?.index);
    keypoints.iter().enumerate().filter_map(|(i, point)| Some((i, nearest(point)?))).collect()
}

/// The map with the channels running fastest, so that the features of neighbouring cells are four runs of memory.
fn channels_last(map: &FeatureMap) -> Vec<f32> {
    let (channels, cells) = (map.channels(), map.width() * map.height());
    let mut values = vec![0.0; channels * cells];
    for (channel, image) in map.values().chunks_exact(cells).enumerate() {
        for (feature, &value) in values.chunks_exact_mut(channels).zip(image) {
            feature[channel] = value;
        }
    }
    values
}

/// Where a pixel falls between two cells of one axis of the map.
#[derive(Clone, Copy)]
struct Tap {
    low: usize,
    high: usize,
    /// Weight of `high`.
    fraction: f32,
}

impl Tap {
    /// On a cell.
    fn at(cell: usize) -> Tap {
        Tap { low: cell, high: cell, fraction: 0.0 }
    }

    /// With the first and the last pixel on the first and the last cell ("align corners").
    fn new(pixel: usize, pixels: usize, cells: usize) -> Tap {
        let last = cells.saturating_sub(1);
        let position = (pixel * last) as f64 / pixels.saturating_sub(1).max(1) as f64;
        let low = (position as usize).min(last);
        Tap { low, high: (low + 1).min(last), fraction: (position - low as f64) as f32 }
    }
}

/// Bilinear interpolation of all channels; `values` has the channels running fastest.
fn interpolate(values: &[f32], map: &FeatureMap, x: Tap, y: Tap, feature: &mut [f32]) {
    let channels = map.channels();
    let cell =
        |column: usize, row: usize| &values[(row * map.width() + column) * channels..][..channels];
    let (top_left, top_right) = (cell(x.low, y.low), cell(x.high, y.low));
    let (bottom_left, bottom_right) = (cell(x.low, y.high), cell(x.high, y.high));
    for (channel, value) in feature.iter_mut().enumerate() {
        let top = top_left[channel] * (1.0 - x.fraction) + top_right[channel] * x.fraction;
        let bottom = bottom_left[channel] * (1.0 - x.fraction) + bottom_right[channel] * x.fraction;
        *value = top * (1.0 - y.fraction) + bottom * y.fraction;
    }
}
