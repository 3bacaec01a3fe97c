//! `CoFiNet` against recorded stages of the official code.

use rare::nalgebra::Point3;
use rare_nets::Matrix;
use rare_nets::backbones::Selection;
use rare_nets::backbones::cofinet::{CoFiNet, CoFiNetConfig, Output, layout};
use rare_nets::backbones::kpconv::{NeighbourLimits, PyramidConfig};

use super::recorded::{
    TOLERANCE, clouds, compare, compare_change, described, finds_the_step, moved, official_layout,
    pyramid, weights,
};
use crate::shared::{GoldenTensors, relative_difference};

fn tiny() -> CoFiNetConfig {
    let rooms = CoFiNetConfig::three_d_match();
    CoFiNetConfig {
        pyramid: PyramidConfig { voxel: 0.1, ..rooms.pyramid },
        width: 32,
        coarse_channels: 64,
        features: 8,
        fewest_pairs: 24,
        patch: 32,
        ..rooms
    }
}

fn recorded() -> Option<(GoldenTensors, Output)> {
    let golden = GoldenTensors::open("backbones/cofinet_tiny.safetensors")?;
    let network = CoFiNet::load(&weights("cofinet_tiny")?, tiny()).unwrap();
    let output = network.run(&pyramid(&golden, &tiny().pyramid)).unwrap();
    Some((golden, output))
}

fn part(matrix: &Matrix, first: usize, rows: usize) -> Matrix {
    let values = (first..first + rows).flat_map(|row| matrix.row(row).to_vec()).collect();
    Matrix::new(rows, matrix.columns(), values).unwrap()
}

#[test]
fn features_of_every_stage_are_the_official_ones() {
    let Some((golden, output)) = recorded() else { return };
    for (features, name) in output.encoded.iter().zip(["enc.1", "enc.3", "enc.5"]) {
        compare(&golden, name, features);
    }
    compare(&golden, "bottle", &output.bottleneck);
    // The official code records what an attention adds.
    let [source, target] = output.attended[0].each_ref().map(Matrix::rows);
    let before = [part(&output.bottleneck, 0, source), part(&output.bottleneck, source, target)];
    let steps = [&before].into_iter().chain(&output.attended);
    for ((before, after), name) in steps.zip(&output.attended).zip(["sattn1", "cattn", "sattn2"]) {
        compare_change(&golden, name, &after[0], &before[0]);
        compare_change(&golden, &format!("{name}#call2"), &after[1], &before[1]);
    }
    compare(&golden, "final_proj", &output.coarse_features[0]);
    compare(&golden, "final_proj#call2", &output.coarse_features[1]);
    compare(&golden, "dec.5", &output.fine_features);
}

#[test]
fn coarse_points_are_matched_as_officially() {
    let Some((golden, output)) = recorded() else { return };
    let pairs = golden.array("out.node_corr").usize();
    let confidences = golden.array("out.node_corr_conf").values;
    assert_eq!(output.coarse_pairs.len(), confidences.len());
    let mut largest: f64 = 0.0;
    for ((found, pair), confidence) in
        output.coarse_pairs.iter().zip(pairs.chunks_exact(2)).zip(confidences)
    {
        assert_eq!([found.source, found.target], pair);
        largest = largest.max((f64::from(found.confidence) - confidence).abs());
    }
    println!("cofinet coarse confidences: {largest:.1e}");
    assert!(largest < 1e-4, "{largest:.2e}");
}

#[test]
fn patches_are_the_official_ones() {
    let Some((golden, output)) = recorded() else { return };
    let [source, target] = ["out.src_pcd_sel", "out.tgt_pcd_sel"].map(|n| golden.array(n).usize());
    for (index, pair) in output.coarse_pairs.iter().enumerate() {
        let slots = index * 32..(index + 1) * 32;
        for (side, place, slots) in
            [(0, pair.source, &source[slots.clone()]), (1, pair.target, &target[slots.clone()])]
        {
            let members = output.patches[side].members(place);
            assert_eq!(members, &slots[..members.len()]);
            assert!(slots[members.len()..].iter().all(|&slot| slot == 0));
        }
    }
}

#[test]
fn fine_points_are_matched_as_officially() {
    let Some((golden, output)) = recorded() else { return };
    let scores = golden.array("out.local_scores");
    let found: Vec<f32> = output.fine_scores.iter().flat_map(|s| s.values()).copied().collect();
    assert_eq!(found.len(), scores.values.len());
    // What fills patches up is near -10^6, where single precision holds no decimals.
    let valid = scores.values.iter().zip(found).filter(|(golden, _)| **golden > -1e5);
    let (golden_scores, found): (Vec<f64>, Vec<f32>) = valid.unzip();
    let largest = relative_difference(&found, &golden_scores);
    println!("cofinet fine scores: {largest:.1e}");
    assert!(largest < TOLERANCE, "{largest:.2e}");

    let [source, target] = ["out.src_pcd_sel", "out.tgt_pcd_sel"].map(|n| golden.array(n).usize());
    let pairs = golden.array("out.fine_corr").usize();
    let confidences = golden.array("out.fine_conf").values;
    let official = pairs.chunks_exact(2).map(|pair| [source[pair[0]], target[pair[1]]]);
    let mut official: Vec<_> = official.zip(confidences).collect();
    let mut found: Vec<_> = output
        .fine_pairs
        .iter()
        .map(|pair| ([pair.source, pair.target], pair.confidence))
        .collect();
    official.sort_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)));
    found.sort_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)));
    assert_eq!(found.len(), official.len());
    let mut largest: f64 = 0.0;
    for (found, official) in found.iter().zip(&official) {
        assert_eq!(found.0, official.0);
        largest = largest.max((f64::from(found.1) - official.1).abs());
    }
    println!("cofinet fine confidences: {largest:.1e} over {} pairs", found.len());
    assert!(largest < 1e-4, "{largest:.2e}");
}

#[test]
fn tensors_are_those_of_the_official_model() {
    let Some(official) = official_layout("cofinet") else { return };
    assert!(layout(&CoFiNetConfig::three_d_match()) == official);
    assert!(layout(&CoFiNetConfig::kitti()) == official);
}

#[test]
fn two_clouds_are_described_whatever_the_number_of_threads() {
    let Some(golden) = GoldenTensors::open("backbones/cofinet_tiny.safetensors") else { return };
    let Some(weights) = weights("cofinet_tiny") else { return };
    let network = CoFiNet::load(&weights, tiny()).unwrap();
    let [source, target] = clouds(&golden);
    let limits = NeighbourLimits(vec![24; 4]);
    let selection = Selection { count: 300, ..Selection::default() };
    let description =
        described(|| network.describe(&source, &target, &limits, &selection).unwrap());
    assert_eq!(description.correspondences.len(), 300);
    for (side, cloud) in [(&description.source, &source), (&description.target, &target)] {
        assert_eq!(side.features.dimension(), 8);
        assert!(side.features.len() <= 300 && side.scores.is_sorted_by(|a, b| a >= b));
        let points = side.features.points();
        assert!(points.iter().all(|point| cloud.contains(point)));
        assert!((1..points.len()).all(|index| !points[..index].contains(&points[index])));
    }
    assert!(description.warnings.is_empty(), "{:?}", description.warnings);
}

#[test]
fn a_moved_cloud_is_found() {
    let Some(golden) = GoldenTensors::open("backbones/cofinet_tiny.safetensors") else { return };
    let Some(weights) = weights("cofinet_tiny") else { return };
    let network = CoFiNet::load(&weights, tiny()).unwrap();
    let [cloud, _] = clouds(&golden);
    let limits = NeighbourLimits(vec![24; 4]);
    let selection = Selection { count: 800, ..Selection::default() };
    let description = network.describe(&cloud, &moved(&cloud), &limits, &selection).unwrap();
    finds_the_step(&description, 0.02);
}

#[test]
fn clouds_of_few_points_have_few_pairs() {
    let Some(weights) = weights("cofinet_tiny") else { return };
    let config = CoFiNetConfig { most_pairs: 1, ..tiny() };
    let network = CoFiNet::load(&weights, config).unwrap();
    let (limits, selection) = (NeighbourLimits(vec![24; 4]), Selection::default());
    let alone = [Point3::new(0.1, 0.2, 2.0)];
    let wall: Vec<_> =
        (0..400).map(|i| Point3::new(f64::from(i % 20), f64::from(i / 20), 9.0)).collect();
    let wall: Vec<_> = wall.iter().map(|point| point * 0.1).collect();
    let description = network.describe(&wall, &alone, &limits, &selection).unwrap();
    assert!(description.target_from_source.is_err());
    let description = network.describe(&wall, &wall, &limits, &selection).unwrap();
    assert!(!description.correspondences.is_empty());
    let warnings = &description.warnings;
    assert!(warnings.iter().any(|warning| warning.contains("likeliest")), "{warnings:?}");
    let expected = network.expected_bytes(&wall, &wall, &limits).unwrap();
    assert!((10_000..100_000_000).contains(&expected), "{expected}");
    assert!(network.describe(&[], &wall, &limits, &selection).is_err());
}
