//! What a run will take.

use super::GeoTransformer;
use crate::backbones::kpconv::{NeighbourLimits, StagePoints, pyramid_bytes};

/// Bytes of a number.
const WORD: u64 = 4;

impl GeoTransformer {
    /// An estimate of the bytes that stages of these points take: the pyramid with its features, the numbers of each pair
    /// of superpoints, and the transport plans.
    pub(super) fn bytes(&self, stages: &[StagePoints], limits: &NeighbourLimits) -> u64 {
        let config = &self.config;
        let counts: Vec<usize> = stages.iter().map(|stage| stage.points.len()).collect();
        let channels: Vec<usize> = (0..stages.len()).map(|stage| config.channels(stage)).collect();
        let superpoints = stages.last().map(|stage| stage.lengths).unwrap_or_default();
        let pairs = superpoints.iter().fold(0, |sum: u64, &count| {
            sum.saturating_add((count as u64).saturating_mul(count as u64))
        });
        let transformer = &config.transformer;
        // Distance and angles twice while they are found, a score of each head three times while they are added up.
        let numbers = 2 * (1 + transformer.angle_neighbours) + 3 * transformer.heads;
        let patch = config.patch_points as u64 + 1;
        let plans = (config.superpoint_matches as u64).saturating_mul(patch * patch);
        pyramid_bytes(&counts, limits, &channels)
            .saturating_add(pairs.saturating_mul(numbers as u64 * WORD))
            .saturating_add(plans.saturating_mul(2 * WORD))
    }
}
