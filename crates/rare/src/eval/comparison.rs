//! Several methods on the same pairs, side by side.

use serde::Serialize;

use super::bootstrap::Interval;
use super::protocol::{Protocol, Rules, Success};
use super::scored::ScoredPair;
use super::summary::{Average, Summary, solved_by_all};
use super::table::Table;

/// A method and what it made of every pair; all methods have the same pairs in the same order.
#[derive(Debug, Clone, PartialEq)]
pub struct MethodResult {
    /// As tables name it.
    pub name: String,
    /// One per pair of the benchmark.
    pub pairs: Vec<ScoredPair>,
    /// Pairs that the method has not been tried on.
    pub untried: usize,
}

/// Methods under one protocol.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Comparison {
    /// The protocol.
    pub protocol: Protocol,
    /// Its rules in force.
    pub rules: Rules,
    /// In the order in which they were given.
    pub methods: Vec<MethodSummary>,
    /// Pairs that every method solves.
    pub solved_by_all: usize,
}

/// One method of a [`Comparison`].
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MethodSummary {
    /// Its name.
    pub name: String,
    /// Under the rules of the comparison.
    pub summary: Summary,
    /// The same without the traps of the published numbers.
    pub exact: Summary,
    /// Pairs that the method has not been tried on; they count as not solved.
    pub untried: usize,
    /// Errors over the pairs that every method solves, degrees.
    pub common_rotation: Average,
    /// The same, metres.
    pub common_translation: Average,
}

impl Comparison {
    /// Compares methods.
    #[must_use]
    pub fn new(methods: &[MethodResult], protocol: Protocol, rules: Rules) -> Comparison {
        let pairs: Vec<&[ScoredPair]> = methods.iter().map(|method| &method.pairs[..]).collect();
        let common = solved_by_all(&pairs, &rules);
        let summarise = |method: &MethodResult| {
            let errors: Vec<_> =
                common.iter().filter_map(|&index| method.pairs.get(index)?.errors).collect();
            let rotations: Vec<f64> =
                errors.iter().map(|error| error.rotation(rules.official_errors)).collect();
            let translations: Vec<f64> = errors.iter().map(|error| error.translation).collect();
            MethodSummary {
                name: method.name.clone(),
                untried: method.untried,
                summary: Summary::of(&method.pairs, &rules),
                exact: Summary::of(&method.pairs, &rules.exact()),
                common_rotation: Average::of(&rotations),
                common_translation: Average::of(&translations),
            }
        };
        Comparison {
            protocol,
            rules,
            methods: methods.iter().map(summarise).collect(),
            solved_by_all: common.len(),
        }
    }

    /// Recall and errors of all methods.
    #[must_use]
    pub fn table(&self) -> Table {
        let titles = [
            "method",
            "RR % ↑",
            "95 %",
            "solved",
            "RE ° ↓",
            "TE m ↓",
            "median RE ° ↓",
            "median TE m ↓",
            "RE ° all ↓",
            "median RE ° all ↓",
            "median TE m all ↓",
            "exact RR % ↑",
            "exact RE ° ↓",
            "RE ° common ↓",
            "TE m common ↓",
        ];
        Table {
            caption: self.caption(),
            titles: titles.map(str::to_owned).to_vec(),
            rows: self.methods.iter().map(|method| self.row(method)).collect(),
            notes: self.notes(),
        }
    }

    fn row(&self, method: &MethodSummary) -> Vec<String> {
        let MethodSummary { name, summary, exact, common_rotation, common_translation, .. } =
            method;
        let [rotation, translation] = self.of_solved(summary);
        vec![
            name.clone(),
            percent(summary.recall),
            interval(summary.recall_interval),
            format!("{}/{}", summary.solved, summary.pairs),
            digits(rotation.mean, 3),
            digits(translation.mean, 4),
            digits(rotation.median, 3),
            digits(translation.median, 4),
            digits(summary.of_all.rotation.pairs.mean, 2),
            digits(summary.of_all.rotation.pairs.median, 2),
            digits(summary.of_all.translation.pairs.median, 4),
            percent(exact.recall),
            digits(self.of_solved(exact)[0].mean, 3),
            digits(common_rotation.mean, 3),
            digits(common_translation.mean, 4),
        ]
    }

    /// Recall, rotation and translation error as the paper's tables have them.
    #[must_use]
    pub fn paper_table(&self) -> Table {
        let row = |method: &MethodSummary| {
            let [rotation, translation] = self.of_solved(&method.summary);
            vec![
                method.name.clone(),
                percent(method.summary.recall),
                digits(rotation.mean, 2),
                digits(translation.mean, 3),
            ]
        };
        Table {
            caption: self.caption(),
            titles: ["Method", "RR ↑", "RE ↓", "TE ↓"].map(str::to_owned).to_vec(),
            rows: self.methods.iter().map(row).collect(),
            notes: Vec::new(),
        }
    }

    /// Recall and errors by scene.
    #[must_use]
    pub fn scene_table(&self) -> Table {
        let titles = [
            "method",
            "scene",
            "RR % ↑",
            "solved",
            "RE ° ↓",
            "TE m ↓",
            "median RE ° ↓",
            "median TE m ↓",
        ];
        let rows = self.methods.iter().flat_map(|method| {
            method.summary.scenes.iter().map(|scene| {
                vec![
                    method.name.clone(),
                    scene.scene.clone(),
                    percent(scene.recall()),
                    format!("{}/{}", scene.solved, scene.pairs),
                    digits(scene.rotation.mean, 3),
                    digits(scene.translation.mean, 4),
                    digits(scene.rotation.median, 3),
                    digits(scene.translation.median, 4),
                ]
            })
        });
        Table {
            caption: self.caption() + ", by scene",
            titles: titles.map(str::to_owned).to_vec(),
            rows: rows.collect(),
            notes: Vec::new(),
        }
    }

    /// Rotation and translation errors of the solved pairs, over scenes or pairs as the rules say.
    fn of_solved(&self, summary: &Summary) -> [Average; 2] {
        let averages = [summary.of_solved.rotation, summary.of_solved.translation];
        averages
            .map(|averages| if self.rules.over_scenes { averages.scenes } else { averages.pairs })
    }

    fn caption(&self) -> String {
        let success = match self.rules.success {
            Success::Rmse(limit) => format!("RMSE <= {limit} m"),
            Success::Pose { rotation, translation } => {
                format!("RE < {rotation} degrees and TE < {translation} m")
            }
        };
        let pairs = if self.rules.non_consecutive { "non-consecutive pairs" } else { "all pairs" };
        let over = if self.rules.over_scenes { "mean over scenes" } else { "over pairs" };
        format!("protocol {}: {success}, {pairs}, {over}", self.protocol.name())
    }

    fn notes(&self) -> Vec<String> {
        let mut notes = vec![
            "RE, TE: means and medians of the solved pairs; all: of all pairs, one without an estimate counts as 180 degrees"
                .to_owned(),
            format!("common: the {} pairs that every method solves", self.solved_by_all),
            "exact: no pair left out by accident, errors against the rigid transform nearest to the truth".to_owned(),
        ];
        let missing = self.methods.iter().filter(|method| method.summary.missing > 0);
        notes.extend(missing.map(|method| {
            format!(
                "{}: {} pairs without an estimate are not solved",
                method.name, method.summary.missing
            )
        }));
        let untried = self.methods.iter().filter(|method| method.untried > 0);
        notes.extend(untried.map(|method| {
            format!("{}: not finished, {} pairs have not been tried", method.name, method.untried)
        }));
        notes
    }
}

/// A share as a percentage; `-` for none.
fn percent(share: Option<f64>) -> String {
    digits(share.map(|share| 100.0 * share), 1)
}

/// A number with so many digits after the point; `-` for none or one that is not finite.
fn digits(value: Option<f64>, digits: usize) -> String {
    match value.filter(|value| value.is_finite()) {
        Some(value) => format!("{value:.digits$}"),
        None => "-".to_owned(),
    }
}

fn interval(interval: Option<Interval>) -> String {
    let text =
        |interval: Interval| format!("{:.1}-{:.1}", 100.0 * interval.low, 100.0 * interval.high);
    interval.map_or("-".to_owned(), text)
}
