//! Step 4: features of fewer channels, and one map out of several layers (paper section "Stable Diffusion and
//! ControlNet": "we employ principal component analysis (PCA) to reduce the dimensionality of the feature maps for
//! each layer. The reduced feature maps are then upsampled to the same resolution and combined").
//!
//! The two maps of a view are reduced together, because only then are their features comparable; features of different
//! views never are. A pixel whose features are all 0 has no features ("nothing is known here"): it takes no part in
//! the analysis and stays 0, where a literal reading would move it to minus the mean and let such pixels match each
//! other. The paper's network never makes such pixels, so nothing changes for it.

mod pca;
mod resize;

pub use pca::JointPca;
pub use resize::{Corners, resize_bilinear};

use pca::Columns;

use crate::data::{FeatureMap, LayeredFeatures};
use crate::error::{Error, Result};

/// How many components of each layer are kept (FreeReg).
pub const DEFAULT_COMPONENTS: usize = 128;

/// Reduces the layers of the two maps of one view and merges them: `components` channels of each layer (all of them
/// where it has fewer), enlarged to the largest layer, one after the other. With `None` there is no analysis: features
/// are normalised, enlarged and joined.
///
/// # Errors
/// `InvalidInput` if the two have no layers, different numbers of layers or of channels, features that are not finite,
/// or if no components are to be kept.
pub fn reduce(
    a: &LayeredFeatures,
    b: &LayeredFeatures,
    components: Option<usize>,
) -> Result<(FeatureMap, FeatureMap)> {
    if a.len() != b.len() || a.is_empty() {
        return Err(Error::invalid(format!(
            "the two maps of a view have {} and {} layers: both must have the same, and at least one",
            a.len(),
            b.len()
        )));
    }
    let (height, width) = largest(a.iter().chain(b));
    let (mut merged_a, mut merged_b) = (Vec::new(), Vec::new());
    for (a, b) in a.iter().zip(b) {
        let (a, b) = reduce_layer(a, b, components)?;
        merged_a.push(resize_bilinear(&a, height, width, Corners::HalfPixel)?);
        merged_b.push(resize_bilinear(&b, height, width, Corners::HalfPixel)?);
    }
    Ok((concatenate(&merged_a, height, width)?, concatenate(&merged_b, height, width)?))
}

/// Merges the layers of one map alone, without analysis: a single layer as it is, several normalised, enlarged to the
/// largest and joined.
///
/// # Errors
/// `InvalidInput` if there is no layer, or features are not finite.
pub fn merge(layers: &LayeredFeatures) -> Result<FeatureMap> {
    if let [only] = layers.as_slice() {
        return Ok(only.clone());
    }
    let (height, width) = largest(layers.iter());
    let enlarged = |layer: &FeatureMap| {
        let layer = Columns::normalised(layer)?.to_map()?;
        resize_bilinear(&layer, height, width, Corners::HalfPixel)
    };
    concatenate(&layers.iter().map(enlarged).collect::<Result<Vec<_>>>()?, height, width)
}

/// Reduces one layer of the two maps of a view.
fn reduce_layer(
    a: &FeatureMap,
    b: &FeatureMap,
    components: Option<usize>,
) -> Result<(FeatureMap, FeatureMap)> {
    let (columns_a, columns_b) = (Columns::normalised(a)?, Columns::normalised(b)?);
    match components {
        Some(components) => {
            let pca = JointPca::fit_columns(&columns_a, &columns_b, components)?;
            Ok((pca.project_columns(&columns_a)?, pca.project_columns(&columns_b)?))
        }
        None => Ok((columns_a.to_map()?, columns_b.to_map()?)),
    }
}

/// Rows and columns of the layer with the most pixels (the first of them).
fn largest<'a>(layers: impl Iterator<Item = &'a FeatureMap>) -> (usize, usize) {
    layers.fold((0, 0), |largest, layer| {
        let size = (layer.height(), layer.width());
        if size.0 * size.1 > largest.0 * largest.1 { size } else { largest }
    })
}

/// Joins the channels of maps of the same size.
fn concatenate(maps: &[FeatureMap], height: usize, width: usize) -> Result<FeatureMap> {
    let channels = maps.iter().map(FeatureMap::channels).sum();
    let values = maps.iter().flat_map(FeatureMap::values).copied().collect();
    FeatureMap::new(channels, height, width, values)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn maps_that_do_not_fit_are_refused() {
        let map = |channels: usize, value: f32| {
            vec![FeatureMap::new(channels, 1, 2, vec![value; channels * 2]).unwrap()]
        };
        for (a, b, components, word) in [
            (Vec::new(), Vec::new(), Some(1), "0 and 0 layers"),
            (map(2, 1.0), Vec::new(), None, "1 and 0 layers"),
            (map(2, 1.0), map(3, 1.0), Some(1), "2 and 3 channels"),
            (map(2, 1.0), map(2, f32::NAN), None, "finite"),
            (map(2, 1.0), map(2, 1.0), Some(0), "component"),
        ] {
            let message = reduce(&a, &b, components).unwrap_err().to_string();
            assert!(message.contains(word), "{message}");
        }
    }

    #[test]
    fn pixels_without_features_stay_zero_and_do_not_change_the_others() {
        let known = [[1.0_f32, 0.0, 0.5], [0.0, 2.0, 1.0], [3.0, 1.0, 1.0], [1.0, 1.0, -1.0]];
        let map = |pixels: &[[f32; 3]]| {
            let values = (0..3).flat_map(|channel| pixels.iter().map(move |pixel| pixel[channel]));
            vec![FeatureMap::new(3, 1, pixels.len(), values.collect()).unwrap()]
        };
        let masked = [known[0], [0.0; 3], known[1], [0.0; 3]];
        for components in [None, Some(2), Some(5)] {
            let (plain, _) = reduce(&map(&known[..2]), &map(&known[2..]), components).unwrap();
            let (with_holes, _) = reduce(&map(&masked), &map(&known[2..]), components).unwrap();
            assert_eq!(plain.channels(), components.map_or(3, |count: usize| count.min(3)));
            for channel in 0..plain.channels() {
                let (plain, holes) =
                    (plain.channel(channel).unwrap(), with_holes.channel(channel).unwrap());
                assert_eq!(holes, [plain[0], 0.0, plain[1], 0.0]);
            }
        }
        let empty = map(&[[0.0; 3]; 4]);
        let (a, b) = reduce(&empty, &empty, Some(2)).unwrap();
        assert!(a.values().iter().chain(b.values()).all(|&value| value == 0.0));
    }
}
