//! Bilinear resizing of feature maps.

use crate::data::FeatureMap;
use crate::error::Result;

/// Which points of two grids of different sizes lie on each other.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Corners {
    /// The borders of the images (`align_corners=False` of `PyTorch`): pixel centres lie half a pixel inside.
    HalfPixel,
    /// The centres of the corner pixels (`align_corners=True`).
    Aligned,
}

/// The two neighbours of a place on a side of the old map, and the weight of the second one.
#[derive(Debug, Clone, Copy)]
struct Between {
    first: usize,
    second: usize,
    weight: f32,
}

/// Resizes each channel by bilinear interpolation, without a low-pass filter (the recipe only enlarges).
///
/// # Errors
/// `InvalidInput` if a new side is 0.
pub fn resize_bilinear(
    map: &FeatureMap,
    height: usize,
    width: usize,
    corners: Corners,
) -> Result<FeatureMap> {
    if (map.height(), map.width()) == (height, width) {
        return Ok(map.clone());
    }
    let rows = neighbours(map.height(), height, corners);
    let columns = neighbours(map.width(), width, corners);
    let mut values = Vec::with_capacity(map.channels() * height * width);
    let mut blended = vec![0.0; map.width()];
    for channel in map.values().chunks_exact(map.height() * map.width()) {
        let row = |y: usize| &channel[y * map.width()..(y + 1) * map.width()];
        for y in &rows {
            for ((out, &a), &b) in blended.iter_mut().zip(row(y.first)).zip(row(y.second)) {
                *out = a + y.weight * (b - a);
            }
            values.extend(columns.iter().map(|x| {
                let (a, b) = (blended[x.first], blended[x.second]);
                a + x.weight * (b - a)
            }));
        }
    }
    FeatureMap::new(map.channels(), height, width, values)
}

/// Where the pixels of a new side lie on an old side of at least one pixel.
fn neighbours(old: usize, new: usize, corners: Corners) -> Vec<Between> {
    let last = old - 1;
    let scale = match corners {
        Corners::HalfPixel => old as f32 / new as f32,
        Corners::Aligned => last as f32 / new.saturating_sub(1).max(1) as f32,
    };
    let place = |index: usize| match corners {
        Corners::HalfPixel => (index as f32 + 0.5) * scale - 0.5,
        Corners::Aligned => index as f32 * scale,
    };
    (0..new)
        .map(|index| {
            let place = place(index).clamp(0.0, last as f32);
            let first = (place as usize).min(last);
            let weight = place - first as f32;
            Between { first, second: (first + 1).min(last), weight }
        })
        .collect()
}
