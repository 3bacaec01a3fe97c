//! Pinhole cameras: z forward, x right, y down.

use nalgebra::{Point3, Vector3};
use serde::{Deserialize, Serialize};

use crate::data::RigidTransform;

/// The inner geometry of a pinhole camera, pixels.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Intrinsics {
    /// Image width, pixels.
    pub width: usize,
    /// Image height, pixels.
    pub height: usize,
    /// Focal length along x, pixels.
    pub fx: f64,
    /// Focal length along y, pixels.
    pub fy: f64,
    /// Principal point, column.
    pub cx: f64,
    /// Principal point, row.
    pub cy: f64,
}

impl Intrinsics {
    /// The depth camera of 3DMatch as FreeReg uses it: 640 x 480, focal length 585, centre (320, 240).
    #[must_use]
    pub fn indoor() -> Intrinsics {
        Intrinsics { width: 640, height: 480, fx: 585.0, fy: 585.0, cx: 320.0, cy: 240.0 }
    }

    /// KITTI's left colour camera as FreeReg uses it: 1242 x 225, the top 150 rows removed.
    #[must_use]
    pub fn kitti() -> Intrinsics {
        Intrinsics {
            width: 1242,
            height: 225,
            fx: 721.5377,
            fy: 721.5377,
            cx: 609.5593,
            cy: 22.854,
        }
    }

    /// The point at `depth` (metres along z) behind pixel coordinates (u, v), in the camera's frame.
    #[must_use]
    pub fn back_project(&self, u: f64, v: f64, depth: f64) -> Point3<f64> {
        Point3::from(Vector3::new((u - self.cx) / self.fx, (v - self.cy) / self.fy, 1.0) * depth)
    }
}

/// A pinhole camera somewhere in a world frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    /// Inner geometry.
    pub intrinsics: Intrinsics,
    /// The pose: moves points of the world into the camera's frame.
    pub camera_from_world: RigidTransform,
}

/// The depths, along the camera's z axis, at which a pixel counts as seen; both ends are excluded.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct DepthRange {
    /// Depths up to this are too near.
    pub min: f64,
    /// Depths from this on are too far.
    pub max: f64,
}

impl DepthRange {
    /// Rooms, as FreeReg has it for 3DMatch: 1 cm to 10 m.
    #[must_use]
    pub fn indoor() -> DepthRange {
        DepthRange { min: 0.01, max: 10.0 }
    }

    /// Streets, as FreeReg has it for KITTI: 0.5 m to 80 m.
    #[must_use]
    pub fn kitti() -> DepthRange {
        DepthRange { min: 0.5, max: 80.0 }
    }

    /// Whether `depth` lies inside.
    #[must_use]
    pub fn contains(&self, depth: f64) -> bool {
        self.min < depth && depth < self.max
    }
}
