//! Trimming: only the closest pairs have a say (Chetverikov et al. 2002).

use serde::{Deserialize, Serialize};

/// The least overlap that [`Trim::Automatic`] considers.
const LEAST_OVERLAP: f64 = 0.4;

/// Which share of the source has a counterpart in the target.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Trim {
    /// Every matched pair has a say.
    #[default]
    Off,
    /// The closest pairs, as many as this share (above 0, at most 1) of the source points.
    Overlap(f64),
    /// As `Overlap`, with the share (at least 0.4) that makes `mean squared distance / overlap^3` least, found anew in
    /// each round.
    Automatic,
}

impl Trim {
    /// The largest squared distance that has a say, given those of all matched pairs of a source of `count` points.
    /// Works in place.
    pub(super) fn limit(self, squared_distances: &mut [f64], count: usize) -> f64 {
        let most = match self {
            Trim::Off => return f64::INFINITY,
            Trim::Overlap(share) => (share * count as f64).ceil() as usize,
            Trim::Automatic => most_plausible(squared_distances, count),
        };
        if most == 0 || most >= squared_distances.len() {
            return f64::INFINITY;
        }
        *squared_distances.select_nth_unstable_by(most - 1, f64::total_cmp).1
    }
}

/// The number of pairs with the least `mean squared distance / overlap^3`; sorts the distances.
fn most_plausible(squared_distances: &mut [f64], count: usize) -> usize {
    squared_distances.sort_unstable_by(f64::total_cmp);
    let least = (LEAST_OVERLAP * count as f64).ceil() as usize;
    let (mut sum, mut best) = (0.0, (f64::INFINITY, 0));
    for (kept, squared_distance) in (1..).zip(squared_distances.iter()) {
        sum += squared_distance;
        // The mean over the cube of the overlap, but for a constant factor.
        let score = sum / (f64::from(kept) / count as f64).powi(4);
        // Of equals, as on a perfect fit, the largest overlap.
        if kept as usize >= least && score <= best.0 {
            best = (score, kept as usize);
        }
    }
    best.1
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_closest_pairs_are_kept() {
        let distances = || vec![5.0, 1.0, 4.0, 2.0, 3.0];
        assert_eq!(Trim::Off.limit(&mut distances(), 10), f64::INFINITY);
        assert_eq!(Trim::Overlap(0.3).limit(&mut distances(), 10), 3.0);
        assert_eq!(Trim::Overlap(0.25).limit(&mut distances(), 10), 3.0);
        assert_eq!(Trim::Overlap(1.0).limit(&mut distances(), 10), f64::INFINITY);
        assert_eq!(Trim::Overlap(0.5).limit(&mut [], 10), f64::INFINITY);
    }

    #[test]
    fn the_overlap_shows_as_a_jump_of_the_distances() {
        // 70 % of the points lie 1 cm off, the others up to a metre.
        let mut distances: Vec<f64> =
            (0..100).map(|i| if i < 70 { 1e-4 } else { f64::from(i - 69) / 30.0 }).collect();
        assert_eq!(Trim::Automatic.limit(&mut distances, 100), 1e-4);
        assert_eq!(most_plausible(&mut distances, 100), 70);
        assert_eq!(most_plausible(&mut [0.0; 50], 50), 50);
        assert_eq!(most_plausible(&mut [1.0; 10], 50), 0);
    }
}
