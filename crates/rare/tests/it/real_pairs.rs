//! From two raw clouds to a pose on real indoor pairs: voxel grid, normals, FPFH, nearest neighbours, SC2-PCR, ICP.

use nalgebra::Point3;
use rare::data::{KdTree, resolution, voxel_downsample};
use rare::features::{estimate_normals, fpfh, fpfh_at, orient_towards};
use rare::pose::{Icp, IcpTarget, Sc2Pcr};
use rare::random::Random;
use rare::{Correspondence, PointFeatures, RigidTransform};

use crate::shared::{self, Golden};

const VOXEL: f64 = 0.05;

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

#[test]
fn every_indoor_pair_is_registered_from_its_fpfh_matches() {
    for name in [
        "geo_demo",
        "kitchen_0_4_raw",
        "kitchen_1_5_raw",
        "regtr_hotel_um_8_15",
        "regtr_scenes_0_5",
    ] {
        let Some(path) = shared::path(&format!("data/pairs/{name}.npz")) else { return };
        let mut pair = Golden::open_path(path).unwrap();
        let source = Cloud::new(&pair.array("src").points());
        let target = Cloud::new(&pair.array("ref").points());
        let truth = RigidTransform::from_matrix(&pair.array("gt").matrix4()).unwrap();
        let spacing = resolution(&source.points);
        assert!((0.5 * VOXEL..VOXEL).contains(&spacing), "{name}: spacing {spacing}");

        let sampled = Random::new(1, 0).sample(1000, source.points.len());
        let (radius, most) = (5.0 * VOXEL, 100);
        let asked = fpfh_at(&source.points, &source.normals, &source.tree, radius, most, &sampled);
        let all = fpfh(&target.points, &target.normals, &target.tree, radius, most);
        let pairs = nearest_rows(&asked.unwrap(), &all.unwrap());
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
