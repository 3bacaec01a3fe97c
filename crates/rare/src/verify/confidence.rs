//! From evidence to a probability, and from that to a verdict.

use serde::{Deserialize, Serialize};

use crate::verify::Evidence;

/// What to make of a result.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// A better transform than the initial one was found and verified.
    Refined,
    /// The initial transform stands: nothing better was found.
    KeptInitial,
    /// No transform that can be believed; the best guess is given.
    Rejected,
}

/// Below this confidence a result is rejected.
pub const REJECT_BELOW: f64 = 0.5;

impl Verdict {
    /// The verdict on a pose of some confidence.
    #[must_use]
    pub fn of(confidence: f64, is_initial: bool) -> Verdict {
        match (confidence < REJECT_BELOW, is_initial) {
            (true, _) => Verdict::Rejected,
            (false, true) => Verdict::KeptInitial,
            (false, false) => Verdict::Refined,
        }
    }
}

/// Numbers that the models weigh.
const SIGNALS: usize = 7;

impl Evidence {
    /// The evidence as the models weigh it, with names. Counts enter by their logarithms: a thousand agreeing points
    /// are not a hundred times the proof of ten.
    #[must_use]
    pub fn signals(&self) -> [(&'static str, f64); SIGNALS] {
        let Evidence { consistency, contact, support } = self;
        let support = support.unwrap_or_default();
        let logarithm = |count: usize| (count as f64).ln_1p();
        [
            ("agreement", consistency.agreement()),
            ("occlusion", consistency.occlusion()),
            ("gross_violations", consistency.gross_share()),
            ("normal_agreement", contact.normal_agreement),
            // In standard deviations of what pairs without anything in common would give.
            ("correlation", contact.correlation * (contact.compared as f64).sqrt()),
            ("support", support.inliers as f64 / support.matches.max(1) as f64),
            ("log_weaker_support", logarithm(support.weaker_inliers)),
        ]
    }
}

/// A logistic model: the probability is that of an intercept plus weighted signals.
///
/// The coefficients were fitted to poses that the refiner compared on development data, and to what it made of scans of
/// different rooms, see `docs/measurements.md`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Model {
    /// The log-odds without any signal.
    pub intercept: f64,
    /// The change of the log-odds by each of [`Evidence::signals`].
    pub coefficients: [f64; SIGNALS],
}

impl Model {
    /// Which of many poses of one pair is right, by evidence without support.
    pub const SCREENING: Model =
        Model { intercept: -6.48, coefficients: [8.63, -6.62, -7.61, 0.03, 0.19, 0.0, 0.0] };

    /// Which of some poses of one pair is right, by evidence with support.
    pub const RANKING: Model =
        Model { intercept: -0.62, coefficients: [1.60, -3.86, -9.15, 0.0, 0.24, 4.67, 0.11] };

    /// Whether the best pose of a pair is right, which may have nothing in common: the confidence that is reported. It is
    /// a model of its own, because a search finds the most deceptive of all poses.
    pub const CONFIDENCE: Model =
        Model { intercept: -17.69, coefficients: [14.42, -1.31, -26.07, 0.0, 0.29, 1.58, 0.70] };

    /// The model that ranks poses of which so much is known.
    #[must_use]
    pub fn ranking(evidence: &Evidence) -> Model {
        if evidence.support.is_some() { Model::RANKING } else { Model::SCREENING }
    }

    /// The log-odds that a pose with this evidence is right.
    #[must_use]
    pub fn log_odds(&self, evidence: &Evidence) -> f64 {
        let weighed = evidence.signals().into_iter().zip(self.coefficients);
        self.intercept + weighed.map(|((_, signal), weight)| signal * weight).sum::<f64>()
    }

    /// The probability, 0 to 1, that a pose with this evidence is right.
    #[must_use]
    pub fn probability(&self, evidence: &Evidence) -> f64 {
        1.0 / (1.0 + (-self.log_odds(evidence)).exp())
    }
}
