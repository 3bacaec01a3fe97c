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

/// What a camera says of a point that was moved into it, the gravest last.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Visibility {
    /// Nothing: it is outside the image, or the camera's own cloud shows nothing there.
    #[default]
    Unseen,
    /// It lies behind what the camera's own cloud shows.
    Occluded,
    /// It lies on it.
    Agree,
    /// It stands before it, in space that was seen to be empty ...
    Violation,
    /// ... by far more than noise.
    GrossViolation,
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

    /// Share of the comparable points (agreeing or violating) that violate grossly; 1 where there is none: a pose under
    /// which the sensors see nothing in common has nothing to say for itself.
    #[must_use]
    pub fn gross_share(&self) -> f64 {
        let comparable = self.agree + self.violation;
        if comparable == 0 { 1.0 } else { share(self.gross_violation, comparable) }
    }

    fn count(&mut self, visibility: Visibility) {
        match visibility {
            Visibility::Unseen => {}
            Visibility::Occluded => self.occluded += 1,
            Visibility::Agree => self.agree += 1,
            Visibility::Violation => self.violation += 1,
            Visibility::GrossViolation => {
                self.violation += 1;
                self.gross_violation += 1;
            }
        }
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

/// What a camera says of what the other cloud shows in each of its pixels: a quarter of its resolution.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct VisibilityMask {
    /// The frame of the camera; the other cloud's points were moved into it.
    pub frame: Frame,
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Row-major, `height x width`; unseen also where the other cloud has no point.
    pub pixels: Vec<Visibility>,
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
        let camera_from_moved = self.camera_from_moved(reference_from_source);
        let mut counts = DepthConsistency::default();
        for point in moved {
            counts.count(self.visibility(&camera_from_moved.apply(point), voxel));
        }
        counts
    }

    /// What the camera says of each of the other cloud's points.
    pub(super) fn see(
        &self,
        moved: &[Point3<f64>],
        reference_from_source: &RigidTransform,
        voxel: f64,
    ) -> Vec<Visibility> {
        let camera_from_moved = self.camera_from_moved(reference_from_source);
        let see = |point| self.visibility(&camera_from_moved.apply(point), voxel);
        moved.par_iter().map(see).collect()
    }

    /// What the camera says of the nearest of the other cloud's points in each of its pixels.
    pub(super) fn mask(
        &self,
        moved: &[Point3<f64>],
        reference_from_source: &RigidTransform,
        voxel: f64,
    ) -> VisibilityMask {
        let camera_from_moved = self.camera_from_moved(reference_from_source);
        let intrinsics = &self.viewpoint.camera.intrinsics;
        let (width, height) = (intrinsics.width, intrinsics.height);
        let mut nearest = vec![(f64::INFINITY, Visibility::Unseen); width * height];
        for point in moved {
            let point = camera_from_moved.apply(point);
            let Some((u, v)) = pixel(&point, intrinsics) else { continue };
            if let Some(seen) = nearest.get_mut(v * width + u).filter(|seen| point.z < seen.0) {
                *seen = (point.z, self.visibility(&point, voxel));
            }
        }
        let pixels = nearest.into_iter().map(|(_, visibility)| visibility).collect();
        VisibilityMask { frame: self.viewpoint.frame, width, height, pixels }
    }

    fn camera_from_moved(&self, reference_from_source: &RigidTransform) -> RigidTransform {
        match self.viewpoint.frame {
            Frame::Reference => self.viewpoint.camera_from_source(reference_from_source),
            Frame::Source => self.viewpoint.camera_from_reference(reference_from_source),
        }
    }

    /// What the camera says of a point in its frame.
    fn visibility(&self, point: &Point3<f64>, voxel: f64) -> Visibility {
        let intrinsics = &self.viewpoint.camera.intrinsics;
        let surface =
            pixel(point, intrinsics).and_then(|(u, v)| self.surfaces.get(v * intrinsics.width + u));
        let Some(&[nearest, farthest]) = surface.filter(|surface| surface[1] > 0.0) else {
            return Visibility::Unseen;
        };
        let tolerance = TOLERANCE * voxel + TOLERANCE_BY_DEPTH * point.z;
        let before = f64::from(nearest) - point.z;
        if before > (1.0 + GROSS) * tolerance {
            Visibility::GrossViolation
        } else if before > tolerance {
            Visibility::Violation
        } else if point.z > f64::from(farthest) + tolerance {
            Visibility::Occluded
        } else {
            Visibility::Agree
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

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;
    use crate::data::Camera;

    /// At a depth of 2 m the tolerance is 3 cm + 2 cm.
    const VOXEL: f64 = 0.05;

    /// A camera at the origin, 64 x 48 pixels: 16 x 12 of the pixels that are compared.
    fn viewpoint(frame: Frame) -> Viewpoint {
        let intrinsics =
            Intrinsics { width: 64, height: 48, fx: 64.0, fy: 64.0, cx: 32.0, cy: 24.0 };
        let camera = Camera { intrinsics, camera_from_world: RigidTransform::identity() };
        Viewpoint { frame, camera }
    }

    /// A point in a shrunk pixel.
    fn at(u: usize, v: usize, z: f64) -> Point3<f64> {
        let camera = shrunk(&viewpoint(Frame::Reference)).camera.intrinsics;
        camera.back_project(u as f64 + 0.25, v as f64 + 0.25, z)
    }

    /// One point per pixel of some columns.
    fn plane(z: f64, columns: std::ops::Range<usize>) -> Vec<Point3<f64>> {
        (0..12).flat_map(|v| columns.clone().map(move |u| at(u, v, z))).collect()
    }

    fn along_z(by: f64) -> RigidTransform {
        RigidTransform::from_translation(Vector3::new(0.0, 0.0, by))
    }

    /// What a camera that sees `own` says of `moved`, which stands where it is.
    fn counts(own: &[Point3<f64>], moved: &[Point3<f64>]) -> DepthConsistency {
        let view = OwnView::new(&viewpoint(Frame::Reference), own);
        view.compare(moved, &RigidTransform::identity(), VOXEL)
    }

    #[test]
    fn points_are_counted_by_who_stands_in_front() {
        let own = plane(2.0, 0..16);
        let agree = DepthConsistency { agree: 1, ..DepthConsistency::default() };
        let occluded = DepthConsistency { occluded: 1, ..DepthConsistency::default() };
        let violation = DepthConsistency { violation: 1, ..DepthConsistency::default() };
        let gross = DepthConsistency { gross_violation: 1, ..violation };
        // The tolerance is that at the depth of the point: 4.95 cm, 5 cm, 5.05 cm; four of them are gross.
        for (z, expected) in [
            (1.79, gross),
            (1.82, violation),
            (1.948, violation),
            (1.952, agree),
            (2.0, agree),
            (2.048, agree),
            (2.052, occluded),
            (3.0, occluded),
        ] {
            assert_eq!(counts(&own, &[at(5, 5, z)]), expected, "{z}");
        }
    }

    #[test]
    fn a_depth_edge_accuses_nobody() {
        let mut own = plane(2.0, 0..8);
        own.extend(plane(3.0, 8..16));
        // Between the surfaces, in the columns of the edge: either may be seen there.
        for u in [7, 8] {
            for z in [2.0, 2.5, 3.0] {
                let found = counts(&own, &[at(u, 5, z)]);
                assert_eq!((found.agree, found.violation), (1, 0), "{u} {z}: {found:?}");
            }
        }
        assert_eq!(counts(&own, &[at(6, 5, 2.5)]).occluded, 1);
        assert_eq!(counts(&own, &[at(9, 5, 2.5)]).gross_violation, 1);
    }

    #[test]
    fn only_what_the_camera_can_compare_counts() {
        let own = plane(2.0, 0..8);
        let nothing = DepthConsistency::default();
        // The pixels beside the surface belong to its edge, those beyond show nothing.
        assert_eq!(counts(&own, &[at(8, 5, 2.0)]).agree, 1);
        assert_eq!(counts(&own, &[at(9, 5, 2.0)]), nothing);
        // Behind the camera, and beside its image.
        assert_eq!(counts(&own, &[Point3::new(0.0, 0.0, -2.0), at(16, 5, 2.0)]), nothing);
        assert_eq!(counts(&[], &own), nothing);
    }

    #[test]
    fn the_frames_change_their_roles() {
        let (reference, source) = (plane(2.0, 0..8), plane(2.0, 0..5));
        let seen_by = |frame, by| {
            let own = if frame == Frame::Reference { &reference } else { &source };
            let views = [OwnView::new(&viewpoint(frame), own)];
            consistency(&views, &reference, &source, &along_z(by), VOXEL)
        };
        // The reference's camera sees all 5 x 12 points of the source; the source's one sees the edge's neighbours, too.
        let exact = DepthConsistency { agree: 60, ..DepthConsistency::default() };
        assert_eq!(seen_by(Frame::Reference, 0.0), exact);
        assert_eq!(seen_by(Frame::Source, 0.0), DepthConsistency { agree: 72, ..exact });
        // Farther from the one is nearer to the other.
        let (behind, before) = (seen_by(Frame::Reference, 0.1), seen_by(Frame::Source, 0.1));
        assert!(behind.occluded >= 50 && behind.agree + behind.violation == 0, "{behind:?}");
        assert!(before.violation >= 50 && before.agree + before.occluded == 0, "{before:?}");
    }

    #[test]
    fn the_counts_of_all_cameras_add_up() {
        let (reference, source) = (plane(2.0, 0..8), plane(1.9, 0..5));
        let view = |frame, own: &[Point3<f64>]| OwnView::new(&viewpoint(frame), own);
        let found = |views: &[OwnView]| {
            consistency(views, &reference, &source, &RigidTransform::identity(), VOXEL)
        };
        let first = found(&[view(Frame::Reference, &reference)]);
        let second = found(&[view(Frame::Source, &source)]);
        assert!(first.violation == 60 && second.occluded == 72, "{first:?} {second:?}");
        let both = [view(Frame::Reference, &reference), view(Frame::Source, &source)];
        assert_eq!(found(&both), first.add(second));
        assert_eq!(found(&[]), DepthConsistency::default());
    }

    #[test]
    fn shares_follow_the_counts() {
        let counts =
            DepthConsistency { agree: 30, occluded: 60, violation: 10, gross_violation: 4 };
        assert_eq!(
            (counts.agreement(), counts.occlusion(), counts.gross_share()),
            (0.75, 0.6, 0.1)
        );
        let sum = counts.add(DepthConsistency {
            agree: 1,
            occluded: 2,
            violation: 3,
            gross_violation: 4,
        });
        let expected =
            DepthConsistency { agree: 31, occluded: 62, violation: 13, gross_violation: 8 };
        assert_eq!(sum, expected);
        let nothing = DepthConsistency::default();
        let shares = [nothing.agreement(), nothing.occlusion(), nothing.gross_share()];
        assert_eq!(shares, [0.0, 0.0, 1.0]);
    }
}
