//! Step 9: is this transform believable? Two-way depth consistency, without ground truth.
//!
//! Both clouds are rendered into every virtual camera under the pose to be judged. Where both put a surface, the
//! surfaces *agree* (to within the noise expected at that depth), or the moved cloud is *occluded* by what the
//! camera's own cloud saw, or it stands *in front of* that, in space that was seen to be empty: a free-space
//! violation. A wrong pose violates free space however many correspondences vote for it; that ranks the candidates.

use nalgebra::{Matrix3x6, Matrix6, Point3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::data::{DepthMap, Intrinsics, KdTree, RigidTransform};
use crate::project::project_moved;
use crate::viewpoints::{Frame, Viewpoint};

/// Counts of low-resolution pixels over all virtual cameras.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct DepthConsistency {
    /// Both clouds put a surface at the same depth.
    pub agree: usize,
    /// The moved cloud lies behind what the camera's own cloud saw.
    pub occluded: usize,
    /// The moved cloud lies in front of it: in space that was seen to be empty.
    pub violation: usize,
    /// Pixels in which the camera's own cloud is seen.
    pub seen: usize,
}

impl DepthConsistency {
    /// Agreeing pixels minus twice the violating ones: the rank of a pose among candidates for the same pair.
    #[must_use]
    pub fn score(&self) -> f64 {
        self.agree as f64 - 2.0 * self.violation as f64
    }

    /// Share of the comparable pixels (agreeing or violating) that agree; 0 where there is none.
    #[must_use]
    pub fn agreement(&self) -> f64 {
        let comparable = self.agree + self.violation;
        if comparable == 0 { 0.0 } else { self.agree as f64 / comparable as f64 }
    }

    /// Share of what the cameras' own clouds show that the other cloud confirms; 0 where nothing is seen.
    #[must_use]
    pub fn coverage(&self) -> f64 {
        if self.seen == 0 { 0.0 } else { self.agree as f64 / self.seen as f64 }
    }
}

/// Judges poses of one pair of clouds. The cameras' own clouds are rendered once.
#[derive(Debug)]
pub struct Verifier<'a> {
    reference: &'a [Point3<f64>],
    source: &'a [Point3<f64>],
    views: Vec<OwnView>,
    tolerance: f64,
}

/// A camera with what its own cloud shows in it.
#[derive(Debug)]
struct OwnView {
    viewpoint: Viewpoint,
    own: DepthMap,
}

/// Verification looks at a quarter of the resolution, so that sparse clouds still cover their pixels.
const SHRINK: usize = 4;
/// Part of the tolerance that grows with depth.
const TOLERANCE_BY_DEPTH: f64 = 0.02;

impl<'a> Verifier<'a> {
    /// Renders each camera's own cloud. `tolerance` is the depth difference that noise explains close up, metres
    /// (one voxel); 2 % of the depth is added to it. The clouds are in their own frames.
    #[must_use]
    pub fn new(
        reference: &'a [Point3<f64>],
        source: &'a [Point3<f64>],
        viewpoints: &[Viewpoint],
        tolerance: f64,
    ) -> Verifier<'a> {
        let own_view = |viewpoint: &Viewpoint| {
            let cloud = if viewpoint.frame == Frame::Reference { reference } else { source };
            let viewpoint = shrunk(viewpoint);
            let own = project_moved(
                cloud,
                &viewpoint.camera.camera_from_world,
                &viewpoint.camera.intrinsics,
            )
            .depth_map;
            OwnView { viewpoint, own }
        };
        Verifier {
            reference,
            source,
            views: viewpoints.par_iter().map(own_view).collect(),
            tolerance,
        }
    }

    /// Compares the clouds in all cameras under a pose.
    #[must_use]
    pub fn consistency(&self, reference_from_source: &RigidTransform) -> DepthConsistency {
        self.views
            .par_iter()
            .map(|view| {
                let (cloud, camera_from_cloud) = match view.viewpoint.frame {
                    Frame::Reference => {
                        (self.source, view.viewpoint.camera_from_source(reference_from_source))
                    }
                    Frame::Source => (
                        self.reference,
                        view.viewpoint.camera_from_reference(reference_from_source),
                    ),
                };
                let moved =
                    project_moved(cloud, &camera_from_cloud, view.own.intrinsics()).depth_map;
                compare(&view.own, &moved, self.tolerance)
            })
            .reduce(DepthConsistency::default, |a, b| DepthConsistency {
                agree: a.agree + b.agree,
                occluded: a.occluded + b.occluded,
                violation: a.violation + b.violation,
                seen: a.seen + b.seen,
            })
    }
}

fn shrunk(viewpoint: &Viewpoint) -> Viewpoint {
    let full = viewpoint.camera.intrinsics;
    let factor = SHRINK as f64;
    let intrinsics = Intrinsics {
        width: (full.width / SHRINK).max(1),
        height: (full.height / SHRINK).max(1),
        fx: full.fx / factor,
        fy: full.fy / factor,
        cx: full.cx / factor,
        cy: full.cy / factor,
    };
    let mut small = *viewpoint;
    small.camera.intrinsics = intrinsics;
    small
}

fn compare(own: &DepthMap, moved: &DepthMap, tolerance: f64) -> DepthConsistency {
    let mut counts = DepthConsistency::default();
    for (&own, &moved) in own.depth().iter().zip(moved.depth()) {
        if own <= 0.0 {
            continue;
        }
        counts.seen += 1;
        if moved <= 0.0 {
            continue;
        }
        let difference = f64::from(moved) - f64::from(own);
        let tolerance = tolerance + TOLERANCE_BY_DEPTH * f64::from(own);
        if difference.abs() < tolerance {
            counts.agree += 1;
        } else if difference < 0.0 {
            counts.violation += 1;
        } else {
            counts.occluded += 1;
        }
    }
    counts
}

/// How much of the source lies on the reference under a pose, and how well that determines the pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Overlap {
    /// Share of the source points with a reference point within the distance, 0 to 1.
    pub share: f64,
    /// Sum of `G^T G` over those source points moved into the reference frame, `G = [I | -[p]x]`: the 6 x 6 matrix
    /// of 3DMatch's `gt.info`, translation first, metres. Element (0, 0) is the number of points.
    pub information: Matrix6<f64>,
}

/// Measures the overlap of evenly spaced (voxel) clouds under a pose, with `distance` in the clouds' unit of `unit`
/// metres.
#[must_use]
pub fn overlap(
    reference: &KdTree,
    source: &[Point3<f64>],
    reference_from_source: &RigidTransform,
    distance: f64,
    unit: f64,
) -> Overlap {
    let mut information = Matrix6::zeros();
    let mut count = 0_usize;
    for point in source {
        let moved = reference_from_source.apply(point);
        if reference.nearest_within(&moved, distance).is_some() {
            count += 1;
            let mut jacobian = Matrix3x6::zeros();
            jacobian.fixed_view_mut::<3, 3>(0, 0).fill_with_identity();
            jacobian.fixed_view_mut::<3, 3>(0, 3).copy_from(&-(moved.coords * unit).cross_matrix());
            information += jacobian.transpose() * jacobian;
        }
    }
    Overlap { share: count as f64 / source.len().max(1) as f64, information }
}

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

/// How believable a pose is, 0 to 1: a logistic function of the share of comparable pixels that agree, of the overlap
/// and of the share of the correspondences that agree (each 0 to 1).
///
/// The coefficients were fitted by ridge regression to the results of the default preset on the development pairs (see
/// `docs/measurements.md`); it is a first model, for ranking and for refusing what is clearly wrong.
#[must_use]
pub fn confidence(agreement: f64, overlap: f64, inlier_ratio: f64) -> f64 {
    let evidence = -13.21 + 11.61 * agreement + 3.19 * overlap + 8.75 * inlier_ratio;
    1.0 / (1.0 + (-evidence).exp())
}

#[cfg(test)]
mod tests {
    use nalgebra::{Rotation3, Vector3};

    use super::*;
    use crate::data::Camera;

    /// A plane at depth `z` that fills 16 x 12 pixels, one point per shrunk pixel, left of column `until`.
    fn plane(z: f64, until: usize) -> Vec<Point3<f64>> {
        let camera = shrunk(&viewpoint(Frame::Reference)).camera.intrinsics;
        let columns = |v: usize| (0..until).map(move |u| (u as f64, v as f64));
        (0..camera.height)
            .flat_map(columns)
            .map(|(u, v)| camera.back_project(u + 0.25, v + 0.25, z))
            .collect()
    }

    /// A camera at the origin, 64 x 48 pixels: 16 x 12 of the pixels that are compared.
    fn viewpoint(frame: Frame) -> Viewpoint {
        let intrinsics =
            Intrinsics { width: 64, height: 48, fx: 64.0, fy: 64.0, cx: 32.0, cy: 24.0 };
        let camera = Camera { intrinsics, camera_from_world: RigidTransform::identity() };
        Viewpoint { frame, camera }
    }

    fn along_z(by: f64) -> RigidTransform {
        RigidTransform::from_translation(Vector3::new(0.0, 0.0, by))
    }

    #[test]
    fn pixels_are_counted_by_who_stands_in_front() {
        // The source covers 5 of 8 columns that the reference shows, or 5 of 16 the other way round.
        let (reference, source) = (plane(2.0, 8), plane(2.0, 5));
        let counts = |frame, pose: &RigidTransform| {
            Verifier::new(&reference, &source, &[viewpoint(frame)], 0.05).consistency(pose)
        };
        // The tolerance is 5 cm and 2 % of 2 m.
        for by in [0.085, -0.085] {
            // The plane looks larger or smaller: some of its points change their pixels.
            let seen = counts(Frame::Reference, &along_z(by));
            assert!(seen.agree > 40, "{by}: {seen:?}");
            assert_eq!((seen.occluded, seen.violation, seen.seen), (0, 0, 96), "{by}");
        }
        let exact = counts(Frame::Reference, &RigidTransform::identity());
        assert_eq!(exact, DepthConsistency { agree: 60, occluded: 0, violation: 0, seen: 96 });
        let behind = counts(Frame::Reference, &along_z(0.1));
        assert_eq!((behind.agree, behind.violation), (0, 0));
        assert!(behind.occluded > 40, "{behind:?}");
        let before = counts(Frame::Reference, &along_z(-0.1));
        assert_eq!((before.agree, before.occluded), (0, 0));
        assert!(before.violation > 40, "{before:?}");
        // From the source's side the roles change, and the reference moves by the inverse.
        let other = counts(Frame::Source, &along_z(0.1));
        assert_eq!((other.agree, other.occluded, other.seen), (0, 0, 60));
        assert!(other.violation > 40, "{other:?}");
    }

    #[test]
    fn the_counts_of_all_cameras_add_up() {
        let (reference, source) = (plane(2.0, 8), plane(2.0, 5));
        let both = [viewpoint(Frame::Reference), viewpoint(Frame::Source)];
        let consistency = |views: &[Viewpoint]| {
            Verifier::new(&reference, &source, views, 0.05).consistency(&along_z(0.01))
        };
        let (first, second) = (consistency(&both[..1]), consistency(&both[1..]));
        let sum = consistency(&both);
        assert_eq!(sum.agree, first.agree + second.agree);
        assert_eq!(sum.seen, 96 + 60);
        assert_eq!(consistency(&[]), DepthConsistency::default());
    }

    #[test]
    fn shares_and_score_follow_the_counts() {
        let counts = DepthConsistency { agree: 30, occluded: 7, violation: 10, seen: 60 };
        assert_eq!((counts.score(), counts.agreement(), counts.coverage()), (10.0, 0.75, 0.5));
        let nothing = DepthConsistency::default();
        assert_eq!((nothing.score(), nothing.agreement(), nothing.coverage()), (0.0, 0.0, 0.0));
    }

    #[test]
    fn overlap_is_the_share_of_source_points_near_the_reference() {
        let reference = KdTree::new(&[Point3::new(1.0, 0.0, 0.0), Point3::new(5.0, 0.0, 0.0)]);
        let source = [0.0, 0.09, 0.11, 4.0, 9.0].map(|x| Point3::new(x, 0.0, 0.0));
        let found =
            overlap(&reference, &source, &RigidTransform::from_translation(Vector3::x()), 0.1, 1.0);
        assert_eq!(found.share, 0.6);
        assert_eq!(found.information[(0, 0)], 3.0);
        let nothing = overlap(&reference, &[], &RigidTransform::identity(), 0.1, 1.0);
        assert_eq!((nothing.share, nothing.information), (0.0, Matrix6::zeros()));
    }

    /// `G = [I | -[p]x]` written out for the moved point, as 3DMatch's evaluation has it.
    #[test]
    fn the_information_of_a_point_is_that_of_3dmatch() {
        let pose = RigidTransform::new(Rotation3::new(Vector3::new(0.3, -0.2, 0.9)), Vector3::x());
        let source = Point3::new(0.2, 1.4, -0.7);
        let (moved, unit) = (pose.apply(&source), 0.5);
        let (x, y, z) = (moved.x * unit, moved.y * unit, moved.z * unit);
        #[rustfmt::skip]
        let g = Matrix3x6::new(
            1.0, 0.0, 0.0, 0.0, z, -y,
            0.0, 1.0, 0.0, -z, 0.0, x,
            0.0, 0.0, 1.0, y, -x, 0.0,
        );
        let found = overlap(&KdTree::new(&[moved]), &[source], &pose, 0.1, unit).information;
        assert!((found - g.transpose() * g).abs().max() < 1e-12, "{found}");
        assert_eq!(found, found.transpose());
        // A small twist moves the point by G times it: the rows and columns are translation first.
        let turned = Rotation3::new(Vector3::new(1e-6, 2e-6, -1e-6)) * Point3::new(x, y, z);
        let step = g * nalgebra::Vector6::new(0.0, 0.0, 0.0, 1e-6, 2e-6, -1e-6);
        assert!((turned - Point3::new(x, y, z) - step).norm() < 1e-11);
    }

    #[test]
    fn the_verdict_follows_the_confidence_first() {
        assert_eq!(Verdict::of(REJECT_BELOW - 1e-9, false), Verdict::Rejected);
        assert_eq!(Verdict::of(REJECT_BELOW - 1e-9, true), Verdict::Rejected);
        assert_eq!(Verdict::of(REJECT_BELOW, true), Verdict::KeptInitial);
        assert_eq!(Verdict::of(REJECT_BELOW, false), Verdict::Refined);
    }

    #[test]
    fn every_kind_of_evidence_adds_confidence() {
        let steps = || (0..=4).map(|step| f64::from(step) / 4.0);
        for (a, b) in steps().flat_map(|a| steps().map(move |b| (a, b))) {
            for less in steps().take(4) {
                let more = less + 0.25;
                assert!(confidence(more, a, b) > confidence(less, a, b));
                assert!(confidence(a, more, b) > confidence(a, less, b));
                assert!(confidence(a, b, more) > confidence(a, b, less));
            }
        }
        assert!(confidence(0.0, 0.0, 0.0) < 0.01 && confidence(1.0, 1.0, 1.0) > 0.99);
    }
}
