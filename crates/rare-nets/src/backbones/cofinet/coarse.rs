//! Which coarse points belong together.

use super::CoFiNetConfig;
use crate::Matrix;

/// A coarse point of either cloud and how sure it is that they belong together, 0 to 1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CoarsePair {
    /// Index into the coarse points of the source.
    pub source: usize,
    /// Index into the coarse points of the target.
    pub target: usize,
    /// How sure it is.
    pub confidence: f32,
}

/// The pairs that are kept.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Kept {
    /// In the order of the sources, then of the targets.
    pub(super) pairs: Vec<CoarsePair>,
    /// How many there would have been without a bound.
    pub(super) found: usize,
}

/// The pairs whose confidence is above a threshold, which is lowered until there are enough of them.
///
/// At a threshold below 0 all pairs count, however few there are: two small clouds have no more.
pub(super) fn coarse_pairs(confidences: &Matrix, config: &CoFiNetConfig) -> Kept {
    // There are enough above a threshold if the last of the wanted number is.
    let last = last_of_best(confidences.values(), config.fewest_pairs);
    let enough = |threshold: f64| last.is_some_and(|last| f64::from(last) > threshold);
    // A step that leads nowhere must not be repeated for ever.
    let step = if config.threshold_step > 0.0 { config.threshold_step } else { f64::INFINITY };
    let mut threshold = config.first_threshold;
    while threshold >= 0.0 && !enough(threshold) {
        threshold -= step;
    }
    let columns = confidences.columns().max(1);
    let pair = |(index, &confidence): (usize, &f32)| CoarsePair {
        source: index / columns,
        target: index % columns,
        confidence,
    };
    let all = confidences.values().iter().enumerate();
    let mut pairs: Vec<CoarsePair> =
        all.filter(|(_, value)| f64::from(**value) > threshold).map(pair).collect();
    let found = pairs.len();
    if found > config.most_pairs {
        pairs.sort_by(|a, b| b.confidence.total_cmp(&a.confidence));
        pairs.truncate(config.most_pairs);
        pairs.sort_by_key(|pair| (pair.source, pair.target));
    }
    Kept { pairs, found }
}

/// The lowest of so many highest values; `None` if there are not as many.
fn last_of_best(values: &[f32], count: usize) -> Option<f32> {
    // What is no number is above no threshold.
    let mut numbers: Vec<f32> = values.iter().copied().filter(|value| !value.is_nan()).collect();
    let place = count.max(1) - 1;
    if place >= numbers.len() {
        return None;
    }
    Some(*numbers.select_nth_unstable_by(place, |a, b| b.total_cmp(a)).1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_threshold_falls_until_there_are_enough() {
        let confidences = Matrix::new(2, 2, vec![0.5, 0.1, 0.15, 0.3]).unwrap();
        let with = |fewest_pairs, most_pairs| {
            let config =
                CoFiNetConfig { fewest_pairs, most_pairs, ..CoFiNetConfig::three_d_match() };
            let kept = coarse_pairs(&confidences, &config);
            (
                kept.pairs.iter().map(|pair| [pair.source, pair.target]).collect::<Vec<_>>(),
                kept.found,
            )
        };
        assert_eq!(with(1, 9), (vec![[0, 0], [1, 1]], 2));
        assert_eq!(with(3, 9), (vec![[0, 0], [1, 0], [1, 1]], 3));
        assert_eq!(with(200, 9).0.len(), 4);
        assert_eq!(with(200, 2), (vec![[0, 0], [1, 1]], 4));
    }

    #[test]
    fn what_is_no_number_belongs_to_nothing_and_nothing_runs_for_ever() {
        let confidences = Matrix::new(1, 2, vec![f32::NAN, 0.0]).unwrap();
        let config = CoFiNetConfig { threshold_step: 0.0, ..CoFiNetConfig::three_d_match() };
        assert_eq!(coarse_pairs(&confidences, &config).pairs.len(), 1);
    }
}
