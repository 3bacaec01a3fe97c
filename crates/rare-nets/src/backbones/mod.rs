//! Networks that find keypoints, features and correspondences of two clouds: what the paper calls registration methods,
//! and refines.
//!
//! Every network takes a pair, because most of them look at both clouds together, and gives a [`Description`]: keypoints
//! with features and scores on both sides, correspondences, and the pose that the method itself makes of them. The
//! refiner takes the keypoints as the features of its `Scan`s and the pose as its initial transform.
//!
//! | module | network | pose of its own |
//! |---|---|---|
//! | [`cofinet`] | `CoFiNet` (Yu et al.: `NeurIPS` 2021) | RANSAC |
//! | [`fcgf`] | FCGF (Choy, Park, Koltun: ICCV 2019) | RANSAC |
//! | [`geotransformer`] | `GeoTransformer` (Qin et al.: CVPR 2022) | local-to-global registration |
//! | [`predator`] | Predator (Huang et al.: CVPR 2021) | RANSAC |

mod backbone;
pub mod cofinet;
mod consensus;
pub mod fcgf;
pub(crate) mod fitted;
pub mod geotransformer;
mod hourglass;
pub mod kpconv;
pub mod predator;
mod sampling;

pub use backbone::Backbone;
use kpconv::NeighbourLimits;

use rare::nalgebra::Vector3;
use rare::{Correspondence, PointCloud, PointFeatures, Result, RigidTransform};
use serde::{Deserialize, Serialize};

/// What a network says of two clouds.
#[derive(Debug)]
pub struct Description {
    /// Keypoints of the source.
    pub source: Keypoints,
    /// Keypoints of the target.
    pub target: Keypoints,
    /// Which of them belong together, the highest score first; each side in its cloud's frame, metres.
    pub correspondences: Vec<Correspondence>,
    /// What the method itself makes of the correspondences: moves points of the source into the target's frame.
    pub target_from_source: Result<RigidTransform>,
    /// Most neighbours that each stage looked at, for networks of kernel point convolutions.
    pub neighbour_limits: Option<NeighbourLimits>,
    /// What the caller should know, in words.
    pub warnings: Vec<String>,
}

/// What is asked of a network.
#[derive(Debug, Clone, Default)]
pub struct Request {
    /// How many keypoints or correspondences, and which.
    pub selection: Selection,
    /// Most neighbours of a point, stage by stage, for networks of kernel point convolutions; those of the authors, or
    /// by their rule from the clouds, if `None`.
    pub neighbour_limits: Option<NeighbourLimits>,
    /// Bytes that may be taken; clouds that need more are refused beforehand.
    pub memory: Option<u64>,
}

/// Keypoints of one cloud.
#[derive(Debug, Clone, PartialEq)]
pub struct Keypoints {
    /// The points with their features, in the cloud's frame, metres.
    pub features: PointFeatures,
    /// How much each point is worth, 0 to 1; the same for all points where the network does not say.
    pub scores: Vec<f32>,
}

/// How many keypoints or correspondences are kept, and which.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Selection {
    /// So many at most; the paper takes 500 in rooms and 1000 in streets (section 4.1).
    pub count: usize,
    /// Which.
    pub rule: SelectionRule,
    /// Seed of the random choices.
    pub seed: u64,
}

/// Which keypoints or correspondences are kept. The paper does not say which it takes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SelectionRule {
    /// Those with the highest scores.
    #[default]
    TopScore,
    /// A random sample, the more likely the higher the score: what the evaluations of Predator and CoFiNet do.
    Random,
}

impl Default for Selection {
    fn default() -> Selection {
        Selection { count: 500, rule: SelectionRule::TopScore, seed: 0 }
    }
}

impl Description {
    /// From the local frames of the clouds, in which networks compute, to those of the caller.
    fn into_world(self, source: &PointCloud, target: &PointCloud) -> Description {
        let (from_source, from_target) = (*source.shift(), *target.shift());
        let moved = |pair: Correspondence| Correspondence {
            source: pair.source + from_source,
            target: pair.target + from_target,
            ..pair
        };
        Description {
            source: self.source.moved(&from_source),
            target: self.target.moved(&from_target),
            correspondences: self.correspondences.into_iter().map(moved).collect(),
            target_from_source: self
                .target_from_source
                .map(|pose| PointCloud::to_world(target, source, &pose)),
            neighbour_limits: self.neighbour_limits,
            warnings: self.warnings,
        }
    }
}

impl Keypoints {
    fn moved(self, shift: &Vector3<f64>) -> Keypoints {
        Keypoints { features: self.features.map_points(|point| point + shift), ..self }
    }
}

impl Selection {
    /// The places in `scores` of what is kept: the highest score first, of equal ones the first.
    ///
    /// The random sample is weighted and without replacement (Efraimidis and Spirakis, 2006): each score draws a key
    /// `u^(1 / score)`, and the highest keys are kept.
    #[must_use]
    pub fn choose(&self, scores: &[f32]) -> Vec<usize> {
        let by_score = |scores: &[f64]| {
            let mut order: Vec<usize> = (0..scores.len()).collect();
            order.sort_by(|&a, &b| scores[b].total_cmp(&scores[a]));
            order
        };
        let values: Vec<f64> = scores.iter().map(|&score| f64::from(score).max(0.0)).collect();
        let order = match self.rule {
            SelectionRule::TopScore => by_score(&values),
            SelectionRule::Random => {
                let mut random = rare::random::Random::new(self.seed, 0);
                // ln(u) / score orders as u^(1 / score) does, without underflow.
                let key =
                    |&score: &f64| (1.0 - random.uniform()).ln() / score.max(f64::MIN_POSITIVE);
                let keys: Vec<f64> = values.iter().map(key).collect();
                by_score(&keys)
            }
        };
        let mut kept: Vec<usize> = order.into_iter().take(self.count).collect();
        kept.sort_by(|&a, &b| values[b].total_cmp(&values[a]).then(a.cmp(&b)));
        kept
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_best_are_kept_or_a_sample_that_favours_them() {
        let scores = [0.1, 0.9, 0.5, 0.9, f32::NAN, 0.0];
        let best = Selection { count: 3, ..Selection::default() };
        assert_eq!(best.choose(&scores), [1, 3, 2]);
        let scores: Vec<f32> = (0..1000).map(|index| if index < 500 { 1.0 } else { 0.1 }).collect();
        let sample = Selection { count: 200, rule: SelectionRule::Random, seed: 7 };
        let kept = sample.choose(&scores);
        let valuable = kept.iter().filter(|&&index| index < 500).count();
        assert!((165..200).contains(&valuable), "{valuable}");
        assert_eq!(kept, sample.choose(&scores));
        assert_ne!(kept, Selection { seed: 8, ..sample }.choose(&scores));
        assert_eq!(sample.choose(&scores[..50]).len(), 50);
    }
}
