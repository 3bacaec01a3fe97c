//! What counts as success, which pairs count, and how errors are averaged: the protocols of the literature.

use serde::{Deserialize, Serialize};

use super::scored::ScoredPair;

/// A protocol by the name under which its numbers are published.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Protocol {
    /// 3DMatch and 3DLoMatch as Predator, CoFiNet and GeoTransformer: RMSE at most 0.2 m, pairs of fragments that do not
    /// follow one another, recall per scene and then its mean over scenes; errors of successes, median or mean per
    /// scene and then the mean over scenes.
    Predator,
    /// 3DMatch and 3DLoMatch as DGR, PointDSC, SC2-PCR, MAC: below 15 degrees and 0.3 m, all pairs, averaged over pairs.
    Dgr,
    /// KITTI as FCGF, Predator, CoFiNet and GeoTransformer: below 5 degrees and 2 m, averaged over pairs.
    #[serde(rename = "kitti-2m")]
    Kitti2m,
    /// KITTI as PointDSC, SC2-PCR and MAC: below 5 degrees and 0.6 m, averaged over pairs.
    #[serde(rename = "kitti-60cm")]
    Kitti60cm,
    /// Data of one's own: below 15 degrees and 0.3 m, all pairs, averaged over pairs, exact rotation angles.
    Plain,
}

/// When a pair is solved.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case", deny_unknown_fields)]
pub enum Success {
    /// The root mean square error of the overlapping points is at most this, metres.
    Rmse(f64),
    /// Both errors are below these.
    Pose {
        /// Degrees.
        rotation: f64,
        /// Metres.
        translation: f64,
    },
}

/// What is counted and how.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Rules {
    /// When a pair is solved.
    pub success: Success,
    /// Whether pairs of consecutive fragments are left out.
    pub non_consecutive: bool,
    /// Leaves the first pair of a scene's list out unless it is consecutive, as Predator's script does by using the
    /// list's index as a flag. Without effect on 3DMatch; seven pairs of 3DLoMatch.
    pub predator_index_zero: bool,
    /// Whether recall is that of the scenes' mean, or of all pairs.
    pub over_scenes: bool,
    /// Whether errors are measured against the truth as its file holds it (the formula of the scripts), or against the
    /// nearest rigid transform.
    pub official_errors: bool,
}

impl Protocol {
    /// All of them, in the order in which they are reported.
    pub const ALL: [Protocol; 5] = [
        Protocol::Predator,
        Protocol::Dgr,
        Protocol::Kitti2m,
        Protocol::Kitti60cm,
        Protocol::Plain,
    ];

    /// The name on the command line.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Protocol::Predator => "predator",
            Protocol::Dgr => "dgr",
            Protocol::Kitti2m => "kitti-2m",
            Protocol::Kitti60cm => "kitti-60cm",
            Protocol::Plain => "plain",
        }
    }

    /// Whether it is one for scans of streets.
    #[must_use]
    pub fn is_outdoors(self) -> bool {
        matches!(self, Protocol::Kitti2m | Protocol::Kitti60cm)
    }

    /// The rules with which its published numbers were made, traps included.
    #[must_use]
    pub fn published(self) -> Rules {
        let pose = |rotation, translation| Success::Pose { rotation, translation };
        let over_pairs = Rules {
            success: pose(15.0, 0.3),
            non_consecutive: false,
            predator_index_zero: false,
            over_scenes: false,
            official_errors: true,
        };
        match self {
            Protocol::Predator => Rules {
                success: Success::Rmse(0.2),
                non_consecutive: true,
                predator_index_zero: true,
                over_scenes: true,
                ..over_pairs
            },
            Protocol::Dgr => over_pairs,
            Protocol::Kitti2m => Rules { success: pose(5.0, 2.0), ..over_pairs },
            Protocol::Kitti60cm => Rules { success: pose(5.0, 0.6), ..over_pairs },
            Protocol::Plain => Rules { official_errors: false, ..over_pairs },
        }
    }
}

impl Rules {
    /// The same without the traps: no pair left out by accident, the truth made rigid.
    #[must_use]
    pub fn exact(self) -> Rules {
        Rules { predator_index_zero: false, official_errors: false, ..self }
    }

    /// Whether a pair counts at all.
    #[must_use]
    pub fn counts(&self, pair: &ScoredPair) -> bool {
        let consecutive = pair.source.abs_diff(pair.reference) <= 1;
        let dropped = self.predator_index_zero && pair.is_first_of_scene;
        !(self.non_consecutive && (consecutive || dropped))
    }

    /// Whether a pair is solved. One without an estimate is not.
    #[must_use]
    pub fn solved(&self, pair: &ScoredPair) -> bool {
        let Some(errors) = &pair.errors else { return false };
        match self.success {
            Success::Rmse(limit) => errors.rmse.is_some_and(|rmse| rmse * rmse <= limit * limit),
            Success::Pose { rotation, translation } => {
                errors.rotation(self.official_errors) < rotation && errors.translation < translation
            }
        }
    }
}
