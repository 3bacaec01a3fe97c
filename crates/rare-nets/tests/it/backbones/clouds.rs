//! Clouds as users have them, described by `GeoTransformer`.

use std::collections::BTreeSet;

use rare::Correspondence;
use rare::nalgebra::{Point3, Vector3};
use rare_nets::backbones::Selection;
use rare_nets::backbones::kpconv::{NeighbourLimits, Point, subsample};

use super::case::Case;
use super::kpconv::golden_points;
use crate::shared::{GoldenTensors, relative_difference};

/// The tiny network and the clouds of its golden file, source first.
fn tiny_clouds() -> Option<(Case, [Vec<Point3<f64>>; 2])> {
    let case = Case::reduced("tiny")?;
    let points = golden_points(&case.golden, 0);
    let [target, source] = points.clouds().map(|cloud| {
        cloud.iter().map(|point| Point3::from(point.map(f64::from))).collect::<Vec<_>>()
    });
    Some((case, [source, target]))
}

#[test]
fn clouds_are_described_by_their_best_correspondences() {
    let Some((case, [source, target])) = tiny_clouds() else { return };
    let all = Selection { count: 10_000, ..Selection::default() };
    let found = case.network.describe(&source, &target, &case.limits, &all).unwrap();
    assert_eq!(case.compare_correspondences("described", &found.correspondences), 0);
    assert!(found.correspondences.is_sorted_by(|a, b| a.score >= b.score));
    assert!(found.warnings.is_empty(), "{:?}", found.warnings);
    // Random weights: nothing that means anything.
    println!("pose {:?}", found.target_from_source);
    let best = case
        .network
        .describe(&source, &target, &case.limits, &Selection { count: 50, ..all })
        .unwrap();
    assert_eq!(best.correspondences[..], found.correspondences[..50]);
    let stage = golden_points(&case.golden, 1);
    let [target_stage, source_stage] = stage.clouds();
    for (side, keypoints, stage) in
        [("ref", &best.target, target_stage), ("src", &best.source, source_stage)]
    {
        let golden = case.golden.array(&format!("out.{side}_feats_f"));
        assert_eq!(keypoints.scores.len(), keypoints.features.len());
        let mut seen = BTreeSet::new();
        for (place, point) in keypoints.features.points().iter().enumerate() {
            let is = |other: &Point| Point3::from(other.map(f64::from)) == *point;
            let row = stage.iter().position(is).unwrap();
            assert!(seen.insert(row), "keypoints are different");
            let golden = &golden.values[row * 32..(row + 1) * 32];
            assert!(relative_difference(keypoints.features.feature(place), golden) < 1e-3);
            let of = |pair: &&Correspondence| pair.target == *point || pair.source == *point;
            let best = best.correspondences.iter().find(of).unwrap();
            assert_eq!(f64::from(keypoints.scores[place]), best.score);
        }
        let pair = |pair: &Correspondence| if side == "ref" { pair.target } else { pair.source };
        let used: BTreeSet<[u64; 3]> = best
            .correspondences
            .iter()
            .map(|p| [0, 1, 2].map(|axis| pair(p)[axis].to_bits()))
            .collect();
        assert_eq!(used.len(), keypoints.features.len(), "{side}");
    }
}

#[test]
fn clouds_are_thinned_and_shifted_as_the_network_wants_them() {
    let Some((case, [source, target])) = tiny_clouds() else { return };
    let all = Selection { count: 10_000, ..Selection::default() };
    let describe = |source: &[Point3<f64>], target: &[Point3<f64>]| {
        case.network.describe(source, target, &case.limits, &all)
    };
    // Thinned clouds are left alone wherever their grid begins.
    let full = GoldenTensors::open("backbones/geotransformer_full3dmatch.safetensors").unwrap();
    let official = golden_points(&full, 0);
    let tiny = golden_points(&case.golden, 0);
    for (cloud, voxel) in
        [(tiny.clouds()[0], 0.1), (official.clouds()[0], 0.025), (official.clouds()[1], 0.025)]
    {
        let (mut least, mut most) = (f64::INFINITY, 0.0_f64);
        for step in 0..27 {
            let offset = [step % 3, step / 3 % 3, step / 9].map(|third| third as f32 / 3.0 * voxel);
            let points: Vec<Point> = cloud
                .iter()
                .map(|point| [0, 1, 2].map(|axis| point[axis] + offset[axis]))
                .collect();
            let ratio = points.len() as f64 / subsample(&points, voxel).unwrap().len() as f64;
            (least, most) = (least.min(ratio), most.max(ratio));
        }
        println!("points per voxel of a cloud thinned to {voxel} m: {least:.2} to {most:.2}");
        assert!(most < 2.0);
    }
    // Denser clouds are thinned.
    let dense = |cloud: &[Point3<f64>]| -> Vec<Point3<f64>> {
        let copies = |point: &Point3<f64>| [0.0, 0.001, -0.001].map(|step| point.map(|x| x + step));
        cloud.iter().flat_map(copies).collect()
    };
    let plain = describe(&source, &target).unwrap();
    let thinned = describe(&dense(&source), &dense(&target)).unwrap();
    let share = thinned.correspondences.len() as f64 / plain.correspondences.len() as f64;
    println!("{share:.2} times the correspondences from dense clouds");
    assert!((0.5..2.0).contains(&share) && thinned.warnings.is_empty());
    // Far from the origin single precision would see nothing.
    let far = Vector3::new(1.6e6, -3.2e5, 1.6e4);
    let moved: Vec<Point3<f64>> = source.iter().map(|point| point + far).collect();
    let found = describe(&moved, &target).unwrap();
    println!("{} and {} correspondences", found.correspondences.len(), plain.correspondences.len());
    let back = found.correspondences.iter().filter(|pair| {
        plain.correspondences.iter().any(|p| {
            (p.source - (pair.source - far)).norm() < 1e-3 && (p.target - pair.target).norm() < 1e-3
        })
    });
    assert!(back.count() * 10 > plain.correspondences.len() * 8);
}

#[test]
fn clouds_that_do_not_suit_the_network_are_refused_or_warned_of() {
    let Some((case, [source, target])) = tiny_clouds() else { return };
    let describe = |source: &[Point3<f64>], limits: &NeighbourLimits| {
        case.network.describe(source, &target, limits, &Selection::default())
    };
    let message = describe(&source[..3], &case.limits).unwrap_err().to_string();
    assert!(message.contains("the source has") && message.contains("0.8 m"), "{message}");
    assert!(describe(&[], &case.limits).unwrap_err().to_string().contains("0 points"));
    assert!(describe(&source, &NeighbourLimits(vec![24; 3])).is_err());
    let nan = vec![Point3::new(f64::NAN, 0.0, 0.0); 9];
    let message = describe(&nan, &case.limits).unwrap_err().to_string();
    assert!(message.contains("the source: the point"), "{message}");
    let stray: Vec<Point3<f64>> = [&source[..], &[Point3::new(1e6, 0.0, 0.0)]].concat();
    let message = describe(&stray, &case.limits).unwrap_err().to_string();
    assert!(message.contains("stray points"), "{message}");
    let sparse: Vec<Point3<f64>> = source.iter().map(|point| point * 4.0).collect();
    let found = describe(&sparse, &case.limits).unwrap();
    let [warning] = &found.warnings[..] else { panic!("{:?}", found.warnings) };
    println!("{warning}");
    assert!(
        warning.starts_with("trained on points 0.1 m apart, the source's are 0.3"),
        "{warning}"
    );
}
