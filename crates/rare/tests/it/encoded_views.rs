//! Features that are kept serve a later run just as those made on the spot.

use std::sync::{Arc, Mutex};

use rare::data::LayeredFeatures;
use rare::encode::{DepthEncoder, MAP_NAMES, Recorded, map_names};
use rare::nalgebra::{Point3, Vector3};
use rare::synthetic::{self, ScanPair};
use rare::viewpoints::CameraChoice;
use rare::{DepthMap, FeatureMap, Recipe, Refinement, Refiner, RefinerConfig, Scan};

/// Two scans of a thing on a table, which are few points.
struct Pair {
    source: Scan,
    target: Scan,
    truth: ScanPair,
}

fn pair() -> Pair {
    let truth = synthetic::object_pair(1).unwrap();
    Pair { source: truth.source.clone().into(), target: truth.target.clone().into(), truth }
}

fn one_round(camera: CameraChoice) -> RefinerConfig {
    let recipe = Recipe { rounds: 1, search: false, ..Recipe::default() };
    RefinerConfig { camera, recipe, ..RefinerConfig::default() }
}

/// Several layers of several sizes: depth, its square and the map's position. Remembers the positions.
#[derive(Default)]
struct Layers {
    positions: Mutex<Vec<usize>>,
}

impl DepthEncoder for Layers {
    fn encode_at(&self, maps: &[(usize, &DepthMap)]) -> rare::Result<Vec<LayeredFeatures>> {
        maps.iter().map(|&(index, map)| self.encode_map(index, map)).collect()
    }
}

impl Layers {
    fn encode_map(&self, index: usize, map: &DepthMap) -> rare::Result<LayeredFeatures> {
        self.positions.lock().unwrap().push(index);
        let layer = |cell: usize| {
            let (columns, rows) = (map.width() / cell, map.height() / cell);
            let depth = |at: usize| map.at(at % columns * cell, at / columns * cell);
            let power = |power: i32| (0..rows * columns).map(move |at| depth(at).powi(power));
            let own = std::iter::repeat_n(index as f32 + 1.0, rows * columns);
            let values = power(1).chain(power(2)).chain(own).collect();
            FeatureMap::new(3, rows, columns, values)
        };
        Ok(vec![layer(12)?, layer(8)?])
    }
}

/// The features by way of a file.
fn through_a_file(recorded: &Recorded) -> (Recorded, Vec<String>) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("features.npz");
    rare::io::write_depth_features(&path, recorded).unwrap();
    let names = rare::io::NpzFile::open(&path).unwrap().names();
    (rare::io::read_depth_features(&path).unwrap(), names)
}

fn untimed(refinement: Refinement) -> Refinement {
    Refinement { timings: Vec::new(), ..refinement }
}

/// A run with features that `record` made and one with `use_again`'s settings on them.
#[track_caller]
fn assert_the_same(record: &Refiner, config: &RefinerConfig, views: usize) {
    let pair = pair();
    let (source, target, initial) = (&pair.source, &pair.target, &pair.truth.initial);
    let direct = record.refine(source, target, initial).unwrap();
    let views_of_pair = record.encode_views(source, target, initial).unwrap();
    let recorded = views_of_pair.into_recorded(record, "{}".to_owned());
    let (read, names) = through_a_file(&recorded);
    // Not by `assert_eq`, which would print them all.
    assert!(read.features() == recorded.features(), "the file changed the features");
    assert_eq!(read.recording(), recorded.recording());
    for name in map_names(views) {
        assert!(names.contains(&format!("{name}_layer0")), "{name} is not in {names:?}");
    }
    let recipe = config.recipe.clone().for_recorded(&read);
    let again =
        Refiner::new(RefinerConfig { recipe, ..config.clone() }).with_encoder(Box::new(read));
    let again = again.refine(source, target, initial).unwrap();
    assert_eq!(again.target_from_source, direct.target_from_source);
    assert!(untimed(again) == untimed(direct), "the evidence differs");
}

#[test]
fn recorded_features_give_the_identical_refinement() {
    let config = one_round(CameraChoice::Sensor);
    assert_eq!(map_names(2), MAP_NAMES);
    assert_the_same(&Refiner::new(config.clone()), &config, 2);
}

#[test]
fn so_do_those_of_six_cameras_per_cloud() {
    let config = one_round(CameraChoice::Overlap);
    assert_the_same(&Refiner::new(config.clone()), &config, 12);
}

/// The reduction is that of the recording, whatever the recipe of the later run says.
#[test]
fn so_do_several_layers_that_are_reduced() {
    let config = one_round(CameraChoice::Sensor);
    let recipe = Recipe { components: Some(2), ..config.recipe.clone().for_network() };
    let network = RefinerConfig { recipe, ..config.clone() };
    let record = Refiner::new(network).with_encoder(Box::new(Layers::default()));
    assert_the_same(&record, &config, 2);
}

#[test]
fn features_of_another_pair_are_refused() {
    let pair = pair();
    let refiner = Refiner::new(one_round(CameraChoice::Overlap));
    let views = refiner.encode_views(&pair.source, &pair.target, &pair.truth.initial).unwrap();
    let recorded = views.into_recorded(&refiner, String::new());
    let again = Refiner::new(one_round(CameraChoice::Overlap)).with_encoder(Box::new(recorded));
    // The clouds change places.
    let error = again.refine(&pair.target, &pair.source, &pair.truth.initial).unwrap_err();
    assert!(error.to_string().contains("view0_ref"), "{error}");
}

#[test]
fn features_of_one_cloud_lie_on_it_in_its_own_frame() {
    let pair = pair();
    let far = Vector3::new(500_000.0, 5_400_000.0, 100.0);
    let points = pair.truth.source.world_points().iter().map(|point| point + far).collect();
    let cloud = rare::PointCloud::new(points).unwrap();
    let scan = Scan::from(cloud.clone());
    let layers = Arc::new(Layers::default());
    let config = one_round(CameraChoice::Overlap);
    let refiner = Refiner::new(config).with_encoder(Box::new(Arc::clone(&layers)));
    let features = refiner.point_features(&scan).unwrap();
    // Each map stands where a reference's would.
    assert_eq!(*layers.positions.lock().unwrap(), [0, 2, 4, 6, 8, 10]);
    // Two layers of three channels, joined.
    assert_eq!(features.dimension(), 6);
    let tree = rare::data::KdTree::new(cloud.points());
    let near =
        |point: &&Point3<f64>| tree.nearest_within(&(**point - cloud.shift()), 0.02).is_some();
    let near = features.points().iter().filter(near).count();
    let all = features.len();
    assert!(all > 100 && near as f64 > 0.8 * all as f64, "{near} of {all}");
}
