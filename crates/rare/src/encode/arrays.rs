//! Recorded features as the named arrays of a file.

use std::collections::BTreeMap;

use crate::data::{FeatureMap, LayeredFeatures};
use crate::encode::{MAP_NAMES, MapSummary, Recording};
use crate::error::{Error, Result};

/// Named arrays: shape and values in C order.
type Arrays = BTreeMap<String, (Vec<usize>, Vec<f32>)>;

/// Two views, or as many as there are numbered ones.
pub(super) fn count_views(arrays: &Arrays) -> usize {
    let numbered = |view: &usize| arrays.contains_key(&format!("view{view}_ref_layer0"));
    match (0..arrays.len()).take_while(numbered).count() {
        0 => MAP_NAMES.len() / 2,
        views => views,
    }
}

/// Takes what is known of how the features were made, if anything.
pub(super) fn take_recording(arrays: &mut Arrays, maps: usize) -> Result<Option<Recording>> {
    const NAMES: [&str; 4] = ["depth_maps", "components", "aligned_corners", "settings"];
    if !NAMES.iter().any(|&name| arrays.contains_key(name)) {
        return Ok(None);
    }
    let mut take = |name: &str, shape: &[usize]| match arrays.remove(name) {
        Some((found, values)) if found == shape || shape.is_empty() => Ok(values),
        Some((found, _)) => {
            Err(Error::invalid(format!("{name} has the shape {found:?}, {shape:?} is needed")))
        }
        None => Err(Error::invalid(format!(
            "there is no array {name}: {} are written together",
            NAMES.join(", ")
        ))),
    };
    let (summaries, components) = (take(NAMES[0], &[maps, 4])?, take(NAMES[1], &[1])?);
    let (aligned, settings) = (take(NAMES[2], &[1])?, take(NAMES[3], &[])?);
    let summary = |row: &[f32; 4]| {
        let [width, height, seen, mean_depth] = *row;
        let [width, height, seen] = [width, height, seen].map(|count| count as usize);
        MapSummary { width, height, seen, mean_depth }
    };
    let settings: Vec<u8> = settings.into_iter().map(|byte| byte as u8).collect();
    Ok(Some(Recording {
        maps: summaries.as_chunks().0.iter().map(summary).collect(),
        components: components.first().map(|&count| count as usize).filter(|&count| count > 0),
        aligned_corners: aligned.first().is_some_and(|&switch| switch != 0.0),
        settings: String::from_utf8_lossy(&settings).into_owned(),
    }))
}

/// Takes the layers of all maps out of the arrays.
pub(super) fn take_features(names: &[String], arrays: &mut Arrays) -> Result<Vec<LayeredFeatures>> {
    let of_map = |name: &String| take_layers(name, arrays);
    let features = names.iter().map(of_map).collect::<Result<Vec<LayeredFeatures>>>()?;
    check_layers(names, &features)?;
    Ok(features)
}

/// A misspelt layer would otherwise go unnoticed.
pub(super) fn refuse_rest(names: &[String], arrays: &Arrays) -> Result<()> {
    match arrays.keys().next() {
        Some(name) => Err(Error::invalid(format!(
            "unexpected array {name}: layers are named <map>_layer<k> with a map of {} and k = 0, 1, ... without a gap",
            names.join(", ")
        ))),
        None => Ok(()),
    }
}

/// Takes the layers of one map out of the arrays.
fn take_layers(name: &str, arrays: &mut Arrays) -> Result<LayeredFeatures> {
    let mut layers = LayeredFeatures::new();
    while let Some((shape, values)) = arrays.remove(&format!("{name}_layer{}", layers.len())) {
        let [channels, height, width] = shape[..] else {
            return Err(Error::invalid(format!(
                "array {name}_layer{} has shape {shape:?}, not channels x height x width",
                layers.len()
            )));
        };
        layers.push(FeatureMap::new(channels, height, width, values)?);
    }
    Ok(layers)
}

/// All maps must have the same layers, and at least one.
fn check_layers(names: &[String], features: &[LayeredFeatures]) -> Result<()> {
    let count = features.first().map_or(0, Vec::len);
    for (name, layers) in names.iter().zip(features) {
        if layers.is_empty() {
            return Err(Error::invalid(format!("there is no array {name}_layer0")));
        }
        if layers.len() != count {
            return Err(Error::invalid(format!(
                "{name} has {} layers, {} has {count}: all maps must have the same",
                layers.len(),
                names[0]
            )));
        }
    }
    Ok(())
}
