//! How much of a number is luck: 95 % intervals by drawing the pairs of each scene anew (Efron 1979).

use serde::Serialize;

use super::summary::mean;
use crate::random::Random;

/// Draws behind an interval.
const DRAWS: usize = 1000;

/// The ends of a 95 % interval.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Interval {
    /// 2.5 % lie below.
    pub low: f64,
    /// 2.5 % lie above.
    pub high: f64,
}

/// The interval of a recall over scenes of solved and unsolved pairs.
pub(super) fn interval_of_recall(
    scenes: &[Vec<bool>],
    recall: impl Fn(&[Vec<bool>]) -> Option<f64>,
) -> Option<Interval> {
    let draws = (0..DRAWS).filter_map(|draw| recall(&resample(scenes, draw)));
    Interval::of(draws.collect())
}

/// The interval of the mean over the values of all scenes.
pub(super) fn interval_of_mean(scenes: &[Vec<f64>]) -> Option<Interval> {
    let draws = (0..DRAWS).filter_map(|draw| mean(&resample(scenes, draw).concat()));
    Interval::of(draws.collect())
}

/// As many values of each scene as it has, drawn with replacement.
fn resample<T: Copy>(scenes: &[Vec<T>], draw: usize) -> Vec<Vec<T>> {
    let mut random = Random::new(0, draw as u64);
    scenes
        .iter()
        .map(|values| values.iter().map(|_| values[random.below(values.len())]).collect())
        .collect()
}

impl Interval {
    fn of(mut draws: Vec<f64>) -> Option<Interval> {
        draws.sort_by(f64::total_cmp);
        let tail = draws.len() / 40;
        let low = *draws.get(tail)?;
        let high = *draws.get(draws.len() - 1 - tail)?;
        Some(Interval { low, high })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_interval_of_a_mean_is_that_of_the_normal_distribution() {
        let mut random = Random::new(3, 0);
        let values: Vec<f64> = (0..400).map(|_| 5.0 + 2.0 * random.normal()).collect();
        let center = mean(&values).unwrap();
        let spread = (values.iter().map(|v| (v - center).powi(2)).sum::<f64>() / 400.0).sqrt();
        let interval = interval_of_mean(&[values[..100].to_vec(), values[100..].to_vec()]).unwrap();
        let half = 1.96 * spread / 20.0;
        assert!(
            (interval.low - (center - half)).abs() < 0.15 * half,
            "{interval:?} {center} {half}"
        );
        assert!(
            (interval.high - (center + half)).abs() < 0.15 * half,
            "{interval:?} {center} {half}"
        );
        assert_eq!(interval_of_mean(&[]), None);
        assert_eq!(interval_of_mean(&[Vec::new()]), None);
    }
}
