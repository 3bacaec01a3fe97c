//! Step 1: a cloud seen by a virtual camera becomes a depth map (paper section "Stable Diffusion and ControlNet",
//! "Depth Diffusion Feature Extraction").
//!
//! The arithmetic is FreeReg's, to the bit: a pixel is the truncated image point, the nearest point wins, nothing is
//! splatted. All of it is `f64`, because a pixel is a discontinuous function of the pose; only the depth that is kept
//! is `f32`. Points are moved into the camera's frame one by one, so that the same cloud is seen under many poses
//! without a copy.

use nalgebra::Point3;

use crate::data::{Camera, DepthMap, Intrinsics, RigidTransform};

/// Added to the depth that image points are divided by (FreeReg). It draws them towards the top left corner by a
/// part in `1e5 * depth`; kept because it decides on which side of a pixel's border a point falls.
const DEPTH_OFFSET: f64 = 1e-5;

/// Points at or before this depth, metres, are behind the camera or too near to be seen.
const NEAREST: f64 = 0.05;

/// Points beyond this depth, metres, are not seen.
const FARTHEST: f64 = 9999.0;

/// What a camera sees of a cloud.
#[derive(Debug, Clone, PartialEq)]
pub struct Projection {
    /// The depth of the nearest point in every pixel, metres, 0 where there is none.
    pub depth_map: DepthMap,
    /// How many points fall into the image, those hidden behind nearer ones included.
    pub points_in_view: usize,
}

/// Projects `points` (metres, world frame) into `camera`.
#[must_use]
pub fn project(points: &[Point3<f64>], camera: &Camera) -> Projection {
    project_moved(points, &camera.camera_from_world, &camera.intrinsics)
}

/// Projects `points` (metres, in any frame) into a camera whose frame `camera_from_points` leads to.
#[must_use]
pub fn project_moved(
    points: &[Point3<f64>],
    camera_from_points: &RigidTransform,
    intrinsics: &Intrinsics,
) -> Projection {
    let mut depth_map = DepthMap::empty(*intrinsics);
    let depth = depth_map.depth_mut();
    let mut points_in_view = 0;
    for point in points {
        let point = camera_from_points.apply(point);
        let Some((u, v)) = pixel(&point, intrinsics) else { continue };
        points_in_view += 1;
        let nearest = &mut depth[v * intrinsics.width + u];
        let seen = point.z as f32;
        if *nearest == 0.0 || seen < *nearest {
            *nearest = seen;
        }
    }
    Projection { depth_map, points_in_view }
}

/// The pixel (column, row) in which a camera sees `point` (metres, camera frame), `None` if it does not.
#[must_use]
pub fn pixel(point: &Point3<f64>, intrinsics: &Intrinsics) -> Option<(usize, usize)> {
    let Intrinsics { width, height, fx, fy, cx, cy } = *intrinsics;
    let depth = point.z + DEPTH_OFFSET;
    let u = (fx * point.x + cx * point.z) / depth;
    let v = (fy * point.y + cy * point.z) / depth;
    let inside = (0.0..width as f64).contains(&u) && (0.0..height as f64).contains(&v);
    (inside && point.z > NEAREST && point.z <= FARTHEST).then_some((u as usize, v as usize))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nearest_point_wins_and_hidden_points_count() {
        let points = [3.0, 2.0, 4.0].map(|z| Point3::new(0.0, 0.0, z));
        let projection = project_moved(&points, &RigidTransform::identity(), &Intrinsics::indoor());
        // The principal point (320, 240) falls into the pixel before it, because image points shrink a little.
        assert_eq!(projection.depth_map.at(319, 239), 2.0);
        assert_eq!(projection.points_in_view, 3);
        assert_eq!(projection.depth_map.depth().iter().filter(|&&depth| depth > 0.0).count(), 1);
    }

    #[test]
    fn numbers_that_are_no_places_are_not_seen() {
        let values = [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, f64::MAX, f64::MIN, 0.0, 1.0];
        let intrinsics = Intrinsics::indoor();
        for x in values {
            for z in values {
                let seen = pixel(&Point3::new(x, 0.0, z), &intrinsics);
                assert_eq!(seen.is_some(), x == 0.0 && z == 1.0, "{x} {z}");
            }
        }
    }
}
