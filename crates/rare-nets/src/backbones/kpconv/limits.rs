//! How many neighbours each stage looks at.

use rare::{Error, Result};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::neighbours::Cells;
use super::{Point, PyramidConfig, StagePoints};

/// The share of points whose neighbours all count.
const KEPT: f64 = 0.8;
/// Points of a stage after which a histogram is believed.
const SAMPLED: u64 = 2000;

/// The most neighbours that a convolution looks at, for each stage, the finest first.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct NeighbourLimits(pub Vec<usize>);

impl NeighbourLimits {
    /// What the released networks for 3DMatch were run with.
    #[must_use]
    pub fn three_d_match() -> NeighbourLimits {
        NeighbourLimits(vec![38, 36, 36, 38])
    }

    /// Makes sure that there is a positive one for each stage.
    ///
    /// # Errors
    /// `InvalidInput` with the limits if not.
    pub fn validate(&self, stages: usize) -> Result<()> {
        if self.0.len() == stages && self.0.iter().all(|&limit| limit > 0) {
            return Ok(());
        }
        let limits = &self.0;
        Err(Error::invalid(format!(
            "the neighbour limits {limits:?} must be {stages} positive numbers, one for each stage of the network"
        )))
    }
}

/// The limits with which four fifths of the points see all of their neighbours, as the released training code finds
/// them: pair after pair is counted until each stage has more than 2000 points.
///
/// The pairs are clouds like those that the network will see, thinned to its voxel.
///
/// # Errors
/// `InvalidInput` if there is no pair, or those of [`StagePoints::new`].
pub fn calibrate<'a>(
    pairs: impl IntoIterator<Item = [&'a [Point]; 2]>,
    config: &PyramidConfig,
) -> Result<NeighbourLimits> {
    let bins = config.most_neighbours();
    let mut histograms = vec![vec![0_u64; bins]; config.stages];
    for pair in pairs {
        let stages = StagePoints::new(pair, config)?;
        for (level, (histogram, stage)) in histograms.iter_mut().zip(&stages).enumerate() {
            let radius = config.radius(level) as f32;
            for count in counts(stage, radius)? {
                if let Some(bin) = histogram.get_mut(count) {
                    *bin += 1;
                }
            }
        }
        if histograms.iter().all(|histogram| histogram.iter().sum::<u64>() > SAMPLED) {
            break;
        }
    }
    let limits: Vec<usize> = histograms.iter().map(|histogram| limit(histogram)).collect();
    if limits.contains(&0) {
        return Err(Error::invalid(format!(
            "no neighbour limits can be found from clouds without points: the stages give {limits:?}"
        )));
    }
    Ok(NeighbourLimits(limits))
}

/// How many neighbours four fifths of the points of a cloud have at most within `radius` metres, themselves included; 0
/// without points. Some thousand points are asked, spread evenly over their order.
///
/// # Errors
/// `InvalidInput` if a point is not finite or the cloud spans too much for the radius.
pub(in crate::backbones) fn usual_neighbours(points: &[Point], radius: f32) -> Result<usize> {
    let cells = Cells::new(points, radius, 0)?;
    let step = (points.len() / SAMPLED as usize).max(1);
    let count = |found: &mut Vec<u64>, index: usize| {
        cells.within(&points[index], found);
        found.len()
    };
    let asked: Vec<usize> = (0..points.len()).step_by(step).collect();
    let mut counts: Vec<usize> = asked.into_par_iter().map_init(Vec::new, count).collect();
    counts.sort_unstable();
    let place = (KEPT * counts.len() as f64) as usize;
    Ok(counts.get(place).or(counts.last()).copied().unwrap_or(0))
}

/// How many neighbours each point of a stage has, itself included.
fn counts(stage: &StagePoints, radius: f32) -> Result<Vec<usize>> {
    let (first, second) = stage.points.split_at(stage.lengths[0]);
    let mut counts = Vec::with_capacity(stage.points.len());
    for cloud in [first, second] {
        let cells = Cells::new(cloud, radius, 0)?;
        let count = |found: &mut Vec<u64>, point: &Point| {
            cells.within(point, found);
            found.len()
        };
        counts.par_extend(cloud.par_iter().map_init(Vec::new, count));
    }
    Ok(counts)
}

/// The number of bins below the share of all counts that is kept.
fn limit(histogram: &[u64]) -> usize {
    let enough = KEPT * histogram.iter().sum::<u64>() as f64;
    let mut total = 0;
    let cumulated = histogram.iter().map(|count| {
        total += count;
        total as f64
    });
    cumulated.take_while(|&total| total < enough).count()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn four_fifths_see_all_of_their_neighbours() {
        assert_eq!(limit(&[0, 5, 5, 5, 5, 5]), 4);
        assert_eq!(limit(&[0, 0, 0, 10, 0]), 3);
        assert_eq!(limit(&[0, 0]), 0);
    }

    #[test]
    fn a_limit_is_needed_for_each_stage() {
        assert!(NeighbourLimits::three_d_match().validate(4).is_ok());
        assert!(NeighbourLimits::three_d_match().validate(5).is_err());
        assert!(NeighbourLimits(vec![3, 0]).validate(2).is_err());
    }
}
