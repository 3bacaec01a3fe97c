//! Depth maps, features and masks as images that people can read.

use rare::data::FeatureMap;
use rare::verify::{Visibility, VisibilityMask};
use rare::{DepthMap, refine::IllustratedMap};

/// Anchors of the colour map viridis, evenly spaced: it grows evenly in lightness and colour-blind people read it alike.
const VIRIDIS: [[f32; 3]; 9] = [
    [68.0, 1.0, 84.0],
    [71.0, 44.0, 122.0],
    [59.0, 81.0, 139.0],
    [44.0, 113.0, 142.0],
    [33.0, 144.0, 141.0],
    [39.0, 173.0, 129.0],
    [92.0, 200.0, 99.0],
    [170.0, 220.0, 50.0],
    [253.0, 231.0, 37.0],
];
/// Where nothing was seen: white on paper, transparent in files. No other colour is quite white.
pub(crate) const NOTHING: [u8; 3] = [255; 3];
/// Agreement, occlusion and free-space violation, from the palette of Okabe and Ito.
pub(crate) const AGREE: [u8; 3] = [0, 158, 115];
pub(crate) const OCCLUDED: [u8; 3] = [86, 180, 233];
pub(crate) const VIOLATION: [u8; 3] = [213, 94, 0];
/// Values beyond this share at either end do not stretch the colours.
const OUTLYING: f32 = 0.01;

/// An image, row by row.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Image {
    pub(crate) width: usize,
    pub(crate) height: usize,
    /// Red, green, blue.
    pub(crate) pixels: Vec<[u8; 3]>,
}

/// The colour of a share from 0 to 1.
pub(crate) fn viridis(share: f32) -> [u8; 3] {
    let place = share.clamp(0.0, 1.0) * (VIRIDIS.len() - 1) as f32;
    let lower = (place as usize).min(VIRIDIS.len() - 2);
    let rest = place - lower as f32;
    std::array::from_fn(|channel| {
        let (from, to) = (VIRIDIS[lower][channel], VIRIDIS[lower + 1][channel]);
        (from + (to - from) * rest).round() as u8
    })
}

/// The depths, metres, between which the colours of both maps of a view are spread; `None` if nothing is seen.
pub(crate) fn depth_range(maps: [&IllustratedMap; 2]) -> Option<[f32; 2]> {
    let seen = maps.iter().flat_map(|map| map.sparse.depth());
    let mut seen: Vec<f32> = seen.copied().filter(|&depth| depth > 0.0).collect();
    seen.sort_by(f32::total_cmp);
    within_bulk(&seen)
}

/// A depth map; near is bright.
pub(crate) fn depth_image(map: &DepthMap, range: Option<[f32; 2]>) -> Image {
    let [near, far] = range.unwrap_or([0.0, 1.0]);
    let span = (far - near).max(f32::MIN_POSITIVE);
    let colour = |&depth: &f32| {
        if depth > 0.0 { viridis(1.0 - (depth - near) / span) } else { NOTHING }
    };
    let pixels = map.depth().iter().map(colour).collect();
    Image { width: map.width(), height: map.height(), pixels }
}

/// Depths in grey, as a ground on which lines are drawn; near is bright.
pub(crate) fn grey_depth_image(map: &DepthMap, range: Option<[f32; 2]>) -> Image {
    let [near, far] = range.unwrap_or([0.0, 1.0]);
    let span = (far - near).max(f32::MIN_POSITIVE);
    let colour = |&depth: &f32| {
        let share = 1.0 - ((depth - near) / span).clamp(0.0, 1.0);
        if depth > 0.0 { [(70.0 + 165.0 * share) as u8; 3] } else { NOTHING }
    };
    let pixels = map.depth().iter().map(colour).collect();
    Image { width: map.width(), height: map.height(), pixels }
}

/// The three components of the features of both maps of a view as red, green and blue, stretched alike.
pub(crate) fn feature_images(maps: [&FeatureMap; 2]) -> [Image; 2] {
    let ranges: [Option<[f32; 2]>; 3] = std::array::from_fn(|channel| {
        let known = maps.iter().flat_map(|map| known_values(map, channel));
        let mut known: Vec<f32> = known.collect();
        known.sort_by(f32::total_cmp);
        within_bulk(&known)
    });
    maps.map(|map| feature_image(map, &ranges))
}

fn feature_image(map: &FeatureMap, ranges: &[Option<[f32; 2]>; 3]) -> Image {
    let pixels = (0..map.width() * map.height()).map(|pixel| {
        if !is_known(map, pixel) {
            return NOTHING;
        }
        std::array::from_fn(|channel| {
            let [low, high] = ranges[channel].unwrap_or([0.0, 1.0]);
            let share = (value(map, channel, pixel) - low) / (high - low).max(f32::MIN_POSITIVE);
            (40.0 + 210.0 * share.clamp(0.0, 1.0)) as u8
        })
    });
    Image { width: map.width(), height: map.height(), pixels: pixels.collect() }
}

/// What a camera says of the cloud that was moved into it.
pub(crate) fn mask_image(mask: &VisibilityMask) -> Image {
    let pixels = mask.pixels.iter().map(|&visibility| match visibility {
        Visibility::Unseen => NOTHING,
        Visibility::Agree => AGREE,
        Visibility::Occluded => OCCLUDED,
        Visibility::Violation | Visibility::GrossViolation => VIOLATION,
    });
    Image { width: mask.width, height: mask.height, pixels: pixels.collect() }
}

/// The range of sorted values without the outlying ones; `None` if there are none.
fn within_bulk(sorted: &[f32]) -> Option<[f32; 2]> {
    let last = sorted.len().checked_sub(1)?;
    let cut = (last as f32 * OUTLYING) as usize;
    Some([*sorted.get(cut)?, *sorted.get(last - cut)?])
}

fn known_values(map: &FeatureMap, channel: usize) -> impl Iterator<Item = f32> + '_ {
    let pixels = (0..map.width() * map.height()).filter(|&pixel| is_known(map, pixel));
    pixels.map(move |pixel| value(map, channel, pixel))
}

/// A pixel whose features are all 0 has none.
fn is_known(map: &FeatureMap, pixel: usize) -> bool {
    (0..map.channels()).any(|channel| value(map, channel, pixel) != 0.0)
}

/// Of features with fewer than three components the others are 0.
fn value(map: &FeatureMap, channel: usize, pixel: usize) -> f32 {
    let size = map.width() * map.height();
    let found = (channel < map.channels()).then(|| map.values().get(channel * size + pixel));
    found.flatten().copied().unwrap_or(0.0)
}

impl Image {
    /// The image as a PNG file, transparent where nothing was seen.
    ///
    /// # Errors
    /// If the encoder refuses the size.
    pub(crate) fn to_png(&self) -> Result<Vec<u8>, png::EncodingError> {
        let mut file = Vec::new();
        let mut encoder = png::Encoder::new(&mut file, self.width as u32, self.height as u32);
        encoder.set_color(png::ColorType::Rgba);
        encoder.set_depth(png::BitDepth::Eight);
        let mut writer = encoder.write_header()?;
        let opaque = |pixel: &[u8; 3]| if *pixel == NOTHING { 0 } else { 255 };
        let pixels = self.pixels.iter().map(|pixel| [pixel[0], pixel[1], pixel[2], opaque(pixel)]);
        writer.write_image_data(pixels.collect::<Vec<_>>().as_flattened())?;
        writer.finish()?;
        Ok(file)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_colours_run_from_end_to_end() {
        assert_eq!(viridis(-1.0), [68, 1, 84]);
        assert_eq!(viridis(1.0), [253, 231, 37]);
        assert_eq!(viridis(0.5), [33, 144, 141]);
        // Lightness never falls.
        let light = |share: f32| {
            let [red, green, blue] = viridis(share).map(f32::from);
            0.21 * red + 0.72 * green + 0.07 * blue
        };
        for step in 0..100 {
            assert!(light(step as f32 / 100.0) <= light((step + 1) as f32 / 100.0) + 0.5);
        }
    }

    #[test]
    fn features_are_stretched_alike_and_unknown_pixels_stay_empty() {
        let map = |values: Vec<f32>| FeatureMap::new(3, 1, 2, values).unwrap();
        let first = map(vec![0.0, 2.0, 0.0, -1.0, 0.0, 0.0]);
        let second = map(vec![4.0, 2.0, 1.0, -1.0, 0.0, 0.0]);
        let [a, b] = feature_images([&first, &second]);
        assert_eq!(a.pixels[0], NOTHING);
        assert_eq!(a.pixels[1], b.pixels[1]);
        assert!(b.pixels[0][0] > b.pixels[1][0] && b.pixels[0][1] > b.pixels[1][1]);
    }

    #[test]
    fn an_image_comes_back_from_its_file() {
        let pixels = vec![[1, 2, 3], [4, 5, 6], [7, 8, 9], [0, 255, 0], NOTHING, [1, 0, 1]];
        let image = Image { width: 3, height: 2, pixels };
        let file = image.to_png().unwrap();
        let mut reader = png::Decoder::new(std::io::Cursor::new(file)).read_info().unwrap();
        let mut bytes = vec![0; reader.output_buffer_size().unwrap()];
        reader.next_frame(&mut bytes).unwrap();
        for (found, pixel) in bytes.as_chunks::<4>().0.iter().zip(&image.pixels) {
            assert_eq!(found[..3], pixel[..]);
            assert_eq!(found[3] == 0, *pixel == NOTHING);
        }
        assert_eq!(bytes.len(), 24);
    }
}
