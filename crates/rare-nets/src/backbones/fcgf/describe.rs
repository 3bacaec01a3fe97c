//! Correspondences and a pose from the features of two clouds.

use rare::matching::{self, Match};
use rare::nalgebra::Point3;
use rare::pose::PoseEstimator;
use rare::{Correspondence, PointCloud, PointFeatures, Result, RigidTransform};

use super::{Fcgf, FcgfConfig, Matching};
use crate::backbones::{Description, Keypoints, Selection, SelectionRule};

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
            || self.keypoints(source, selection, 0),
            || self.keypoints(target, selection, 1),
        );
        let (from, to) = (from?, to?);
        let matches = self.config.matches(&from, &to)?;
        let correspondences = self.config.correspondences(&from, &to, &matches);
        let target_from_source = self.config.pose(source, target, &correspondences);
        let [source, target] = [from, to].map(worth_the_same);
        Ok(Description {
            source,
            target,
            correspondences,
            target_from_source,
            neighbour_limits: None,
            warnings: Vec::new(),
        })
    }

    /// Random voxels of a cloud. `side` keeps the choices of two equal clouds apart.
    fn keypoints(
        &self,
        points: &[Point3<f64>],
        selection: &Selection,
        side: u64,
    ) -> Result<PointFeatures> {
        let output = self.run(points)?;
        let chance = Selection {
            rule: SelectionRule::Random,
            seed: selection.seed.wrapping_add(side),
            ..*selection
        };
        let chosen = chance.choose(&vec![1.0; output.kept.len()]);
        let kept = output.kept.iter().filter_map(|&index| points.get(index)).copied().collect();
        let dimension = output.features.columns();
        Ok(PointFeatures::new(kept, dimension, output.features.into_values())?.select(&chosen))
    }
}

impl FcgfConfig {
    fn matches(&self, source: &PointFeatures, target: &PointFeatures) -> Result<Vec<Match>> {
        match self.matching {
            Matching::Nearest => matching::nearest(source, target, None),
            Matching::Mutual => matching::mutual_nearest(source, target, None),
        }
    }

    /// The matched points, the highest score first.
    fn correspondences(
        &self,
        source: &PointFeatures,
        target: &PointFeatures,
        matches: &[Match],
    ) -> Vec<Correspondence> {
        let mut pairs = matching::correspondences(source, target, matches, 1);
        if !self.unit_features {
            for (pair, found) in pairs.iter_mut().zip(matches) {
                pair.score = 1.0 / (1.0 + found.squared_distance);
            }
        }
        pairs.sort_by(|a, b| b.score.total_cmp(&a.score));
        pairs
    }

    fn pose(
        &self,
        source: &[Point3<f64>],
        target: &[Point3<f64>],
        pairs: &[Correspondence],
    ) -> Result<RigidTransform> {
        let source = PointCloud::new(source.to_vec())?;
        let target = PointCloud::new(target.to_vec())?;
        Ok(self.ransac.estimate(&source, &target, pairs)?.target_from_source)
    }
}

fn worth_the_same(features: PointFeatures) -> Keypoints {
    Keypoints { scores: vec![1.0; features.len()], features }
}
