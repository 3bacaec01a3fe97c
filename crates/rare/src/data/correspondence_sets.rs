//! The correspondence sets that the aggregation votes over.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::data::Correspondence;

/// Which features, seen in which view, a set was matched by (section 3.3). "Reference view" is the view from the
/// reference cloud's sensor, "source view" the one from the source's.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum SetName {
    /// Fused features of the common points, reference view.
    #[serde(rename = "common_ref")]
    CommonReference,
    /// Fused features of the common points, source view.
    #[serde(rename = "common_src")]
    CommonSource,
    /// Depth-map features of the grid keypoints, reference view.
    #[serde(rename = "diffusion_ref")]
    DiffusionReference,
    /// Depth-map features of the grid keypoints, source view.
    #[serde(rename = "diffusion_src")]
    DiffusionSource,
    /// The 3-D features of the given keypoints.
    #[serde(rename = "features_3d")]
    Features3d,
}

impl SetName {
    /// The name as reports write it, for example `common_ref`.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            SetName::CommonReference => "common_ref",
            SetName::CommonSource => "common_src",
            SetName::DiffusionReference => "diffusion_ref",
            SetName::DiffusionSource => "diffusion_src",
            SetName::Features3d => "features_3d",
        }
    }
}

impl fmt::Display for SetName {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(self.as_str())
    }
}

/// The correspondences found by one kind of feature.
#[derive(Debug, Clone, PartialEq)]
pub struct CorrespondenceSet {
    /// The kind.
    pub name: SetName,
    /// The correspondences; over more than two views, those of all views of the kind.
    pub pairs: Vec<Correspondence>,
}

/// All sets of a pair of clouds, usually the paper's five. Any of them may be empty or missing.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct CorrespondenceSets {
    /// The sets.
    pub sets: Vec<CorrespondenceSet>,
}

impl CorrespondenceSets {
    /// All correspondences, set after set. A pair found by several features stands there as often: each find is a vote.
    #[must_use]
    pub fn union(&self) -> Vec<Correspondence> {
        self.sets.iter().flat_map(|set| &set.pairs).copied().collect()
    }

    /// The first set of a name, if there is one.
    #[must_use]
    pub fn of(&self, name: SetName) -> Option<&CorrespondenceSet> {
        self.sets.iter().find(|set| set.name == name)
    }

    /// The sets of either kind of feature alone.
    #[must_use]
    pub fn without_common_points(mut self) -> CorrespondenceSets {
        let is_common = |name| matches!(name, SetName::CommonReference | SetName::CommonSource);
        self.sets.retain(|set| !is_common(set.name));
        self
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_read_and_write_alike() {
        for name in [
            SetName::CommonReference,
            SetName::CommonSource,
            SetName::DiffusionReference,
            SetName::DiffusionSource,
            SetName::Features3d,
        ] {
            let json = serde_json::to_string(&name).unwrap();
            assert_eq!(json, format!("\"{name}\""));
            assert_eq!(serde_json::from_str::<SetName>(&json).unwrap(), name);
        }
    }
}
