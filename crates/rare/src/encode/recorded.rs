//! Features of depth maps that were kept: by this program, or by another one that made them.

use std::collections::BTreeMap;

use nalgebra::Matrix4;

use crate::data::{DepthMap, LayeredFeatures, RigidTransform};
use crate::encode::{DepthEncoder, MAP_NAMES, arrays};
use crate::error::{Error, Result};

/// How far an initial transform may be from the recorded one, in any entry of its matrix.
const SAME_TRANSFORM: f64 = 1e-6;
/// How far a depth map may be from the one that was encoded: share of its pixels that are seen in one alone, and share
/// of the mean depth. Another pair, voxel or camera is further away; the last digit of a transform is not.
const SAME_MAP: f64 = 0.01;

/// Features that were computed before and read from disk.
///
/// They belong to one pair of clouds under one initial transform, because the depth maps do.
#[derive(Debug, Clone, PartialEq)]
pub struct Recorded {
    initial: RigidTransform,
    features: Vec<LayeredFeatures>,
    recording: Option<Recording>,
}

/// What is known of how features were made, for a run that is to use them just so.
#[derive(Debug, Clone, PartialEq)]
pub struct Recording {
    /// The maps that were encoded, in the order of encoding.
    pub maps: Vec<MapSummary>,
    /// Principal components to be kept per layer and view, if any are computed.
    pub components: Option<usize>,
    /// Whether features are to be interpolated with aligned corners.
    pub aligned_corners: bool,
    /// The settings of the encoder in words, for people; JSON where `rare` wrote it.
    pub settings: String,
}

/// So much of a depth map as tells it from others.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MapSummary {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Pixels that have a depth.
    pub seen: usize,
    /// Their mean depth, in the units of the map; 0 where nothing is seen.
    pub mean_depth: f32,
}

/// The names of the maps of a number of virtual views, in the order of encoding: the paper's [`MAP_NAMES`] for two of
/// them, otherwise `view0_ref`, `view0_src`, `view1_ref`, ...
#[must_use]
pub fn map_names(views: usize) -> Vec<String> {
    if 2 * views == MAP_NAMES.len() {
        return MAP_NAMES.map(str::to_owned).to_vec();
    }
    (0..views).flat_map(|view| [format!("view{view}_ref"), format!("view{view}_src")]).collect()
}

impl Recorded {
    /// Takes the initial transform (target from source) under which the maps were made, and the features of each map
    /// in the order of [`DepthEncoder::encode`].
    #[must_use]
    pub fn new(initial: RigidTransform, features: Vec<LayeredFeatures>) -> Recorded {
        Recorded { initial, features, recording: None }
    }

    /// Adds what is known of how the features were made.
    #[must_use]
    pub fn with_recording(mut self, recording: Recording) -> Recorded {
        self.recording = Some(recording);
        self
    }

    /// Takes the named arrays of a feature file (shape and values in C order): `initial`, 4 x 4, and for every name of
    /// [`map_names`] the layers `<name>_layer0`, `<name>_layer1`, ..., channels x height x width; and, all or none of
    /// them, `depth_maps` (maps x 4: width, height, pixels seen, mean depth), `components` (one number, 0 for none),
    /// `aligned_corners` (0 or 1) and `settings` (the bytes of a text).
    ///
    /// # Errors
    /// `InvalidInput` if an array is missing, unknown or of another shape, if `initial` is not rigid, or if the maps
    /// have different numbers of layers.
    pub fn from_arrays(
        initial: &Matrix4<f64>,
        mut arrays: BTreeMap<String, (Vec<usize>, Vec<f32>)>,
    ) -> Result<Recorded> {
        let initial = RigidTransform::from_matrix(initial)?;
        let names = map_names(arrays::count_views(&arrays));
        let recording = arrays::take_recording(&mut arrays, names.len())?;
        let features = arrays::take_features(&names, &mut arrays)?;
        arrays::refuse_rest(&names, &arrays)?;
        Ok(Recorded { initial, features, recording })
    }

    /// The initial transform (target from source) under which the features were recorded.
    #[must_use]
    pub fn initial(&self) -> &RigidTransform {
        &self.initial
    }

    /// The features of each map, in the order of encoding.
    #[must_use]
    pub fn features(&self) -> &[LayeredFeatures] {
        &self.features
    }

    /// What is known of how they were made.
    #[must_use]
    pub fn recording(&self) -> Option<&Recording> {
        self.recording.as_ref()
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

    /// Makes sure that a map is the one that was encoded, as far as that is known.
    fn check_map(&self, index: usize, map: &DepthMap) -> Result<()> {
        let recorded = self.recording.as_ref().and_then(|recording| recording.maps.get(index));
        let (Some(recorded), found) = (recorded, MapSummary::of(map)) else { return Ok(()) };
        if recorded.is_like(&found) {
            return Ok(());
        }
        let name = map_names(self.features.len() / 2).into_iter().nth(index).unwrap_or_default();
        Err(Error::invalid(format!(
            "the features of {name} were recorded from a depth map of {recorded}, this one has {found}: clouds, voxel, camera and preset must be those of the recording"
        )))
    }
}

impl DepthEncoder for Recorded {
    fn encode_at(&self, maps: &[(usize, &DepthMap)]) -> Result<Vec<LayeredFeatures>> {
        let of_map = |&(index, map): &(usize, &DepthMap)| {
            let layers = self.features.get(index).ok_or_else(|| self.wrong_count(index + 1))?;
            self.check_map(index, map)?;
            Ok(layers.clone())
        };
        maps.iter().map(of_map).collect()
    }

    fn encode(&self, maps: &[DepthMap]) -> Result<Vec<LayeredFeatures>> {
        if maps.len() != self.features.len() {
            return Err(self.wrong_count(maps.len()));
        }
        let numbered: Vec<(usize, &DepthMap)> = maps.iter().enumerate().collect();
        self.encode_at(&numbered)
    }
}

impl Recorded {
    fn wrong_count(&self, maps: usize) -> Error {
        Error::invalid(format!(
            "features of {} depth maps were recorded, {maps} maps are to be encoded: recorded features serve the views that they were made for",
            self.features.len()
        ))
    }
}

impl MapSummary {
    /// The summary of a map.
    #[must_use]
    pub fn of(map: &DepthMap) -> MapSummary {
        let seen = map.depth().iter().filter(|&&depth| depth > 0.0);
        let (count, sum) = seen.fold((0, 0.0), |(n, sum), &depth| (n + 1, sum + f64::from(depth)));
        let mean_depth = (sum / f64::from(count.max(1))) as f32;
        MapSummary { width: map.width(), height: map.height(), seen: count as usize, mean_depth }
    }

    fn is_like(&self, other: &MapSummary) -> bool {
        let pixels = self.width as f64 * self.height as f64;
        let depth = f64::from(self.mean_depth);
        (self.width, self.height) == (other.width, other.height)
            && self.seen.abs_diff(other.seen) as f64 <= SAME_MAP * pixels
            && (depth - f64::from(other.mean_depth)).abs() <= SAME_MAP * depth
    }
}

impl std::fmt::Display for MapSummary {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let MapSummary { width, height, seen, mean_depth } = self;
        write!(formatter, "{width} x {height} pixels, {seen} seen at {mean_depth:.3} on average")
    }
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

    /// The arrays of two numbered views and how they were made, as `numpy` would hand them over.
    fn described_arrays() -> Arrays {
        let (paper, numbered) = (map_names(2), map_names(3));
        assert_eq!((paper[1].as_str(), numbered[5].as_str()), ("refview_src", "view2_src"));
        let layer = |name: &String| (format!("{name}_layer0"), (vec![1, 1, 1], vec![1.0]));
        let mut arrays: Arrays = numbered.iter().map(layer).collect();
        let rows = [2.0, 2.0, 3.0, 1.5].repeat(6);
        arrays.insert("depth_maps".to_owned(), (vec![6, 4], rows));
        arrays.insert("components".to_owned(), (vec![1], vec![0.0]));
        arrays.insert("aligned_corners".to_owned(), (vec![1], vec![1.0]));
        arrays.insert("settings".to_owned(), (vec![2], vec![f32::from(b'{'), f32::from(b'}')]));
        arrays
    }

    #[test]
    fn any_number_of_views_and_how_they_were_made_are_read() {
        let recorded = Recorded::from_arrays(&Matrix4::identity(), described_arrays()).unwrap();
        let recording = recorded.recording().unwrap();
        assert_eq!((recorded.features().len(), recording.maps.len()), (6, 6));
        assert_eq!((recording.components, recording.aligned_corners), (None, true));
        assert_eq!(recording.settings, "{}");
        for (name, word) in [("settings", "no array settings"), ("depth_maps", "no array depth")] {
            let mut arrays = described_arrays();
            arrays.remove(name);
            let error = Recorded::from_arrays(&Matrix4::identity(), arrays).unwrap_err();
            assert!(error.to_string().contains(word), "{error}");
        }
        let mut arrays = described_arrays();
        arrays.insert("depth_maps".to_owned(), (vec![4, 4], vec![0.0; 16]));
        let error = Recorded::from_arrays(&Matrix4::identity(), arrays).unwrap_err().to_string();
        assert!(error.contains("depth_maps has the shape [4, 4], [6, 4]"), "{error}");
    }

    #[test]
    fn another_depth_map_is_refused() {
        let recorded = Recorded::from_arrays(&Matrix4::identity(), described_arrays()).unwrap();
        let map = |width, depths: [f32; 4]| {
            let intrinsics = Intrinsics { width, height: 4 / width, ..Intrinsics::indoor() };
            DepthMap::new(intrinsics, depths.to_vec()).unwrap()
        };
        assert!(recorded.encode_at(&[(3, &map(2, [1.0, 2.0, 1.51, 0.0]))]).is_ok());
        for other in [
            map(2, [1.0, 2.0, 1.6, 0.0]),
            map(2, [1.0, 2.0, 1.5, 1.5]),
            map(1, [1.0, 2.0, 1.5, 0.0]),
        ] {
            let message = recorded.encode_at(&[(3, &other)]).unwrap_err().to_string();
            assert!(message.contains("view1_src") && message.contains("voxel"), "{message}");
        }
        assert!(recorded.encode_at(&[(6, &map(2, [1.0; 4]))]).is_err());
    }
}
