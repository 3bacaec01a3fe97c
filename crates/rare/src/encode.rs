//! Step 3: depth maps become dense features (paper section "Stable Diffusion and ControlNet", "Depth Diffusion
//! Feature Extraction").
//!
//! [`DepthEncoder`] is the seam between the geometry of this crate and whatever makes features of a depth map: a
//! diffusion network, the built-in features, or a file that another program wrote ([`Recorded`]).

use std::collections::BTreeMap;

use nalgebra::Matrix4;

use crate::data::{DepthMap, FeatureMap, LayeredFeatures, RigidTransform};
use crate::error::{Error, Result};

/// How far an initial transform may be from the recorded one, in any entry of its matrix.
const SAME_TRANSFORM: f64 = 1e-6;

/// The maps of the paper's two views, in the order of encoding: for each virtual view, first what it sees of the
/// reference cloud, then what it sees of the source cloud.
pub const MAP_NAMES: [&str; 4] = ["refview_ref", "refview_src", "srcview_ref", "srcview_src"];

/// Makes dense features of depth maps.
pub trait DepthEncoder: Send + Sync {
    /// Encodes all maps of one registration: for each virtual view, the map of the reference cloud, then that of the
    /// source cloud (see [`MAP_NAMES`]). Gives one [`LayeredFeatures`] per map, in that order, with the same number
    /// of layers for all of them.
    ///
    /// # Errors
    /// Whatever keeps the encoder from working, in the words of [`Error`].
    fn encode(&self, maps: &[DepthMap]) -> Result<Vec<LayeredFeatures>>;
}

/// Features that were computed elsewhere and read from disk.
///
/// They belong to one pair of clouds under one initial transform, because the depth maps do.
#[derive(Debug, Clone, PartialEq)]
pub struct Recorded {
    initial: RigidTransform,
    features: Vec<LayeredFeatures>,
}

impl Recorded {
    /// Takes the initial transform (target from source) under which the maps were made, and the features of each map
    /// in the order of [`DepthEncoder::encode`].
    #[must_use]
    pub fn new(initial: RigidTransform, features: Vec<LayeredFeatures>) -> Recorded {
        Recorded { initial, features }
    }

    /// Takes the named arrays of a feature file (shape and values in C order): `initial`, 4 x 4, and for every name in
    /// [`MAP_NAMES`] the layers `<name>_layer0`, `<name>_layer1`, ..., channels x height x width.
    ///
    /// # Errors
    /// `InvalidInput` if an array is missing, unknown or of another shape, if `initial` is not rigid, or if the maps
    /// have different numbers of layers.
    pub fn from_arrays(
        initial: &Matrix4<f64>,
        mut arrays: BTreeMap<String, (Vec<usize>, Vec<f32>)>,
    ) -> Result<Recorded> {
        let initial = RigidTransform::from_matrix(initial)?;
        let features = MAP_NAMES
            .iter()
            .map(|name| take_layers(name, &mut arrays))
            .collect::<Result<Vec<LayeredFeatures>>>()?;
        check_layers(&features)?;
        if let Some(name) = arrays.keys().next() {
            return Err(Error::invalid(format!(
                "unexpected array {name}: layers are named <map>_layer<k> with a map of {} and k = 0, 1, ... without a gap",
                MAP_NAMES.join(", ")
            )));
        }
        Ok(Recorded { initial, features })
    }

    /// The initial transform (target from source) under which the features were recorded.
    #[must_use]
    pub fn initial(&self) -> &RigidTransform {
        &self.initial
    }

    /// Makes sure that the features belong to this initial transform (target from source).
    ///
    /// # Errors
    /// `InvalidInput` if an entry of its matrix differs from the recorded one by more than 1e-6.
    pub fn check_initial(&self, target_from_source: &RigidTransform) -> Result<()> {
        let difference = (target_from_source.to_matrix() - self.initial.to_matrix()).abs();
        // What is not a number is not small either.
        if difference.iter().all(|&entry| entry <= SAME_TRANSFORM) {
            return Ok(());
        }
        Err(Error::invalid(format!(
            "the features were recorded under another initial transform (an entry differs by {:.2e}): pass the recorded one, or record the features anew",
            difference.max()
        )))
    }
}

impl DepthEncoder for Recorded {
    fn encode(&self, maps: &[DepthMap]) -> Result<Vec<LayeredFeatures>> {
        if maps.len() != self.features.len() {
            return Err(Error::invalid(format!(
                "features of {} depth maps were recorded, {} maps are to be encoded: recorded features serve the views that they were made for",
                self.features.len(),
                maps.len()
            )));
        }
        Ok(self.features.clone())
    }
}

/// Takes the layers of one map out of the arrays.
fn take_layers(
    name: &str,
    arrays: &mut BTreeMap<String, (Vec<usize>, Vec<f32>)>,
) -> Result<LayeredFeatures> {
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
fn check_layers(features: &[LayeredFeatures]) -> Result<()> {
    let count = features.first().map_or(0, Vec::len);
    for (name, layers) in MAP_NAMES.iter().zip(features) {
        if layers.is_empty() {
            return Err(Error::invalid(format!("there is no array {name}_layer0")));
        }
        if layers.len() != count {
            return Err(Error::invalid(format!(
                "{name} has {} layers, {} has {count}: all maps must have the same",
                layers.len(),
                MAP_NAMES[0]
            )));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;
    use crate::data::Intrinsics;

    type Arrays = BTreeMap<String, (Vec<usize>, Vec<f32>)>;

    fn arrays() -> Arrays {
        MAP_NAMES
            .iter()
            .enumerate()
            .flat_map(|(map, name)| {
                (0..2).map(move |layer| {
                    let value = (10 * map + layer) as f32;
                    (format!("{name}_layer{layer}"), (vec![1, 1, 2], vec![value; 2]))
                })
            })
            .collect()
    }

    #[test]
    fn recorded_features_come_back_in_the_order_of_the_maps() {
        let recorded = Recorded::from_arrays(&Matrix4::identity(), arrays()).unwrap();
        let map = DepthMap::empty(Intrinsics::indoor());
        let features = recorded.encode(&vec![map.clone(); 4]).unwrap();
        for (index, layers) in features.iter().enumerate() {
            let values: Vec<f32> = layers.iter().map(|layer| layer.values()[1]).collect();
            assert_eq!(values, [10.0 * index as f32, 10.0 * index as f32 + 1.0]);
        }
        let message = recorded.encode(&[map]).unwrap_err().to_string();
        assert!(message.contains("4 depth maps") && message.contains("1 maps"), "{message}");
    }

    #[test]
    fn another_initial_transform_is_refused() {
        let initial = RigidTransform::from_translation(Vector3::new(1.0, 2.0, 3.0));
        let recorded = Recorded::new(initial, Vec::new());
        let moved = |by| RigidTransform::from_translation(Vector3::new(1.0, 2.0 + by, 3.0));
        assert!(recorded.check_initial(&moved(5e-7)).is_ok());
        for by in [2e-6, f64::NAN] {
            let message = recorded.check_initial(&moved(by)).unwrap_err().to_string();
            assert!(message.contains("another initial transform"), "{message}");
        }
    }

    #[test]
    fn arrays_that_do_not_fit_are_named() {
        let change = |change: fn(&mut Arrays)| {
            let mut arrays = arrays();
            change(&mut arrays);
            Recorded::from_arrays(&Matrix4::identity(), arrays).unwrap_err().to_string()
        };
        for (message, word) in [
            (
                change(|arrays| drop(arrays.remove("srcview_ref_layer1"))),
                "srcview_ref has 1 layers",
            ),
            (
                change(|arrays| drop(arrays.remove("refview_src_layer0"))),
                "no array refview_src_layer0",
            ),
            (change(|arrays| drop(arrays.insert("side".to_owned(), (vec![1], vec![0.0])))), "side"),
            (
                change(|arrays| {
                    drop(arrays.insert("refview_ref_layer1".to_owned(), (vec![2], vec![0.0; 2])));
                }),
                "refview_ref_layer1 has shape [2]",
            ),
        ] {
            assert!(message.contains(word), "{message}");
        }
        let scaled = Matrix4::identity() * 2.0;
        assert!(Recorded::from_arrays(&scaled, arrays()).is_err());
    }
}
