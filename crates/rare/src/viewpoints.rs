//! From where the clouds are looked at: virtual cameras for any pair of clouds (before step 1).
//!
//! The paper puts one pinhole camera at each cloud's origin, which is where a depth sensor stood. A rotating scanner
//! needs a ring of cameras around the origin, and a cloud without a sensor (an object, a fused model) is looked at
//! from outside, from six sides of the overlap. Every camera belongs to the frame of one of the two clouds; both
//! clouds are rendered into it under the current pose, so the parallax between the two maps is small (section 3.1).

use nalgebra::{Point3, Rotation3, Vector3};
use serde::{Deserialize, Serialize};

use crate::data::{Camera, Intrinsics, RigidTransform};
use crate::scale::{Scale, SceneKind};

/// Which cameras to use.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum CameraChoice {
    /// By the kind of scene: `sensor` for depth cameras, `ring` for rotating scanners, `overlap` otherwise.
    #[default]
    Auto,
    /// One depth camera (640 x 480, focal length 585) at each cloud's origin, z forward, x right, y down.
    Sensor,
    /// One KITTI colour camera (1242 x 225) at each cloud's origin, looking along x of a LiDAR frame (x forward,
    /// y left, z up): about 80 degrees of the ring, as the paper's KITTI experiment sees it.
    Kitti,
    /// Six overlapping cameras around each cloud's origin, z up.
    Ring,
    /// Six cameras around the overlap of the clouds, looking inward.
    Overlap,
}

/// The cloud in whose frame a camera stands still.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Frame {
    /// The target (reference) cloud: the paper's reference view.
    Reference,
    /// The source cloud: the paper's source view.
    Source,
}

/// A virtual camera, fixed in the frame of one of the clouds (the camera's world).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Viewpoint {
    /// Whose frame the camera's world is.
    pub frame: Frame,
    /// The camera.
    pub camera: Camera,
}

/// Number of cameras in a ring: 60 degrees apart, 75 degrees wide.
const RING_CAMERAS: usize = 6;

impl Viewpoint {
    /// Moves reference points into the camera under a pose.
    #[must_use]
    pub fn camera_from_reference(&self, reference_from_source: &RigidTransform) -> RigidTransform {
        match self.frame {
            Frame::Reference => self.camera.camera_from_world,
            Frame::Source => self.camera.camera_from_world * reference_from_source.inverse(),
        }
    }

    /// Moves source points into the camera under a pose.
    #[must_use]
    pub fn camera_from_source(&self, reference_from_source: &RigidTransform) -> RigidTransform {
        match self.frame {
            Frame::Reference => self.camera.camera_from_world * *reference_from_source,
            Frame::Source => self.camera.camera_from_world,
        }
    }
}

/// The cameras of both frames: first those of the reference, then as many of the source.
///
/// `reference` and `source` are (downsampled) points of the clouds, each in its own frame.
#[must_use]
pub fn choose(
    choice: CameraChoice,
    scale: &Scale,
    reference: &[Point3<f64>],
    source: &[Point3<f64>],
    reference_from_source: &RigidTransform,
) -> Vec<Viewpoint> {
    match (choice, scale.kind) {
        (CameraChoice::Sensor, _) | (CameraChoice::Auto, SceneKind::Indoor) => {
            in_both_frames(&[sensor()])
        }
        (CameraChoice::Kitti, _) => in_both_frames(&[kitti()]),
        (CameraChoice::Ring, _) | (CameraChoice::Auto, SceneKind::Lidar) => in_both_frames(&ring()),
        (CameraChoice::Overlap, _) | (CameraChoice::Auto, SceneKind::Object) => {
            around_overlap(scale, reference, source, reference_from_source)
        }
    }
}

fn in_both_frames(cameras: &[Camera]) -> Vec<Viewpoint> {
    let in_frame = |frame| cameras.iter().map(move |&camera| Viewpoint { frame, camera });
    in_frame(Frame::Reference).chain(in_frame(Frame::Source)).collect()
}

fn sensor() -> Camera {
    Camera { intrinsics: Intrinsics::indoor(), camera_from_world: RigidTransform::identity() }
}

fn kitti() -> Camera {
    Camera {
        intrinsics: Intrinsics::kitti(),
        camera_from_world: looking_along(&Vector3::x(), &Vector3::z(), &Point3::origin()),
    }
}

/// Horizontal cameras around the origin of a z-up frame; +-25 degrees of elevation hold the customary scanners.
fn ring() -> Vec<Camera> {
    let intrinsics =
        Intrinsics { width: 320, height: 200, fx: 208.5, fy: 208.5, cx: 160.0, cy: 100.0 };
    let heading = |index: usize| {
        let angle = std::f64::consts::TAU * index as f64 / RING_CAMERAS as f64;
        Vector3::new(angle.cos(), angle.sin(), 0.0)
    };
    (0..RING_CAMERAS)
        .map(|index| Camera {
            intrinsics,
            camera_from_world: looking_along(&heading(index), &Vector3::z(), &Point3::origin()),
        })
        .collect()
}

/// Six cameras on the axes of each frame, far enough away that the overlap's bounding sphere fills the image.
fn around_overlap(
    scale: &Scale,
    reference: &[Point3<f64>],
    source: &[Point3<f64>],
    reference_from_source: &RigidTransform,
) -> Vec<Viewpoint> {
    let moved = reference_from_source.apply_all(source);
    let (centre, radius) = overlap_sphere(scale, reference, &moved);
    let source_from_reference = reference_from_source.inverse();
    let mut viewpoints = Vec::with_capacity(12);
    for (frame, centre) in
        [(Frame::Reference, centre), (Frame::Source, source_from_reference.apply(&centre))]
    {
        viewpoints.extend(six_sides(&centre, radius).map(|camera| Viewpoint { frame, camera }));
    }
    viewpoints
}

/// 240 x 240 pixels, 53 degrees wide, at 2.24 radii (the distance at which a sphere touches the frustum's sides).
fn six_sides(centre: &Point3<f64>, radius: f64) -> impl Iterator<Item = Camera> {
    let intrinsics =
        Intrinsics { width: 240, height: 240, fx: 240.0, fy: 240.0, cx: 120.0, cy: 120.0 };
    let (x, y, z) = (Vector3::x(), Vector3::y(), Vector3::z());
    let centre = *centre;
    [(x, z), (-x, z), (y, z), (-y, z), (z, x), (-z, x)].into_iter().map(move |(forward, up)| {
        let position = centre - forward * (radius * 2.24);
        Camera { intrinsics, camera_from_world: looking_along(&forward, &up, &position) }
    })
}

/// Centre and radius of the part of the bounding boxes that the clouds share, widened by a voxel; of both clouds
/// together where they share nothing.
fn overlap_sphere(
    scale: &Scale,
    reference: &[Point3<f64>],
    moved_source: &[Point3<f64>],
) -> (Point3<f64>, f64) {
    let (reference_low, reference_high) = crate::data::bounds(reference);
    let (source_low, source_high) = crate::data::bounds(moved_source);
    let (mut low, mut high) = (reference_low.sup(&source_low), reference_high.inf(&source_high));
    if (high - low).min() < 0.0 {
        (low, high) = (reference_low.inf(&source_low), reference_high.sup(&source_high));
    }
    (nalgebra::center(&low, &high), (high - low).norm() / 2.0 + scale.voxel)
}

/// The pose of a camera at `position` that looks along `forward` with `up` upward in its image.
fn looking_along(
    forward: &Vector3<f64>,
    up: &Vector3<f64>,
    position: &Point3<f64>,
) -> RigidTransform {
    // nalgebra's `face_towards` has y up and x left for z forward; half a turn about z makes it x right, y down.
    let world_from_camera = Rotation3::face_towards(forward, up)
        * Rotation3::from_axis_angle(&Vector3::z_axis(), std::f64::consts::PI);
    RigidTransform::new(world_from_camera, position.coords).inverse()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_camera_looks_forward_with_x_right_and_y_down() {
        let camera_from_world =
            looking_along(&Vector3::x(), &Vector3::z(), &Point3::new(1.0, 0.0, 0.0));
        // LiDAR axes: x forward, y left, z up.
        let seen = camera_from_world.apply(&Point3::new(6.0, 2.0, 0.5));
        assert!((seen - Point3::new(-2.0, -0.5, 5.0)).norm() < 1e-12, "{seen}");
    }

    #[test]
    fn both_clouds_meet_in_the_camera_under_the_true_pose() {
        let reference_from_source = RigidTransform::new(
            Rotation3::new(Vector3::new(0.1, 0.2, 0.3)),
            Vector3::new(1.0, 0.0, 2.0),
        );
        let source = Point3::new(0.3, 0.4, 5.0);
        let reference = reference_from_source.apply(&source);
        for viewpoint in in_both_frames(&ring()) {
            let a = viewpoint.camera_from_reference(&reference_from_source).apply(&reference);
            let b = viewpoint.camera_from_source(&reference_from_source).apply(&source);
            assert!((a - b).norm() < 1e-12);
        }
    }

    #[test]
    fn a_ring_sees_all_around_and_six_sides_see_the_whole_sphere() {
        let sees = |camera: &Camera, point: &Point3<f64>| {
            let p = camera.camera_from_world.apply(point);
            let k = &camera.intrinsics;
            let (u, v) = (k.fx * p.x / p.z + k.cx, k.fy * p.y / p.z + k.cy);
            p.z > 0.0 && u >= 0.0 && u < k.width as f64 && v >= 0.0 && v < k.height as f64
        };
        for degrees in 0..360 {
            let angle = f64::from(degrees).to_radians();
            let point = Point3::new(20.0 * angle.cos(), 20.0 * angle.sin(), -1.0);
            assert!(ring().iter().any(|camera| sees(camera, &point)), "{degrees}");
        }
        let centre = Point3::new(3.0, -1.0, 2.0);
        for camera in six_sides(&centre, 1.5) {
            for direction in [
                Vector3::x(),
                Vector3::y(),
                Vector3::z(),
                -Vector3::x(),
                -Vector3::y(),
                -Vector3::z(),
            ] {
                assert!(sees(&camera, &(centre + direction * 1.49)), "{camera:?} {direction}");
            }
        }
    }
}
