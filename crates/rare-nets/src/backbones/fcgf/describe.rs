//! Correspondences and a pose from the features of two clouds.

use rare::matching::{self, Match};
use rare::nalgebra::Point3;
use rare::{PointFeatures, Result};

use super::voxels::voxelise;
use super::{Fcgf, FcgfConfig, Matching};
use crate::backbones::consensus::{correspondences, for_target, pose};
use crate::backbones::{Description, Keypoints, Selection, SelectionRule, sampling};

/// Bytes of features and kernel maps for each voxel of the finest stride (measured in a room: 2600).
const BYTES_PER_VOXEL: u64 = 3000;

impl Fcgf {
    /// Describes two clouds: `selection.count` random keypoints on each side, because the network does not say which
    /// are worth more (the benchmark takes 5000), their matches, and the pose that RANSAC finds in them.
    ///
    /// Points and results are in the local frames of the clouds, metres. Keypoints are points of the clouds themselves,
    /// not centres of voxels. A pair's score is the cosine of its features, or `1 / (1 + d^2)` at distance `d` where
    /// features have no unit length.
    ///
    /// # Errors
    /// `InvalidInput` if a cloud has no point, or one that is not finite or too far from the origin.
    pub fn describe(
        &self,
        source: &[Point3<f64>],
        target: &[Point3<f64>],
        selection: &Selection,
    ) -> Result<Description> {
        let (from, to) = rayon::join(
            || self.keypoints("source", source, selection),
            || self.keypoints("target", target, &for_target(selection)),
        );
        let ((from, of_source), (to, of_target)) = (from?, to?);
        let matches = self.config.matches(&from, &to)?;
        let pairs = correspondences(&from, &to, &matches, |pair| self.config.score(pair));
        let target_from_source = pose(&self.config.ransac, [source, target], &pairs, selection);
        let [source, target] = [from, to].map(worth_the_same);
        Ok(Description {
            source,
            target,
            correspondences: pairs,
            target_from_source,
            neighbour_limits: None,
            warnings: of_source.into_iter().chain(of_target).collect(),
        })
    }

    /// An estimate of the bytes that [`Fcgf::describe`] takes for these clouds, from the number of their voxels.
    ///
    /// # Errors
    /// Those of [`Fcgf::describe`].
    pub fn expected_bytes(&self, source: &[Point3<f64>], target: &[Point3<f64>]) -> Result<u64> {
        let voxels = |points| Ok(voxelise(points, self.config.voxel)?.kept.len() as u64);
        let voxels: Result<u64> = voxels(source).and_then(|count| Ok(count + voxels(target)?));
        Ok(voxels? * BYTES_PER_VOXEL)
    }

    /// Random voxels of a cloud, and what to say if its points are far apart.
    fn keypoints(
        &self,
        name: &str,
        points: &[Point3<f64>],
        selection: &Selection,
    ) -> Result<(PointFeatures, Option<String>)> {
        let output = self.run(points)?;
        let chance = Selection { rule: SelectionRule::Random, ..*selection };
        let chosen = chance.choose(&vec![1.0; output.kept.len()]);
        let kept = output.kept.iter().filter_map(|&index| points.get(index));
        let kept: Vec<Point3<f64>> = kept.copied().collect();
        let warning = sampling::warning(&kept, name, self.config.voxel);
        let dimension = output.features.columns();
        let all = PointFeatures::new(kept, dimension, output.features.into_values())?;
        Ok((all.select(&chosen), warning))
    }
}

impl FcgfConfig {
    fn matches(&self, source: &PointFeatures, target: &PointFeatures) -> Result<Vec<Match>> {
        match self.matching {
            Matching::Nearest => matching::nearest(source, target, None),
            Matching::Mutual => matching::mutual_nearest(source, target, None),
        }
    }

    /// How much a pair is worth.
    fn score(&self, pair: &Match) -> f64 {
        if self.unit_features { pair.similarity(1) } else { 1.0 / (1.0 + pair.squared_distance) }
    }
}

fn worth_the_same(features: PointFeatures) -> Keypoints {
    Keypoints { scores: vec![1.0; features.len()], features }
}
