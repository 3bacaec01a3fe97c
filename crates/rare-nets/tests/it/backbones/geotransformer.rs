//! `GeoTransformer` against what its released code computes.

use std::collections::{BTreeMap, BTreeSet};

use rare::nalgebra::Point3;
use rare::{Correspondence, RigidTransform};
use rare_nets::Matrix;
use rare_nets::backbones::geotransformer::{
    FineMatchingConfig, GeoTransformer, GeoTransformerConfig, Registration, TransformerConfig,
    layout,
};
use rare_nets::backbones::kpconv::{NeighbourLimits, Pyramid, PyramidConfig};
use rare_nets::checkpoint::Parameters;

use super::kpconv::golden_pyramid;
use crate::shared::{GoldenTensors, path, relative_difference};

/// The largest relative difference that a stage may have.
const TOLERANCE: f64 = 1e-4;

/// The network of the golden files `tiny` and `small`.
fn reduced(voxel: f64, superpoint_matches: usize) -> GeoTransformerConfig {
    let official = GeoTransformerConfig::three_d_match();
    GeoTransformerConfig {
        name: "the test",
        pyramid: PyramidConfig { voxel, ..official.pyramid },
        groups: 8,
        width: 16,
        features: 32,
        patch_points: 32,
        transformer: TransformerConfig {
            hidden: 32,
            output: 32,
            sigma_distance: 8.0 * voxel,
            ..official.transformer
        },
        superpoint_matches,
        fine: FineMatchingConfig { acceptance_radius: 4.0 * voxel, ..official.fine },
        ..official
    }
}

/// A golden file and its network.
struct Case {
    golden: GoldenTensors,
    network: GeoTransformer,
    config: GeoTransformerConfig,
    limits: NeighbourLimits,
}

impl Case {
    fn reduced(name: &str) -> Option<Case> {
        let (voxel, matches) = if name == "tiny" { (0.1, 32) } else { (0.05, 128) };
        let file = format!("backbones/geotransformer_{name}");
        let golden = GoldenTensors::open(&format!("{file}.safetensors"))?;
        let weights = path(&format!("golden/{file}.weights.safetensors"))?;
        let parameters = Parameters::open(&weights)
            .and_then(|all| all.renamed(|name| name.strip_prefix("w.").map(str::to_owned)))
            .unwrap();
        let config = reduced(voxel, matches);
        let network = GeoTransformer::load(&parameters, config.clone()).unwrap();
        Some(Case { golden, network, config, limits: NeighbourLimits(vec![24; 4]) })
    }
}

/// The names and shapes of an official checkpoint.
fn official_layout(name: &str) -> Option<Vec<(String, Vec<usize>)>> {
    let file = path(&format!("golden/backbones/geotransformer_{name}.state_dict.txt"))?;
    let text = std::fs::read_to_string(file).unwrap();
    let tensor = |line: &str| {
        let fields: Vec<&str> = line.split('\t').collect();
        let sizes = fields[1].trim_matches(['(', ')']).split(',').map(str::trim);
        let sizes = sizes.filter(|size| !size.is_empty()).map(|size| size.parse().unwrap());
        (fields[0].to_owned(), sizes.collect())
    };
    let mut tensors: Vec<(String, Vec<usize>)> = text.lines().map(tensor).collect();
    tensors.sort();
    Some(tensors)
}

#[test]
fn tensors_are_those_of_the_official_checkpoints() {
    let cases = [
        ("full3dmatch", GeoTransformerConfig::three_d_match(), 9_829_377),
        ("kitti", GeoTransformerConfig::kitti(), 25_499_137),
        ("tiny", reduced(0.1, 32), 440_769),
    ];
    for (name, config, parameters) in cases {
        let Some(official) = official_layout(name) else { return };
        let ours: Vec<(String, Vec<usize>)> = layout(&config).into_iter().collect();
        assert_eq!(ours, official, "{name}");
        // Kernel points and wave numbers are not learnt.
        let learnt = ours
            .iter()
            .filter(|(name, _)| !name.ends_with("kernel_points") && !name.ends_with("div_term"));
        assert_eq!(
            learnt.map(|(_, shape)| shape.iter().product::<usize>()).sum::<usize>(),
            parameters
        );
    }
}

/// Golden names of what is compared for target and source.
fn both(pattern: &str) -> [String; 2] {
    ["ref", "src"].map(|side| pattern.replace('*', side))
}

fn close(name: &str, part: &str, found: &[f32], golden: &[f64]) {
    let difference = relative_difference(found, golden);
    println!("{name} {part}: {difference:.1e}");
    assert!(difference < TOLERANCE, "{name} {part}: {difference}");
}

#[test]
fn every_stage_meets_the_golden_values() {
    for name in ["tiny", "small"] {
        let Some(case) = Case::reduced(name) else { return };
        let pyramid = golden_pyramid(&case.golden, &case.config.pyramid, &case.limits);
        let mut compared = 0;
        let mut watch = |part: &str, values: &Matrix| {
            if case.golden.contains(part) {
                close(name, part, values.values(), &case.golden.array(part).values);
                compared += 1;
            }
        };
        case.compare_structure(name, &pyramid);
        let found = case.network.register(&pyramid, &mut watch).unwrap();
        assert!(compared >= 25, "{compared}");
        case.compare_features(name, &found);
        case.compare_partitions(name, &found);
        case.compare_matches(name, &found, &pyramid);
    }
}

impl Case {
    /// The embedding of pairs. That of a superpoint with itself only roughly: the released code's distance to itself is the
    /// root of a rounding error.
    fn compare_structure(&self, name: &str, pyramid: &Pyramid) {
        let superpoints = pyramid.stages.last().unwrap();
        for (part, points) in both("gse.*").iter().zip(superpoints.clouds()) {
            if !self.golden.contains(part) {
                continue;
            }
            let found = self.network.geometric_structure(points).unwrap();
            let golden = self.golden.array(part).values;
            let golden: Vec<&[f64]> = golden.chunks_exact(found.columns()).collect();
            let own = |row: &usize| row.is_multiple_of(points.len() + 1);
            for (what, tolerance, kept) in [("others", TOLERANCE, false), ("itself", 3e-3, true)] {
                let rows = || (0..found.rows()).filter(|row| own(row) == kept);
                let ours: Vec<f32> = rows().flat_map(|row| found.row(row).to_vec()).collect();
                let golden: Vec<f64> = rows().flat_map(|row| golden[row].to_vec()).collect();
                let difference = relative_difference(&ours, &golden);
                println!("{name} {part} {what}: {difference:.1e}");
                assert!(difference < tolerance, "{name} {part} {what}: {difference}");
            }
        }
    }

    fn compare_features(&self, name: &str, found: &Registration) {
        for (side, part) in both("out.*_feats_c").iter().enumerate() {
            let golden = self.golden.array(part).values;
            close(name, part, found.superpoint_features[side].values(), &golden);
        }
        for (side, part) in both("out.*_feats_f").iter().enumerate() {
            let golden = self.golden.array(part).values;
            close(name, part, found.point_features[side].values(), &golden);
        }
    }

    /// Patches hold the same points; near-equal distances may change their order, and which is last.
    fn compare_partitions(&self, name: &str, found: &Registration) {
        for (side, part) in both("part.*_node_knn_").iter().enumerate() {
            let indices = self.golden.array(&format!("{part}indices"));
            let masks = self.golden.array(&format!("{part}masks"));
            let (mut swapped, width) = (0, indices.shape[1]);
            for (node, patch) in found.partitions[side].patches.iter().enumerate() {
                let row = node * width..(node + 1) * width;
                let golden = indices.values[row.clone()].iter().zip(&masks.values[row]);
                let golden: Vec<u32> = golden
                    .filter(|(_, mask)| **mask > 0.0)
                    .map(|(index, _)| *index as u32)
                    .collect();
                swapped += usize::from(&golden != patch);
                let sets =
                    [patch, &golden].map(|list| list.iter().copied().collect::<BTreeSet<u32>>());
                assert_eq!(sets[0], sets[1], "{name} {part} {node}");
            }
            println!("{name} {part}: {swapped} of {} rows in another order", indices.shape[0]);
        }
    }

    fn compare_matches(&self, name: &str, found: &Registration, pyramid: &Pyramid) {
        let golden = both("out.*_node_corr_indices").map(|part| self.golden.array(&part).usize());
        let pairs = found.superpoint_matches.iter().map(|pair| (pair.target, pair.source));
        let golden: Vec<(usize, usize)> =
            golden[0].iter().copied().zip(golden[1].iter().copied()).collect();
        let pairs: Vec<(usize, usize)> = pairs.collect();
        let moved = pairs.iter().zip(&golden).filter(|(a, b)| a != b).count();
        println!("{name} superpoint matches: {moved} of {} at another place", golden.len());
        let sets = [&pairs, &golden].map(|list| list.iter().copied().collect::<BTreeSet<_>>());
        assert_eq!(sets[0], sets[1], "{name}");
        self.compare_plans(name, found, &golden);
        let (correspondences, groups) = found.correspondences(pyramid);
        self.compare_correspondences(name, &correspondences);
        let rule = self.config.fine.local_to_global();
        let pose = rule.most_agreed(&correspondences, &groups).unwrap().target_from_source;
        compare_pose(name, &pose, &self.golden.array("out.estimated_transform").values);
    }

    /// Entries of points that there are; order within a patch as in the golden file.
    fn compare_plans(&self, name: &str, found: &Registration, golden_pairs: &[(usize, usize)]) {
        let first = self.golden.contains("out.matching_scores");
        let part = if first { "out.matching_scores" } else { "out.matching_scores_first32" };
        let scores = self.golden.array(part);
        let [_, height, width] = scores.shape[..] else { panic!("three sizes") };
        let rows = both("part.*_node_knn_indices").map(|part| self.golden.array(&part));
        let (mut worst, mut largest): (f64, f64) = (0.0, 0.0);
        for (patch, plan) in scores.values.chunks_exact(height * width).enumerate() {
            let pair = golden_pairs[patch];
            let ours = found.superpoint_matches.iter().position(|m| (m.target, m.source) == pair);
            let ours = &found.plans[ours.unwrap()];
            let place = |side: usize, node: usize, slot: usize| {
                let indices = &rows[side];
                let patch = &found.partitions[side].patches[node];
                let index = indices.values[node * indices.shape[1] + slot] as u32;
                patch.iter().position(|&other| other == index)
            };
            for row in 0..ours.rows() {
                let bin = row + 1 == ours.rows();
                let at = if bin { ours.rows() - 1 } else { place(0, pair.0, row).unwrap() };
                let golden_row = if bin { height - 1 } else { row };
                for column in 0..ours.columns() {
                    let bin = column + 1 == ours.columns();
                    let to =
                        if bin { ours.columns() - 1 } else { place(1, pair.1, column).unwrap() };
                    let golden_column = if bin { width - 1 } else { column };
                    let golden = plan[golden_row * width + golden_column];
                    worst = worst.max((f64::from(ours.row(at)[to]) - golden).abs());
                    largest = largest.max(golden.abs());
                }
            }
        }
        println!("{name} plans: {:.1e} of {largest:.1}", worst / largest);
        assert!(worst / largest < TOLERANCE, "{name}: {worst} of {largest}");
    }

    /// The same pairs of points, whose scores are close.
    fn compare_correspondences(&self, name: &str, found: &[Correspondence]) {
        let points = both("out.*_corr_points").map(|part| self.golden.array(&part).f32());
        let scores = self.golden.array("out.corr_scores").values;
        let bits = |point: &[f32]| -> [u32; 3] { [0, 1, 2].map(|axis| point[axis].to_bits()) };
        let golden = points[0].chunks_exact(3).zip(points[1].chunks_exact(3)).zip(&scores);
        let golden: BTreeMap<_, f64> = golden
            .map(|((target, source), &score)| ((bits(target), bits(source)), score))
            .collect();
        let ours = |pair: &Correspondence| {
            let point = |p: &Point3<f64>| bits(&[p.x as f32, p.y as f32, p.z as f32]);
            ((point(&pair.target), point(&pair.source)), pair.score)
        };
        let ours: BTreeMap<_, f64> = found.iter().map(ours).collect();
        let missing = golden.keys().filter(|key| !ours.contains_key(*key)).count();
        let surplus = ours.keys().filter(|key| !golden.contains_key(*key)).count();
        let difference = golden
            .iter()
            .filter_map(|(key, score)| Some((ours.get(key)? - score).abs()))
            .fold(0.0, f64::max);
        println!(
            "{name} correspondences: {missing} missing, {surplus} surplus of {}; scores {difference:.1e}",
            golden.len()
        );
        assert_eq!((missing, surplus, found.len()), (0, 0, scores.len()), "{name}");
        assert!(difference < 1e-3, "{name}: {difference}");
    }
}

fn compare_pose(name: &str, pose: &RigidTransform, golden: &[f64]) {
    let difference = pose
        .to_matrix()
        .transpose()
        .iter()
        .zip(golden)
        .fold(0.0, |worst: f64, (a, b)| worst.max((a - b).abs()));
    println!("{name} pose: {difference:.1e}");
    assert!(difference < 1e-3, "{name}: {difference}");
}
