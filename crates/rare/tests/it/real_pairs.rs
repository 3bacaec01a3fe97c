//! From two raw clouds to a pose on real indoor pairs: voxel grid, normals, FPFH, nearest neighbours, SC2-PCR, ICP.

use std::sync::LazyLock;

use nalgebra::Point3;
use rare::data::{KdTree, resolution, voxel_downsample};
use rare::features::{estimate_normals, fpfh, fpfh_at, orient_towards};
use rare::pose::{Icp, IcpTarget, Sc2Pcr};
use rare::random::Random;
use rare::{Correspondence, PointFeatures, RigidTransform};

use crate::shared::{self, Golden};

const VOXEL: f64 = 0.05;

/// Of the neighbourhoods that FPFH describe, and the points in them, at most.
const RADIUS: f64 = 5.0 * VOXEL;
const MOST: usize = 100;

const NAMES: [&str; 5] =
    ["geo_demo", "kitchen_0_4_raw", "kitchen_1_5_raw", "regtr_hotel_um_8_15", "regtr_scenes_0_5"];

struct Cloud {
    points: Vec<Point3<f64>>,
    normals: Vec<nalgebra::Vector3<f64>>,
    tree: KdTree,
}

impl Cloud {
    fn new(raw: &[Point3<f64>]) -> Cloud {
        let points = voxel_downsample(raw, VOXEL).unwrap();
        let tree = KdTree::new(&points);
        let mut normals = estimate_normals(&points, &tree, 2.0 * VOXEL, 30);
        orient_towards(&mut normals, &points, &Point3::origin());
        Cloud { points, normals, tree }
    }
}

/// The closest row of `all` for each row of `asked`.
fn nearest_rows(asked: &PointFeatures, all: &PointFeatures) -> Vec<Correspondence> {
    let distance =
        |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(x, y)| (x - y).powi(2)).sum::<f32>();
    let closest = |feature: &[f32]| {
        let to = |i: &usize| distance(feature, all.feature(*i));
        (0..all.len()).min_by(|a, b| to(a).total_cmp(&to(b))).unwrap()
    };
    (0..asked.len())
        .map(|i| Correspondence {
            source: asked.points()[i],
            target: all.points()[closest(asked.feature(i))],
            score: 1.0,
        })
        .collect()
}

fn load(name: &str) -> Option<(Cloud, Cloud, RigidTransform)> {
    let mut pair = Golden::open_path(shared::path(&format!("data/pairs/{name}.npz"))?)?;
    let source = Cloud::new(&pair.array("src").points());
    let target = Cloud::new(&pair.array("ref").points());
    Some((source, target, RigidTransform::from_matrix(&pair.array("gt").matrix4()).unwrap()))
}

fn features(cloud: &Cloud) -> PointFeatures {
    fpfh(&cloud.points, &cloud.normals, &cloud.tree, RADIUS, MOST).unwrap()
}

/// The matches of 1000 random source points.
fn random_matches(source: &Cloud, target: &PointFeatures, seed: u64) -> Vec<Correspondence> {
    let sampled = Random::new(seed, 0).sample(1000, source.points.len());
    let asked = fpfh_at(&source.points, &source.normals, &source.tree, RADIUS, MOST, &sampled);
    nearest_rows(&asked.unwrap(), target)
}

/// A labelled pair of clouds and sets of matches between them.
pub(crate) struct Matches {
    pub(crate) name: &'static str,
    pub(crate) truth: RigidTransform,
    /// One for each seed from 1 on.
    pub(crate) sets: Vec<Vec<Correspondence>>,
}

/// Ten sets of 1000 random matches for each indoor pair, made once; none where the data are missing.
pub(crate) fn matches() -> &'static [Matches] {
    static MATCHES: LazyLock<Vec<Matches>> = LazyLock::new(|| {
        let matches = |name| {
            let (source, target, truth) = load(name)?;
            let target = features(&target);
            let sets = (1..=10).map(|seed| random_matches(&source, &target, seed)).collect();
            Some(Matches { name, truth, sets })
        };
        NAMES.into_iter().filter_map(matches).collect()
    });
    &MATCHES
}

#[test]
fn every_indoor_pair_is_registered_from_its_fpfh_matches() {
    for name in NAMES {
        let Some((source, target, truth)) = load(name) else { return };
        let spacing = resolution(&source.points);
        assert!((0.5 * VOXEL..VOXEL).contains(&spacing), "{name}: spacing {spacing}");

        let pairs = random_matches(&source, &features(&target), 1);
        let found = Sc2Pcr::for_voxel(VOXEL).hypotheses(&pairs, 1).unwrap();
        let coarse = found[0].target_from_source.error_to(&truth);

        let target = IcpTarget::new(target.points, target.normals).unwrap();
        let refined =
            Icp::for_voxel(VOXEL).align(&source.points, &target, &found[0].target_from_source);
        let fine = refined.unwrap().target_from_source.error_to(&truth);
        println!("{name}: sc2-pcr {coarse:?}, icp {fine:?}");
        assert!(coarse.rotation_degrees < 15.0 && coarse.translation < 0.3, "{name}: {coarse:?}");
        assert!(fine.rotation_degrees < 3.0 && fine.translation < 0.15, "{name}: {fine:?}");
    }
}
