//! FastMAC: maximal cliques of a spectral sample (Zhang, Zhao, Li and Chen, CVPR 2024).
//!
//! Cliques among a part of the correspondences are found far faster than among all. The part is drawn where the graph's
//! degree signal varies most: there compatible correspondences border on incompatible ones, which random sampling
//! misses.

use serde::{Deserialize, Serialize};

use crate::data::{Correspondence, PointCloud};
use crate::error::{Error, Result};
use crate::pose::consensus;
use crate::pose::mac::ScoreGraph;
use crate::pose::{Consistency, Mac, Mode, PoseEstimate, PoseEstimator, significance};
use crate::random::Random;

/// The settings of FastMAC (Zhang et al., "FastMAC: Stochastic Spectral Sampling of Correspondence Graph", CVPR 2024).
///
/// The sample is drawn without replacement with probabilities proportional to the response of the degree signal to the
/// graph's Laplacian, less the smallest response. As in the released code the graph of the sampler joins every
/// correspondence to itself, that of the cliques does not.
///
/// What [`Mode::Faithful`] (of `mac.mode`) keeps of the released code, besides what [`Mac`] does:
/// * poses are judged and polished on the sample alone,
/// * only correspondences with a response above the smallest are drawn, and `min_sample` does not count.
///
/// [`Mode::Fixed`]: all correspondences judge and polish, and where responses do not suffice (on clean data they vanish)
/// the sample is filled up at random.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FastMac {
    /// What is done with the sample; its score and bound also make the sampler's graph.
    pub mac: Mac,
    /// Share of the correspondences that is drawn, above 0, at most 1.
    pub ratio: f64,
    /// At least so many are drawn, if there are.
    pub min_sample: usize,
    /// Seed of the draws.
    pub seed: u64,
}

impl FastMac {
    /// The released settings for 3DMatch with FPFH: half of the correspondences.
    #[must_use]
    pub fn three_d_match() -> FastMac {
        FastMac { mac: Mac::three_d_match(), ratio: 0.5, min_sample: 100, seed: 42 }
    }

    /// The released settings for 3DLoMatch: a looser bound.
    #[must_use]
    pub fn three_d_lo_match() -> FastMac {
        FastMac { mac: Mac::three_d_lo_match(), ..FastMac::three_d_match() }
    }

    /// The settings for KITTI with FPFH and a tenth of the correspondences, the ratio of the best published recall; the
    /// released script has 0.01.
    #[must_use]
    pub fn kitti() -> FastMac {
        FastMac { mac: Mac::kitti(), ratio: 0.1, ..FastMac::three_d_match() }
    }

    /// The settings of 3DMatch (where clouds are sampled at 0.05 m) scaled to clouds sampled at `voxel` metres.
    #[must_use]
    pub fn for_voxel(voxel: f64) -> FastMac {
        FastMac { mac: Mac::for_voxel(voxel), ..FastMac::three_d_match() }
    }

    /// The best `top` poses of which no two are alike; see [`Mac::hypotheses`].
    ///
    /// # Errors
    /// As [`Mac::hypotheses`], and `InvalidInput` for a ratio that is not above 0 and at most 1.
    pub fn hypotheses(&self, pairs: &[Correspondence], top: usize) -> Result<Vec<PoseEstimate>> {
        self.validate()?;
        consensus::validate(pairs)?;
        let weighed = consensus::weighed(pairs, self.mac.use_scores);
        let limited: Vec<Correspondence> =
            self.mac.limited(pairs).into_iter().map(|i| weighed[i]).collect();
        let (sample, complete) = self.sample(&limited);
        let members: Vec<Correspondence> = sample.into_iter().map(|i| limited[i]).collect();
        let mut cliques = self.mac.cliques(&members);
        cliques.budget_exhausted |= !complete || limited.len() < pairs.len();
        let judges = match self.mac.mode {
            Mode::Faithful => &members,
            Mode::Fixed => &weighed,
        };
        self.mac.conclude(&cliques, &members, judges, pairs, top)
    }

    fn validate(&self) -> Result<()> {
        if !(self.ratio > 0.0 && self.ratio <= 1.0) {
            return Err(Error::invalid(format!(
                "the sampling ratio of fastmac is {}, it must be above 0 and at most 1",
                self.ratio
            )));
        }
        self.mac.validate()
    }

    /// The indices of the drawn pairs, ascending, and whether the graph at the wanted bound could be formed.
    fn sample(&self, pairs: &[Correspondence]) -> (Vec<usize>, bool) {
        let consistency = Consistency::new(pairs);
        let graphs = self.mac.bounds().map(|bound| (bound, &consistency));
        let graph = (graphs.into_iter().enumerate()).find_map(|(at, (bound, consistency))| {
            Some((at, self.mac.score_graph(consistency, bound)?))
        });
        let mut responses = match &graph {
            Some((_, graph)) => responses(graph),
            None => vec![0.0; pairs.len()],
        };
        let smallest = responses.iter().copied().fold(f64::INFINITY, f64::min);
        responses.iter_mut().for_each(|response| *response -= smallest);
        let wanted = (self.ratio * pairs.len() as f64) as usize;
        let drawn = match self.mac.mode {
            Mode::Faithful => draw(&responses, wanted, self.seed, false),
            Mode::Fixed => draw(&responses, wanted.max(self.min_sample), self.seed, true),
        };
        (drawn, matches!(graph, Some((0, _))))
    }
}

/// `|L d|` for the degree signal `d` and the Laplacian `L` of the second-order graph in which every node is joined to
/// itself: `W_ii = sum of s_ik^2` and `2 s_ij^2` more than without for the others.
fn responses(graph: &ScoreGraph) -> Vec<f64> {
    let weights = |i: usize| {
        let row = graph.scores(i).iter().zip(graph.weights(i));
        row.map(|(&score, &weight)| f64::from(weight) + 2.0 * f64::from(score).powi(2))
    };
    let degrees: Vec<f64> = (0..graph.len())
        .map(|i| {
            let own: f64 = graph.scores(i).iter().map(|&score| f64::from(score).powi(2)).sum();
            1.0 + own + weights(i).sum::<f64>()
        })
        .collect();
    // The weight of a node with itself drops out.
    (0..graph.len())
        .map(|i| {
            let edges = graph.neighbours(i).iter().zip(weights(i));
            let flow = edges.map(|(&j, weight)| weight * (degrees[i] - degrees[j as usize]));
            flow.sum::<f64>().abs()
        })
        .collect()
}

/// Draws `count` indices without replacement with probabilities proportional to `weights`, ascending. Where fewer weights
/// are positive, others are drawn evenly if `fill`, and there are fewer otherwise.
///
/// The indices with the first arrivals of Poisson processes with the weights as rates (Efraimidis and Spirakis 2006).
fn draw(weights: &[f64], count: usize, seed: u64, fill: bool) -> Vec<usize> {
    let mut random = Random::new(seed, 0);
    let mut arrivals: Vec<(bool, f64, usize)> = (weights.iter().enumerate())
        .map(|(i, &weight)| {
            let time = -(1.0 - random.uniform()).ln();
            let positive = weight > 0.0;
            (!positive, if positive { time / weight } else { time }, i)
        })
        .filter(|(is_filler, ..)| fill || !is_filler)
        .collect();
    arrivals.sort_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)));
    let mut drawn: Vec<usize> = arrivals.into_iter().take(count).map(|(.., i)| i).collect();
    drawn.sort_unstable();
    drawn
}

impl PoseEstimator for FastMac {
    /// Uses the pairs alone; `NoPose` also if no more of them agree than random ones would.
    fn estimate(
        &self,
        _source: &PointCloud,
        _target: &PointCloud,
        pairs: &[Correspondence],
    ) -> Result<PoseEstimate> {
        let best = self.hypotheses(pairs, 2)?.into_iter().next();
        let best = best.ok_or_else(|| {
            Error::Internal("fastmac gave neither a pose nor an error".to_owned())
        })?;
        significance::require(&best.target_from_source, pairs, self.mac.inlier_threshold)?;
        Ok(best)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn draws_follow_the_weights_without_repeats() {
        let weights = [0.0, 1.0, 2.0, 3.0, 0.0, 4.0];
        let mut first = [0.0; 6];
        for seed in 0..20_000 {
            let drawn = draw(&weights, 1, seed, true);
            first[drawn[0]] += 1.0 / 20_000.0;
        }
        for (frequency, weight) in first.iter().zip(weights) {
            assert!((frequency - weight / 10.0).abs() < 0.015, "{first:?}");
        }
        assert_eq!(draw(&weights, 4, 1, true), [1, 2, 3, 5]);
        assert_eq!(draw(&weights, 5, 1, false), [1, 2, 3, 5]);
        assert_eq!(draw(&weights, 9, 1, true), [0, 1, 2, 3, 4, 5]);
        let filled: Vec<Vec<usize>> = (0..50).map(|seed| draw(&weights, 5, seed, true)).collect();
        assert!([0, 4].iter().all(|i| filled.iter().any(|drawn| drawn.contains(i))));
    }
}
