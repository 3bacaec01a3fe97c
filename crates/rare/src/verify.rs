//! Step 9: is this transform believable? Evidence for and against a pose, without ground truth.
//!
//! Three kinds of evidence that hardly depend on each other. *Visibility*: seen from both sensors, the moved cloud must
//! not stand in space that was seen to be empty; a wrong pose violates free space however many correspondences vote for
//! it. *Contact*: where the surfaces touch they must be close, parallel, and the same things must meet. *Support*: depth
//! maps rendered under the right pose show the same things at the same places, so their features match there.
//! [`confidence`] weighs them; poses are ranked, accepted and refused by nothing else.

mod confidence;
mod contact;
mod overlap;
mod visibility;

use nalgebra::Point3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

pub use confidence::{Model, REJECT_BELOW, Verdict};
pub use contact::Contact;
pub use overlap::{Overlap, overlap};
pub use visibility::DepthConsistency;

use self::contact::Body;
use self::visibility::OwnView;
use crate::data::{Correspondence, RigidTransform};
use crate::features::Landmarks;
use crate::pose::IcpTarget;
use crate::viewpoints::{Frame, Viewpoint};

/// All that is known of a pose.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Evidence {
    /// What the sensors say.
    pub consistency: DepthConsistency,
    /// What the surfaces say.
    pub contact: Contact,
    /// What the depth maps say, if they were matched.
    pub support: Option<Support>,
}

/// How many matches of the features of depth maps agree with a pose.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Support {
    /// Matches in all views.
    pub matches: usize,
    /// Those that the pose brings closer together than a voxel.
    pub inliers: usize,
    /// Those of them in the views of the frame that has fewer.
    pub weaker_inliers: usize,
}

impl Support {
    /// Counts the matches of the reference's and of the source's views that agree with a pose.
    #[must_use]
    pub fn new(
        sets: [&[Correspondence]; 2],
        reference_from_source: &RigidTransform,
        voxel: f64,
    ) -> Support {
        let agreeing = |pairs: &[Correspondence]| {
            let distance = |pair: &Correspondence| {
                (reference_from_source.apply(&pair.source) - pair.target).norm()
            };
            pairs.iter().filter(|pair| distance(pair) < voxel).count()
        };
        let [reference, source] = sets.map(agreeing);
        Support {
            matches: sets[0].len() + sets[1].len(),
            inliers: reference + source,
            weaker_inliers: reference.min(source),
        }
    }
}

/// A cloud as it is judged; one frame, one unit.
#[derive(Debug, Clone, Copy)]
pub struct JudgedCloud<'a> {
    /// All points: what its sensor saw.
    pub points: &'a [Point3<f64>],
    /// Evenly spaced points with normals.
    pub surface: &'a IcpTarget,
    /// Evenly spaced points with normals and descriptors.
    pub landmarks: &'a Landmarks,
}

/// Judges poses of one pair of clouds. The cameras' own clouds are rendered once.
#[derive(Debug)]
pub struct Verifier<'a> {
    reference: JudgedCloud<'a>,
    source: JudgedCloud<'a>,
    views: Vec<OwnView>,
    voxel: f64,
}

impl<'a> Verifier<'a> {
    /// Renders each camera's own cloud. `voxel` is the sampling distance to which everything is relative, in the unit of
    /// the clouds, which are in their own frames.
    #[must_use]
    pub fn new(
        reference: JudgedCloud<'a>,
        source: JudgedCloud<'a>,
        viewpoints: &[Viewpoint],
        voxel: f64,
    ) -> Verifier<'a> {
        let own_view = |viewpoint: &Viewpoint| {
            let own = if viewpoint.frame == Frame::Reference { reference } else { source };
            OwnView::new(viewpoint, own.points)
        };
        let views = viewpoints.par_iter().map(own_view).collect();
        Verifier { reference, source, views, voxel }
    }

    /// The evidence of the surfaces and the sensors.
    #[must_use]
    pub fn judge(&self, reference_from_source: &RigidTransform) -> Evidence {
        let (reference, source) = (self.reference, self.source);
        let body =
            |cloud: JudgedCloud<'a>| Body { surface: cloud.surface, landmarks: cloud.landmarks };
        let (still, moved) = (reference.landmarks.points(), source.landmarks.points());
        Evidence {
            consistency: visibility::consistency(
                &self.views,
                still,
                moved,
                reference_from_source,
                self.voxel,
            ),
            contact: contact::contact(
                body(reference),
                body(source),
                reference_from_source,
                self.voxel,
            ),
            support: None,
        }
    }
}
