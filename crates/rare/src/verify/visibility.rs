//! Two-way depth consistency: does what the moved cloud shows agree with what the other one's sensor saw?
//!
//! Each camera's own cloud is rendered once. A point of the other cloud, moved into the camera, then *agrees* with the
//! surface seen there, or lies behind it (*occluded*), or stands before it, in space that the sensor looked through: a
//! free-space *violation*. Points are compared, not pixels: they are evenly spaced on the surfaces, whatever their
//! depth. Around a pixel the nearest and the farthest surface of its neighbours count, so that depth edges and slanted
//! surfaces, which change within a pixel, accuse nobody.

use nalgebra::Point3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::data::{DepthMap, Intrinsics, RigidTransform};
use crate::project::{pixel, project_moved};
use crate::viewpoints::{Frame, Viewpoint};

/// A quarter of the resolution, so that clouds of some ten thousand points cover their pixels.
const SHRINK: usize = 4;
/// Noise that is allowed at any depth, voxels.
const TOLERANCE: f64 = 0.6;
/// Noise that grows with the depth, as that of every range sensor does.
const TOLERANCE_BY_DEPTH: f64 = 0.01;
/// A violation by more than so many tolerances is no noise.
const GROSS: f64 = 3.0;

/// What became of the moved points, over all cameras; both clouds have been the moved one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct DepthConsistency {
    /// On a surface that the camera's own cloud shows.
    pub agree: usize,
    /// Behind it.
    pub occluded: usize,
    /// Before it: in space that was seen to be empty.
    pub violation: usize,
    /// Those of them that stand there by far more than noise.
    pub gross_violation: usize,
}

impl DepthConsistency {
    /// Share of the comparable points (agreeing or violating) that agree; 0 where there is none.
    #[must_use]
    pub fn agreement(&self) -> f64 {
        share(self.agree, self.agree + self.violation)
    }

    /// Share of the points before a camera that lie behind what it shows; 0 where there is none.
    #[must_use]
    pub fn occlusion(&self) -> f64 {
        share(self.occluded, self.agree + self.violation + self.occluded)
    }

    /// Share of the comparable points (agreeing or violating) that violate grossly; 0 where there is none.
    #[must_use]
    pub fn gross_share(&self) -> f64 {
        share(self.gross_violation, self.agree + self.violation)
    }

    fn add(self, other: DepthConsistency) -> DepthConsistency {
        DepthConsistency {
            agree: self.agree + other.agree,
            occluded: self.occluded + other.occluded,
            violation: self.violation + other.violation,
            gross_violation: self.gross_violation + other.gross_violation,
        }
    }
}

fn share(part: usize, whole: usize) -> f64 {
    if whole == 0 { 0.0 } else { part as f64 / whole as f64 }
}

/// A camera with what its own cloud shows in it.
#[derive(Debug)]
pub(super) struct OwnView {
    viewpoint: Viewpoint,
    /// Depth of the nearest and of the farthest surface in and around every pixel; 0 where there is none.
    surfaces: Vec<[f32; 2]>,
}

impl OwnView {
    /// Renders a camera's own cloud.
    pub(super) fn new(viewpoint: &Viewpoint, cloud: &[Point3<f64>]) -> OwnView {
        let viewpoint = shrunk(viewpoint);
        let camera = &viewpoint.camera;
        let seen = project_moved(cloud, &camera.camera_from_world, &camera.intrinsics).depth_map;
        OwnView { viewpoint, surfaces: surfaces(&seen) }
    }

    /// The cloud that stands still in this camera.
    pub(super) fn frame(&self) -> Frame {
        self.viewpoint.frame
    }

    /// Compares the other cloud's points with the view.
    pub(super) fn compare(
        &self,
        moved: &[Point3<f64>],
        reference_from_source: &RigidTransform,
        voxel: f64,
    ) -> DepthConsistency {
        let camera_from_moved = match self.viewpoint.frame {
            Frame::Reference => self.viewpoint.camera_from_source(reference_from_source),
            Frame::Source => self.viewpoint.camera_from_reference(reference_from_source),
        };
        let mut counts = DepthConsistency::default();
        for point in moved {
            self.count(&camera_from_moved.apply(point), voxel, &mut counts);
        }
        counts
    }

    fn count(&self, point: &Point3<f64>, voxel: f64, counts: &mut DepthConsistency) {
        let intrinsics = &self.viewpoint.camera.intrinsics;
        let Some((u, v)) = pixel(point, intrinsics) else { return };
        let Some(&[nearest, farthest]) = self.surfaces.get(v * intrinsics.width + u) else {
            return;
        };
        if farthest <= 0.0 {
            return;
        }
        let tolerance = TOLERANCE * voxel + TOLERANCE_BY_DEPTH * point.z;
        let before = f64::from(nearest) - point.z;
        if before > tolerance {
            counts.violation += 1;
            counts.gross_violation += usize::from(before > (1.0 + GROSS) * tolerance);
        } else if point.z > f64::from(farthest) + tolerance {
            counts.occluded += 1;
        } else {
            counts.agree += 1;
        }
    }
}

/// The counts of all views; `reference` and `source` are the points that are moved into the other's cameras.
pub(super) fn consistency(
    views: &[OwnView],
    reference: &[Point3<f64>],
    source: &[Point3<f64>],
    reference_from_source: &RigidTransform,
    voxel: f64,
) -> DepthConsistency {
    let compare = |view: &OwnView| {
        let moved = if view.frame() == Frame::Reference { source } else { reference };
        view.compare(moved, reference_from_source, voxel)
    };
    views.par_iter().map(compare).reduce(DepthConsistency::default, DepthConsistency::add)
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

/// The least and the largest depth of the 3 x 3 pixels around each one.
fn surfaces(map: &DepthMap) -> Vec<[f32; 2]> {
    let (width, height) = (map.width(), map.height());
    let mut surfaces = Vec::with_capacity(width * height);
    for v in 0..height {
        let rows = v.saturating_sub(1)..(v + 2).min(height);
        for u in 0..width {
            let columns = u.saturating_sub(1)..(u + 2).min(width);
            let around = rows.clone().flat_map(|y| columns.clone().map(move |x| map.at(x, y)));
            let seen = around.filter(|&depth| depth > 0.0);
            let [nearest, farthest] = seen
                .fold([f32::INFINITY, 0.0], |[near, far], depth| [near.min(depth), far.max(depth)]);
            surfaces.push(if farthest > 0.0 { [nearest, farthest] } else { [0.0, 0.0] });
        }
    }
    surfaces
}
