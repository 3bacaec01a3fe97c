//! What `GeoTransformer` computes against the golden values, stage by stage.

use std::collections::{BTreeMap, BTreeSet};

use rare::nalgebra::Point3;
use rare::{Correspondence, RigidTransform};
use rare_nets::Matrix;
use rare_nets::backbones::geotransformer::Registration;
use rare_nets::backbones::kpconv::{Point, Pyramid, StagePoints};

use super::case::{Case, TOLERANCE, both, close};
use super::kpconv::{golden_points, golden_pyramid};
use crate::shared::relative_difference;

impl Case {
    /// Compares everything that the golden file has; gives the number of parts that were watched.
    pub(super) fn compare(&self, name: &str) -> usize {
        let pyramid = golden_pyramid(&self.golden, &self.config.pyramid, &self.limits);
        let mut compared = 0;
        let mut watch = |part: &str, values: &Matrix| {
            if self.golden.contains(part) {
                close(name, part, values.values(), &self.golden.array(part).values);
                compared += 1;
            }
        };
        self.compare_structure(name, &pyramid);
        let found = self.network.register(&pyramid, &mut watch).unwrap();
        self.compare_features(name, &found);
        let undecided = self.compare_partitions(name, &found);
        assert!(undecided.len() <= 6, "{undecided:?}");
        self.compare_matches(name, &found, &pyramid, &undecided);
        compared
    }

    /// The embedding of pairs. That of a superpoint with itself only roughly: the released code's distance to itself is the
    /// root of a rounding error.
    pub(super) fn compare_structure(&self, name: &str, pyramid: &Pyramid) {
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

    pub(super) fn compare_features(&self, name: &str, found: &Registration) {
        for (side, part) in both("out.*_feats_c").iter().enumerate() {
            let golden = self.golden.array(part).values;
            close(name, part, found.superpoint_features[side].values(), &golden);
        }
        // Every row, or every sixteenth.
        let (pattern, step) = if self.golden.contains("out.ref_feats_f") {
            ("out.*_feats_f", 1)
        } else {
            ("out.*_feats_f_every16", 16)
        };
        for (side, part) in both(pattern).iter().enumerate() {
            let features = &found.point_features[side];
            let rows = (0..features.rows()).step_by(step);
            let ours: Vec<f32> = rows.flat_map(|row| features.row(row).to_vec()).collect();
            close(name, part, &ours, &self.golden.array(part).values);
        }
    }

    /// Patches hold the same points; near-equal distances may change their order. Gives those (side, superpoint) with a
    /// point that could as well belong to another.
    pub(super) fn compare_partitions(
        &self,
        name: &str,
        found: &Registration,
    ) -> BTreeSet<(usize, usize)> {
        let stages: Vec<StagePoints> =
            (0..4).map(|stage| golden_points(&self.golden, stage)).collect();
        let mut undecided = BTreeSet::new();
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
                for &point in sets[0].symmetric_difference(&sets[1]) {
                    // A point as far from one superpoint as from another may go to either.
                    let superpoints = stages[3].clouds()[side];
                    let point = &stages[1].clouds()[side][point as usize];
                    assert!(is_tie(point, superpoints), "{name} {part} {node} {point:?}");
                    undecided.insert((side, node));
                }
            }
            println!("{name} {part}: {swapped} of {} rows in another order", indices.shape[0]);
        }
        println!("{name} partition: {} undecided patches", undecided.len());
        undecided
    }

    pub(super) fn compare_matches(
        &self,
        name: &str,
        found: &Registration,
        pyramid: &Pyramid,
        undecided: &BTreeSet<(usize, usize)>,
    ) {
        let golden = both("out.*_node_corr_indices").map(|part| self.golden.array(&part).usize());
        let pairs = found.superpoint_matches.iter().map(|pair| (pair.target, pair.source));
        let golden: Vec<(usize, usize)> =
            golden[0].iter().copied().zip(golden[1].iter().copied()).collect();
        let pairs: Vec<(usize, usize)> = pairs.collect();
        let moved = pairs.iter().zip(&golden).filter(|(a, b)| a != b).count();
        println!("{name} superpoint matches: {moved} of {} at another place", golden.len());
        let sets = [&pairs, &golden].map(|list| list.iter().copied().collect::<BTreeSet<_>>());
        assert_eq!(sets[0], sets[1], "{name}");
        self.compare_plans(name, found, &golden, undecided);
        let (correspondences, groups) = found.correspondences(pyramid);
        if undecided.is_empty() {
            assert_eq!(self.compare_correspondences(name, &correspondences), 0, "{name}");
        } else {
            let different = self.compare_correspondences(name, &correspondences);
            assert!(different * 100 <= correspondences.len(), "{name}: {different}");
            if different > 0 {
                return;
            }
        }
        let rule = self.config.fine.local_to_global();
        let pose = rule.most_agreed(&correspondences, &groups).unwrap().target_from_source;
        compare_pose(name, &pose, &self.golden.array("out.estimated_transform").values);
    }

    /// Entries of points that there are; order within a patch as in the golden file.
    pub(super) fn compare_plans(
        &self,
        name: &str,
        found: &Registration,
        golden_pairs: &[(usize, usize)],
        undecided: &BTreeSet<(usize, usize)>,
    ) {
        let first = self.golden.contains("out.matching_scores");
        let part = if first { "out.matching_scores" } else { "out.matching_scores_first32" };
        let scores = self.golden.array(part);
        let [_, height, width] = scores.shape[..] else { panic!("three sizes") };
        let rows = both("part.*_node_knn_indices").map(|part| self.golden.array(&part));
        let (mut worst, mut largest): (f64, f64) = (0.0, 0.0);
        for (patch, plan) in scores.values.chunks_exact(height * width).enumerate() {
            let pair = golden_pairs[patch];
            if undecided.contains(&(0, pair.0)) || undecided.contains(&(1, pair.1)) {
                continue;
            }
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

    /// The same pairs of points, whose scores are close. Gives the number of those that only one side has.
    pub(super) fn compare_correspondences(&self, name: &str, found: &[Correspondence]) -> usize {
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
        assert!(found.len().abs_diff(scores.len()) <= missing.max(surplus), "{name}");
        assert!(difference < 1e-3, "{name}: {difference}");
        missing + surplus
    }
}

/// Whether the two superpoints nearest to a point are equally far, up to the rounding of the released code, which computes
/// squared distances (square metres) as differences of squares.
pub(super) fn is_tie(point: &Point, superpoints: &[Point]) -> bool {
    let squared = |other: &Point| {
        (0..3).map(|axis| f64::from(point[axis] - other[axis]).powi(2)).sum::<f64>()
    };
    let mut distances: Vec<f64> = superpoints.iter().map(squared).collect();
    distances.sort_by(f64::total_cmp);
    distances[1] - distances[0] < 1e-5
}

pub(super) fn compare_pose(name: &str, pose: &RigidTransform, golden: &[f64]) {
    let difference = pose
        .to_matrix()
        .transpose()
        .iter()
        .zip(golden)
        .fold(0.0, |worst: f64, (a, b)| worst.max((a - b).abs()));
    println!("{name} pose: {difference:.1e}");
    assert!(difference < 1e-3, "{name}: {difference}");
}
