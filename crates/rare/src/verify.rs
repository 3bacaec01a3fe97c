//! Step 9: is this transform believable? Evidence for and against a pose, without ground truth.
//!
//! Three kinds of evidence that hardly depend on each other. *Visibility*: seen from both sensors, the moved cloud must
//! not stand in space that was seen to be empty; a wrong pose violates free space however many correspondences vote for
//! it. *Contact*: where the surfaces touch they must be close, parallel, and the same things must meet. *Support*: depth
//! maps rendered under the right pose show the same things at the same places, so their features match there.
//! [`Model`] weighs them; poses are ranked, accepted and refused by nothing else.

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
pub use visibility::{DepthConsistency, Visibility, VisibilityMask};

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

impl Verifier<'_> {
    /// What the cameras of `frame` say of points of the other cloud (in its own frame, the unit of the clouds): of each the
    /// gravest, since one sensor that looked through a surface refutes it.
    #[must_use]
    pub fn visibility(
        &self,
        frame: Frame,
        points: &[Point3<f64>],
        reference_from_source: &RigidTransform,
    ) -> Vec<Visibility> {
        let mut gravest = vec![Visibility::Unseen; points.len()];
        for view in self.views.iter().filter(|view| view.frame() == frame) {
            let seen = view.see(points, reference_from_source, self.voxel);
            for (gravest, seen) in gravest.iter_mut().zip(seen) {
                *gravest = (*gravest).max(seen);
            }
        }
        gravest
    }

    /// What each camera says of what the other cloud shows in its pixels, in the order of the viewpoints.
    #[must_use]
    pub fn masks(&self, reference_from_source: &RigidTransform) -> Vec<VisibilityMask> {
        let mask = |view: &OwnView| {
            let moved = if view.frame() == Frame::Reference { self.source } else { self.reference };
            view.mask(moved.points, reference_from_source, self.voxel)
        };
        self.views.par_iter().map(mask).collect()
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;
    use crate::data::{Camera, Intrinsics, KdTree};
    use crate::features::estimate_normals;

    const VOXEL: f64 = 0.05;

    fn along_z(by: f64) -> RigidTransform {
        RigidTransform::from_translation(Vector3::new(0.0, 0.0, by))
    }

    #[test]
    fn support_counts_by_view() {
        // Pairs that a shift of 1 m along z brings so far apart.
        let pairs = |apart: &[f64]| -> Vec<Correspondence> {
            let pair = |&apart: &f64| Correspondence {
                source: Point3::origin(),
                target: Point3::new(apart, 0.0, 1.0),
                score: 1.0,
            };
            apart.iter().map(pair).collect()
        };
        let reference = pairs(&[0.0, 0.049, 0.051, -0.03]);
        let source = pairs(&[0.5, 0.02]);
        let found = Support::new([&reference, &source], &along_z(1.0), VOXEL);
        assert_eq!(found, Support { matches: 6, inliers: 4, weaker_inliers: 1 });
        let swapped = Support::new([&source, &reference], &along_z(1.0), VOXEL);
        assert_eq!(swapped, found);
        let wrong = Support::new([&reference, &source], &along_z(0.0), VOXEL);
        assert_eq!(wrong, Support { matches: 6, inliers: 0, weaker_inliers: 0 });
        assert_eq!(Support::new([&[], &[]], &along_z(0.0), VOXEL), Support::default());
    }

    /// A plane 2 m before the origin with its index and its descriptors.
    struct Plane {
        points: Vec<Point3<f64>>,
        surface: IcpTarget,
        landmarks: Landmarks,
    }

    impl Plane {
        /// From column `from` of the grid to column 12.
        fn new(from: i32) -> Plane {
            let at = |i: i32| f64::from(i) * VOXEL;
            let columns = (from..12).flat_map(|x| (-12..12).map(move |y| (at(x), at(y))));
            let points: Vec<Point3<f64>> = columns.map(|(x, y)| Point3::new(x, y, 2.0)).collect();
            let normals = estimate_normals(&points, &KdTree::new(&points), 2.0 * VOXEL, 20);
            let indices: Vec<usize> = (0..points.len()).collect();
            let landmarks =
                Landmarks::describe(&points, &indices, VOXEL, Some(&Point3::origin())).unwrap();
            let surface = IcpTarget::new(points.clone(), normals).unwrap();
            Plane { points, surface, landmarks }
        }

        fn judged(&self) -> JudgedCloud<'_> {
            let Plane { points, surface, landmarks } = self;
            JudgedCloud { points, surface, landmarks }
        }
    }

    fn viewpoint(frame: Frame) -> Viewpoint {
        let intrinsics =
            Intrinsics { width: 64, height: 64, fx: 80.0, fy: 80.0, cx: 32.0, cy: 32.0 };
        let camera = Camera { intrinsics, camera_from_world: RigidTransform::identity() };
        Viewpoint { frame, camera }
    }

    #[test]
    fn poses_are_judged_by_sensors_and_surfaces() {
        let (reference, source) = (Plane::new(-12), Plane::new(0));
        let judge = |frame, by| {
            let viewpoints = [viewpoint(frame)];
            let verifier = Verifier::new(reference.judged(), source.judged(), &viewpoints, VOXEL);
            verifier.judge(&along_z(by))
        };
        let right = judge(Frame::Reference, 0.0);
        assert_eq!(right.consistency.agree, source.points.len(), "{right:?}");
        assert_eq!((right.contact.source_share, right.contact.residual), (1.0, 0.0));
        assert!((0.5..0.6).contains(&right.contact.reference_share), "{right:?}");
        assert_eq!(right.support, None);
        // Half a metre behind the one cloud is half a metre before the other; neither touches.
        let (behind, before) = (judge(Frame::Reference, 0.5), judge(Frame::Source, 0.5));
        assert!(behind.consistency.occluded > 200 && behind.consistency.violation == 0);
        assert!(before.consistency.gross_violation > 200 && before.consistency.occluded == 0);
        assert_eq!((behind.contact, before.contact), (Contact::default(), Contact::default()));
    }
}
