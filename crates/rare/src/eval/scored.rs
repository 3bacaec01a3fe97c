//! A pair of a benchmark, the estimate of a method for it, and the errors of the one against the other.

use nalgebra::{Matrix4, Matrix6};

use super::metrics;

/// A pair of clouds whose true transform is known.
#[derive(Debug, Clone, PartialEq)]
pub struct TruePair {
    /// The scene or sequence.
    pub scene: String,
    /// Number of the source within the scene.
    pub source: usize,
    /// Number of the reference (target) within the scene.
    pub reference: usize,
    /// Moves the source into the frame of the reference, as its file holds it.
    pub target_from_source: Matrix4<f64>,
    /// The information matrix of the pair, for the RMSE.
    pub information: Option<Matrix6<f64>>,
    /// Share of the points that both clouds show, 0 to 1, if the benchmark says so.
    pub overlap: Option<f64>,
    /// Whether the pair stands first in its scene's list.
    pub is_first_of_scene: bool,
}

/// The errors of an estimate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Errors {
    /// By the formula of the official scripts, degrees.
    pub official_rotation: f64,
    /// Between the nearest rotations, degrees.
    pub exact_rotation: f64,
    /// Metres.
    pub translation: f64,
    /// Metres; `None` without an information matrix.
    pub rmse: Option<f64>,
}

impl Errors {
    /// Of an estimate (source to reference).
    #[must_use]
    pub fn of(estimate: &Matrix4<f64>, truth: &TruePair) -> Errors {
        let pose = &truth.target_from_source;
        let rmse = |information| metrics::registration_rmse(estimate, pose, information);
        Errors {
            official_rotation: metrics::official_rotation_error(estimate, pose),
            exact_rotation: metrics::rotation_error(estimate, pose),
            translation: metrics::translation_error(estimate, pose),
            rmse: truth.information.as_ref().and_then(rmse),
        }
    }

    /// The rotation error by the formula that is asked for, degrees.
    #[must_use]
    pub fn rotation(&self, official: bool) -> f64 {
        if official { self.official_rotation } else { self.exact_rotation }
    }
}

/// What a method made of a pair.
#[derive(Debug, Clone, PartialEq)]
pub struct ScoredPair {
    /// The scene or sequence.
    pub scene: String,
    /// Number of the source within the scene.
    pub source: usize,
    /// Number of the reference within the scene.
    pub reference: usize,
    /// Whether the pair stands first in its scene's list.
    pub is_first_of_scene: bool,
    /// Share of the points that both clouds show, if the benchmark says so.
    pub overlap: Option<f64>,
    /// `None` if the method gave no transform.
    pub errors: Option<Errors>,
}

impl ScoredPair {
    /// The estimate (source to reference) for a pair; `None` if there is none.
    #[must_use]
    pub fn new(truth: &TruePair, estimate: Option<&Matrix4<f64>>) -> ScoredPair {
        ScoredPair {
            scene: truth.scene.clone(),
            source: truth.source,
            reference: truth.reference,
            is_first_of_scene: truth.is_first_of_scene,
            overlap: truth.overlap,
            errors: estimate.map(|estimate| Errors::of(estimate, truth)),
        }
    }
}
