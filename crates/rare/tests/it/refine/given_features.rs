//! Features, correspondences and depth-map features that the caller brings.

use super::{default, paper, room};
use nalgebra::Point3;
use rare::data::{KdTree, LayeredFeatures, voxel_downsample};
use rare::encode::DepthEncoder;
use rare::features::{estimate_normals, fpfh_at, orient_towards};
use rare::random::Random;
use rare::{Correspondence, DepthMap, FeatureMap, Refiner, RigidTransform, Scan};

/// Fast point feature histograms as a registration method would bring them.
fn with_histograms(scan: &Scan) -> Scan {
    let points = voxel_downsample(scan.cloud.points(), 0.06).unwrap();
    let tree = KdTree::new(&points);
    let mut normals = estimate_normals(&points, &tree, 0.12, 30);
    orient_towards(&mut normals, &points, &Point3::origin());
    let chosen = Random::new(3, 0).sample(800, points.len());
    let features = fpfh_at(&points, &normals, &tree, 0.3, 100, &chosen).unwrap();
    Scan { cloud: scan.cloud.clone(), features: Some(features) }
}

#[test]
fn features_of_another_method_are_used() {
    let pair = room();
    let (source, target) = (with_histograms(&pair.source), with_histograms(&pair.target));
    let refinement = Refiner::new(default()).refine(&source, &target, &pair.initial).unwrap();
    let (degrees, metres) = pair.error(&refinement.target_from_source);
    assert!(degrees < 1.5 && metres < 0.05, "{degrees} {metres}");
    assert_ne!(refinement.sets[4], pair.refined(default()).sets[4]);
    let alone = Refiner::new(default()).refine(&source, &pair.target, &pair.initial).unwrap_err();
    assert!(alone.to_string().contains("only one"), "{alone}");
}

#[test]
fn correspondences_of_another_method_take_the_place_of_3d_matches() {
    let pair = room();
    let chosen = pair.source.cloud.points().iter().step_by(500);
    let given: Vec<Correspondence> = chosen
        .map(|point| Correspondence { source: *point, target: pair.truth.apply(point), score: 1.0 })
        .collect();
    let matched = |given: &[Correspondence]| {
        let refiner = Refiner::new(default());
        refiner.refine_matched(&pair.source, &pair.target, &pair.initial, given).unwrap()
    };
    let refinement = matched(&given);
    let (degrees, metres) = pair.error(&refinement.target_from_source);
    assert!(degrees < 1.5 && metres < 0.05, "{degrees} {metres}");
    let set = refinement.sets[4];
    assert_eq!((set.correspondences, set.inliers), (given.len(), given.len()));
    assert_eq!(matched(&[]).sets[4].correspondences, 0);
}

/// Knows where a pixel's surface lies in the room: features are cosines of the position in a common frame.
struct Positions {
    /// The frame of the target, from each map's camera, in the order of the maps.
    common_from_camera: [RigidTransform; 4],
}

impl DepthEncoder for Positions {
    fn encode_at(&self, maps: &[(usize, &DepthMap)]) -> rare::Result<Vec<LayeredFeatures>> {
        maps.iter().map(|&(index, map)| self.encode_map(index, map)).collect()
    }
}

impl Positions {
    fn encode_map(&self, index: usize, map: &DepthMap) -> rare::Result<LayeredFeatures> {
        let common_from_camera = &self.common_from_camera[index];
        let (columns, rows) = (map.width() / 10, map.height() / 10);
        let feature = |cell: usize| -> Vec<f32> {
            let (u, v) = (cell % columns * 10 + 5, cell / columns * 10 + 5);
            let camera = map.intrinsics();
            let seen = camera.back_project(u as f64, v as f64, f64::from(map.at(u, v)));
            let place = common_from_camera.apply(&seen);
            place.iter().flat_map(|x| [x.sin() as f32, x.cos() as f32]).collect()
        };
        let features: Vec<Vec<f32>> = (0..columns * rows).map(feature).collect();
        let values = (0..6).flat_map(|c| features.iter().map(move |f| f[c])).collect();
        Ok(vec![FeatureMap::new(6, rows, columns, values)?])
    }
}

/// With features that know the place, the paper's recipe has nothing left to do but its geometry.
#[test]
fn perfect_features_give_the_truth() {
    let pair = room();
    // Cameras at the origins of the clouds; the other cloud stands where the start puts it.
    let identity = RigidTransform::identity();
    let common_from_camera =
        [identity, pair.truth * pair.initial.inverse(), pair.initial, pair.truth];
    let positions = Positions { common_from_camera };
    let mut config = paper();
    // Features as they are, one per cell: principal components of two views would mix the six numbers.
    config.recipe.components = None;
    config.recipe.aligned_corners = false;
    let refiner = Refiner::new(config).with_encoder(Box::new(positions));
    let refinement = refiner.refine(&pair.source, &pair.target, &pair.initial).unwrap();
    let (degrees, metres) = pair.error(&refinement.target_from_source);
    println!("perfect features: {degrees} {metres} {:?}", refinement.sets);
    assert!(degrees < 0.3 && metres < 0.01, "{degrees} {metres}");
}
