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
