//! Many pairs in a few numbers.

use serde::Serialize;

use super::bootstrap::{self, Interval};
use super::protocol::Rules;
use super::scored::ScoredPair;

/// A method on a set of pairs under some rules.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Summary {
    /// Pairs that count.
    pub pairs: usize,
    /// Of those, solved.
    pub solved: usize,
    /// Of those, without an estimate.
    pub missing: usize,
    /// Registration recall, 0 to 1: of scenes or of pairs, as the rules say; `None` without pairs.
    pub recall: Option<f64>,
    /// Where 95 % of the recalls lie when pairs are drawn anew from each scene.
    pub recall_interval: Option<Interval>,
    /// Solved pairs over all pairs, 0 to 1.
    pub pair_recall: Option<f64>,
    /// Errors of the solved pairs.
    pub of_solved: PoseAverages,
    /// Errors of all pairs; one without an estimate counts as 180 degrees and infinitely far.
    pub of_all: PoseAverages,
    /// By scene, in the order of first appearance.
    pub scenes: Vec<SceneSummary>,
}

/// One scene of a [`Summary`].
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SceneSummary {
    /// Its name.
    pub scene: String,
    /// Pairs that count.
    pub pairs: usize,
    /// Of those, solved.
    pub solved: usize,
    /// Errors of the solved pairs.
    pub rotation: Average,
    /// Errors of the solved pairs.
    pub translation: Average,
}

/// Rotation (degrees) and translation (metres).
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PoseAverages {
    /// Degrees.
    pub rotation: Averages,
    /// Metres.
    pub translation: Averages,
}

/// The averages that publications use; `None` where there is nothing to average.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Averages {
    /// Over pairs.
    pub pairs: Average,
    /// The means over scenes of the scenes' averages; scenes without a value are left out.
    pub scenes: Average,
    /// Where 95 % of the means over pairs lie when pairs are drawn anew.
    pub interval: Option<Interval>,
}

/// Mean and median.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Average {
    /// The mean.
    pub mean: Option<f64>,
    /// The median: of an even number of values, the middle of the two in the middle.
    pub median: Option<f64>,
}

impl Average {
    /// Of some values; `None` for none.
    #[must_use]
    pub fn of(values: &[f64]) -> Average {
        let mut sorted = values.to_vec();
        sorted.sort_by(f64::total_cmp);
        let middle = sorted.len() / 2;
        let median = match sorted.get(middle) {
            Some(&upper) if sorted.len().is_multiple_of(2) => {
                Some((sorted[middle - 1] + upper) / 2.0)
            }
            other => other.copied(),
        };
        Average { mean: mean(values), median }
    }
}

impl Summary {
    /// Of all pairs of a method.
    #[must_use]
    pub fn of(pairs: &[ScoredPair], rules: &Rules) -> Summary {
        let counted: Vec<&ScoredPair> = pairs.iter().filter(|pair| rules.counts(pair)).collect();
        let scenes = by_scene(&counted);
        let solved = |pairs: &[&ScoredPair]| pairs.iter().filter(|pair| rules.solved(pair)).count();
        let hits: Vec<Vec<bool>> = scenes
            .iter()
            .map(|(_, pairs)| pairs.iter().map(|pair| rules.solved(pair)).collect())
            .collect();
        let pair_recall = mean_of_flags(&hits.concat());
        Summary {
            pairs: counted.len(),
            solved: solved(&counted),
            missing: counted.iter().filter(|pair| pair.errors.is_none()).count(),
            recall: recall(&hits, rules.over_scenes),
            recall_interval: bootstrap::interval_of_recall(&hits, |hits| {
                recall(hits, rules.over_scenes)
            }),
            pair_recall,
            of_solved: averages(&scenes, rules, |pair| rules.solved(pair)),
            of_all: averages(&scenes, rules, |_| true),
            scenes: scenes
                .iter()
                .map(|(name, pairs)| SceneSummary::of(name, pairs, rules))
                .collect(),
        }
    }
}

impl SceneSummary {
    fn of(scene: &str, pairs: &[&ScoredPair], rules: &Rules) -> SceneSummary {
        let solved: Vec<&ScoredPair> =
            pairs.iter().filter(|pair| rules.solved(pair)).copied().collect();
        SceneSummary {
            scene: scene.to_owned(),
            pairs: pairs.len(),
            solved: solved.len(),
            rotation: Average::of(&rotations(&solved, rules)),
            translation: Average::of(&translations(&solved)),
        }
    }

    /// Solved pairs over pairs.
    #[must_use]
    pub fn recall(&self) -> Option<f64> {
        (self.pairs > 0).then(|| self.solved as f64 / self.pairs as f64)
    }
}

/// The indices of the pairs that count and that every method solves; the methods' pairs stand in the same order.
#[must_use]
pub fn solved_by_all(methods: &[&[ScoredPair]], rules: &Rules) -> Vec<usize> {
    let Some(first) = methods.first() else { return Vec::new() };
    let solved = |index: usize| {
        methods.iter().all(|pairs| {
            pairs.get(index).is_some_and(|pair| rules.counts(pair) && rules.solved(pair))
        })
    };
    (0..first.len()).filter(|&index| solved(index)).collect()
}

fn averages(
    scenes: &[(&str, Vec<&ScoredPair>)],
    rules: &Rules,
    keep: impl Fn(&ScoredPair) -> bool,
) -> PoseAverages {
    let kept: Vec<Vec<&ScoredPair>> = (scenes.iter())
        .map(|(_, pairs)| pairs.iter().copied().filter(|pair| keep(pair)).collect())
        .collect();
    let rotations: Vec<Vec<f64>> = kept.iter().map(|pairs| rotations(pairs, rules)).collect();
    let translations: Vec<Vec<f64>> = kept.iter().map(|pairs| translations(pairs)).collect();
    PoseAverages { rotation: Averages::of(&rotations), translation: Averages::of(&translations) }
}

impl Averages {
    /// Of the values of each scene.
    fn of(scenes: &[Vec<f64>]) -> Averages {
        let by_scene: Vec<Average> = scenes.iter().map(|values| Average::of(values)).collect();
        let over = |average: fn(&Average) -> Option<f64>| {
            mean(&by_scene.iter().filter_map(average).collect::<Vec<f64>>())
        };
        Averages {
            pairs: Average::of(&scenes.concat()),
            scenes: Average { mean: over(|scene| scene.mean), median: over(|scene| scene.median) },
            interval: bootstrap::interval_of_mean(scenes),
        }
    }
}

/// The scenes in the order in which they appear.
fn by_scene<'a>(pairs: &[&'a ScoredPair]) -> Vec<(&'a str, Vec<&'a ScoredPair>)> {
    let mut scenes: Vec<(&str, Vec<&ScoredPair>)> = Vec::new();
    let mut places = std::collections::BTreeMap::new();
    for pair in pairs {
        let place = *places.entry(pair.scene.as_str()).or_insert(scenes.len());
        if place == scenes.len() {
            scenes.push((&pair.scene, Vec::new()));
        }
        scenes[place].1.push(pair);
    }
    scenes
}

fn recall(scenes: &[Vec<bool>], over_scenes: bool) -> Option<f64> {
    if over_scenes {
        mean(&scenes.iter().filter_map(|scene| mean_of_flags(scene)).collect::<Vec<f64>>())
    } else {
        mean_of_flags(&scenes.concat())
    }
}

fn rotations(pairs: &[&ScoredPair], rules: &Rules) -> Vec<f64> {
    let error = |pair: &&ScoredPair| {
        pair.errors.map_or(180.0, |errors| errors.rotation(rules.official_errors))
    };
    pairs.iter().map(error).collect()
}

fn translations(pairs: &[&ScoredPair]) -> Vec<f64> {
    pairs
        .iter()
        .map(|pair| pair.errors.map_or(f64::INFINITY, |errors| errors.translation))
        .collect()
}

fn mean_of_flags(flags: &[bool]) -> Option<f64> {
    mean(&flags.iter().map(|&flag| f64::from(u8::from(flag))).collect::<Vec<f64>>())
}

pub(super) fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}
