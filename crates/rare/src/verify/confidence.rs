//! From evidence to a probability, and from that to a verdict.

use serde::{Deserialize, Serialize};

use crate::scale::SceneKind;
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
/// The coefficients were fitted to poses that the refiner compared on development data, and to what it made of simulated
/// scans and of scans of different rooms, see `docs/measurements.md`.
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
        Model { intercept: -6.49, coefficients: [8.41, -6.47, -7.92, 0.51, 0.16, 0.0, 0.0] };

    /// Which of some poses of one pair is right, by evidence with support.
    pub const RANKING: Model =
        Model { intercept: 0.96, coefficients: [0.0, -3.97, -11.01, 0.0, 0.24, 3.30, 0.22] };

    /// Whether the best pose of a pair is right, which may have nothing in common: the confidence that is reported. It is
    /// a model of its own, because a search finds the most deceptive of all poses.
    pub const CONFIDENCE: Model =
        Model { intercept: -30.42, coefficients: [27.94, -3.68, -37.55, 1.04, 0.0, 3.95, 0.72] };

    /// The same for scans of objects. The cameras that look at them are made up: what seems to stand in free space may be
    /// the far side, so that right poses violate it, too.
    pub const CONFIDENCE_OF_OBJECTS: Model =
        Model { intercept: -7.08, coefficients: [5.13, -6.51, -6.03, 3.20, 0.01, 4.30, 0.60] };

    /// The model of the confidence for scans of a kind.
    #[must_use]
    pub fn confidence(kind: SceneKind) -> Model {
        match kind {
            SceneKind::Indoor | SceneKind::Lidar => Model::CONFIDENCE,
            SceneKind::Object => Model::CONFIDENCE_OF_OBJECTS,
        }
    }

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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::verify::{Contact, DepthConsistency, Support};

    /// What is known of a pose that is neither clearly right nor clearly wrong.
    fn evidence() -> Evidence {
        let consistency =
            DepthConsistency { agree: 600, occluded: 500, violation: 400, gross_violation: 100 };
        let contact = Contact {
            normal_agreement: 0.8,
            correlation: 0.2,
            compared: 400,
            ..Contact::default()
        };
        let support = Some(Support { matches: 200, inliers: 50, weaker_inliers: 20 });
        Evidence { consistency, contact, support }
    }

    #[test]
    fn signals_are_named_numbers() {
        let expected = [
            ("agreement", 0.6),
            ("occlusion", 1.0 / 3.0),
            ("gross_violations", 0.1),
            ("normal_agreement", 0.8),
            ("correlation", 4.0),
            ("support", 0.25),
            ("log_weaker_support", 21.0_f64.ln()),
        ];
        for ((name, value), (expected_name, expected)) in
            evidence().signals().into_iter().zip(expected)
        {
            assert_eq!(name, expected_name);
            assert!((value - expected).abs() < 1e-12, "{name}: {value}");
        }
        let nothing = Evidence::default().signals().map(|(_, value)| value);
        assert_eq!(nothing, [0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0]);
    }

    #[test]
    fn every_signal_counts_as_it_should() {
        let better: [fn(&mut Evidence); 6] = [
            |e| e.consistency = DepthConsistency { agree: 700, violation: 300, ..e.consistency },
            |e| e.consistency.occluded -= 100,
            |e| e.consistency.gross_violation -= 50,
            |e| e.contact.normal_agreement += 0.1,
            |e| e.contact.correlation += 0.1,
            |e| e.contact.compared += 100,
        ];
        let more_support: [fn(&mut Support); 2] = [|s| s.inliers += 10, |s| s.weaker_inliers += 5];
        let before = evidence();
        for (number, improve) in better.into_iter().enumerate() {
            let mut after = before;
            improve(&mut after);
            let gains = |model: Model| model.log_odds(&after) - model.log_odds(&before);
            assert!(gains(Model::SCREENING) > 0.0, "{number}");
            // A model may do without a signal, but must not take it for its opposite.
            let others = [Model::RANKING, Model::CONFIDENCE, Model::CONFIDENCE_OF_OBJECTS];
            assert!(others.map(gains).into_iter().all(|gain| gain >= 0.0), "{number}");
        }
        for (number, improve) in more_support.into_iter().enumerate() {
            let mut after = before;
            improve(after.support.as_mut().unwrap());
            let (confidence, screening) = (Model::CONFIDENCE, Model::SCREENING);
            assert!(confidence.probability(&after) > confidence.probability(&before), "{number}");
            assert_eq!(screening.probability(&after), screening.probability(&before), "{number}");
        }
    }

    #[test]
    fn coefficients_belong_to_the_signals_in_their_order() {
        let signals = evidence().signals();
        for number in 0..SIGNALS {
            let mut coefficients = [0.0; SIGNALS];
            coefficients[number] = 2.0;
            let log_odds = Model { intercept: -1.0, coefficients }.log_odds(&evidence());
            assert_eq!(log_odds, 2.0 * signals[number].1 - 1.0, "{number}");
        }
    }

    #[test]
    fn probabilities_are_logistic_and_extreme_where_all_agrees() {
        let model = Model { intercept: 1.5, coefficients: [0.0; SIGNALS] };
        assert!((model.probability(&evidence()) - 0.817_574_476).abs() < 1e-9);
        let perfect = Evidence {
            consistency: DepthConsistency { agree: 1000, ..DepthConsistency::default() },
            contact: Contact {
                normal_agreement: 1.0,
                correlation: 1.0,
                compared: 1000,
                ..Contact::default()
            },
            support: Some(Support { matches: 500, inliers: 500, weaker_inliers: 250 }),
        };
        for kind in [SceneKind::Indoor, SceneKind::Lidar, SceneKind::Object] {
            let model = Model::confidence(kind);
            assert!(model.probability(&perfect) > 0.99, "{kind:?}");
            assert!(model.probability(&Evidence::default()) < 0.1, "{kind:?}");
        }
        assert_ne!(Model::confidence(SceneKind::Object), Model::confidence(SceneKind::Indoor));
        assert!(Model::SCREENING.probability(&Evidence::default()) < 0.01);
        assert!(Model::RANKING.probability(&Evidence::default()) < 0.01);
    }

    #[test]
    fn the_model_is_that_for_what_is_known() {
        assert_eq!(Model::ranking(&evidence()), Model::RANKING);
        let unmatched = Evidence { support: None, ..evidence() };
        assert_eq!(Model::ranking(&unmatched), Model::SCREENING);
    }

    #[test]
    fn the_verdict_follows_the_confidence_first() {
        assert_eq!(Verdict::of(REJECT_BELOW - 1e-9, false), Verdict::Rejected);
        assert_eq!(Verdict::of(REJECT_BELOW - 1e-9, true), Verdict::Rejected);
        assert_eq!(Verdict::of(REJECT_BELOW, true), Verdict::KeptInitial);
        assert_eq!(Verdict::of(REJECT_BELOW, false), Verdict::Refined);
    }
}
