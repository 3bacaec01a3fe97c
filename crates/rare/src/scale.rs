//! What kind of scan the clouds are, and every length that follows from it.
//!
//! All thresholds are multiples of one voxel size. The profiles `indoor` and `lidar` fix it to the field's customary
//! 5 cm and 30 cm; `auto` takes it from the clouds' own extent and spacing, so that a scan in millimetres, a figurine
//! or a city block needs no tuning.

use nalgebra::Point3;
use serde::{Deserialize, Serialize};

use crate::data::{DepthRange, PointCloud, voxel_downsample};
use crate::error::{Error, Result};

/// Which fixed constants to use, or that they are to be found.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Profile {
    /// Kind and voxel size from the clouds themselves.
    #[default]
    Auto,
    /// Depth-camera scans and fragments of rooms: 5 cm voxels, camera frame (z forward) at the sensor.
    Indoor,
    /// Rotating laser scanners: 30 cm voxels, sensor at the origin, z up.
    Lidar,
    /// Scans without a meaningful origin (objects, fused models): voxel size from the extent.
    Object,
}

/// How a cloud came about, as far as the choice of cameras is concerned.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SceneKind {
    /// Most points lie in front of a pinhole camera at the origin, z forward.
    Indoor,
    /// The points surround the origin.
    Lidar,
    /// Neither.
    Object,
}

/// Every length and count that depends on the scale of the scene, in metres.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Scale {
    /// What the clouds look like.
    pub kind: SceneKind,
    /// Voxel size of the working clouds; all other lengths are multiples of it.
    pub voxel: f64,
    /// `tau_a`, section 3.3 of the paper: a correspondence this near under a pose is an inlier. 2 voxels.
    pub acceptance_radius: f64,
    /// `tau_c`, section 3.3: a 3D keypoint and a pixel this near are one common point. 1 voxel (LiDAR: 5/3).
    pub common_point_distance: f64,
    /// Depths that are believed, along the camera's axis.
    pub depth_range: DepthRange,
    /// Number of 3D keypoints per cloud where the caller brings no features: 500, LiDAR 1000.
    pub keypoints: usize,
}

/// A cloud counts as seen by a pinhole camera at the origin if this share of it lies in the frustum.
const FRUSTUM_SHARE: f64 = 0.5;
/// A cloud surrounds its origin if this share of 36 azimuth bins is occupied.
const AZIMUTH_SHARE: f64 = 0.6;
/// Voxel size by the median distance to the centroid; 5 cm for a fragment of 1 m, as in 3DMatch.
const VOXEL_BY_RADIUS: f64 = 0.05;
/// Voxel size by the median range of a surround scan; 30 cm at 15 m, as in KITTI.
const VOXEL_BY_RANGE: f64 = 0.02;
/// Voxels grow while they are more than this share of the points, so that they average some.
const SPARSE: f64 = 0.9;
/// The depth that 3DMatch uses, in voxels: 15 m of 5 cm, minus the sentinel that the densifier needs.
const DEPTH_IN_VOXELS: f64 = 300.0;

impl Scale {
    /// Fixes all lengths for a pair of clouds. `voxel`, metres, overrides the profile's voxel size.
    ///
    /// # Errors
    /// `InvalidInput` if a given voxel size is not positive, or a cloud has no extent (all points identical).
    pub fn new(
        profile: Profile,
        voxel: Option<f64>,
        source: &PointCloud,
        target: &PointCloud,
    ) -> Result<Scale> {
        if let Some(voxel) = voxel.filter(|voxel| !(voxel.is_finite() && *voxel > 0.0)) {
            return Err(Error::invalid(format!(
                "the voxel size is {voxel}, it must be a positive length in metres"
            )));
        }
        let kind = match profile {
            Profile::Indoor => SceneKind::Indoor,
            Profile::Lidar => SceneKind::Lidar,
            Profile::Object => SceneKind::Object,
            Profile::Auto => SceneKind::detect(source).common(SceneKind::detect(target)),
        };
        let voxel = match (voxel, profile) {
            (Some(voxel), _) => voxel,
            (None, Profile::Indoor) => 0.05,
            (None, Profile::Lidar) => 0.3,
            (None, Profile::Auto | Profile::Object) => automatic_voxel(kind, source, target)?,
        };
        Ok(Scale::with_voxel(kind, voxel))
    }

    /// The same lengths in units of `unit` metres.
    #[must_use]
    pub fn in_units(&self, unit: f64) -> Scale {
        Scale::with_voxel(self.kind, self.voxel / unit)
    }

    /// The paper's constants: 5 cm indoors and 30 cm for LiDAR (unless `voxel` is given), depths as FreeReg has them.
    #[must_use]
    pub fn of_paper(kind: SceneKind, voxel: Option<f64>) -> Scale {
        let (customary, depth_range) = match kind {
            SceneKind::Lidar => (0.3, DepthRange::kitti()),
            SceneKind::Indoor | SceneKind::Object => (0.05, DepthRange::indoor()),
        };
        Scale { depth_range, ..Scale::with_voxel(kind, voxel.unwrap_or(customary)) }
    }

    /// All lengths as multiples of a voxel size.
    #[must_use]
    pub fn with_voxel(kind: SceneKind, voxel: f64) -> Scale {
        let lidar = kind == SceneKind::Lidar;
        Scale {
            kind,
            voxel,
            acceptance_radius: 2.0 * voxel,
            common_point_distance: if lidar { voxel * 5.0 / 3.0 } else { voxel },
            depth_range: DepthRange { min: 0.2 * voxel, max: DEPTH_IN_VOXELS * voxel },
            keypoints: if lidar { 1000 } else { 500 },
        }
    }
}

impl SceneKind {
    /// Looks at where the points lie around the origin.
    #[must_use]
    pub fn detect(cloud: &PointCloud) -> SceneKind {
        // A shifted origin is no sensor.
        let shifted = cloud.shift().amax() > 0.0;
        if !shifted && frustum_share(cloud.points()) >= FRUSTUM_SHARE {
            SceneKind::Indoor
        } else if !shifted && azimuth_share(cloud.points()) >= AZIMUTH_SHARE {
            SceneKind::Lidar
        } else {
            SceneKind::Object
        }
    }

    /// The kind that fits both clouds.
    fn common(self, other: SceneKind) -> SceneKind {
        if self == other { self } else { SceneKind::Object }
    }
}

/// Share of the points inside the frustum of a depth camera at the origin (57 x 45 degrees, z forward).
fn frustum_share(points: &[Point3<f64>]) -> f64 {
    let inside = |point: &&Point3<f64>| {
        point.z > 0.0 && point.x.abs() < 0.547 * point.z && point.y.abs() < 0.41 * point.z
    };
    points.iter().filter(inside).count() as f64 / points.len() as f64
}

/// Share of 36 azimuth bins around the z axis that hold at least 0.1 % of the points.
fn azimuth_share(points: &[Point3<f64>]) -> f64 {
    let mut bins = [0_usize; 36];
    for point in points {
        let turn = point.y.atan2(point.x) / std::f64::consts::TAU + 0.5;
        bins[((turn * 36.0) as usize).min(35)] += 1;
    }
    let enough = points.len().div_ceil(1000);
    bins.iter().filter(|&&count| count >= enough).count() as f64 / 36.0
}

/// The smaller cloud decides, the sparser one bounds; two significant digits, so that it can be quoted.
fn automatic_voxel(kind: SceneKind, source: &PointCloud, target: &PointCloud) -> Result<f64> {
    let by_extent = |cloud: &PointCloud| match kind {
        SceneKind::Lidar => VOXEL_BY_RANGE * median_distance(cloud.points(), &Point3::origin()),
        SceneKind::Indoor | SceneKind::Object => {
            VOXEL_BY_RADIUS * median_distance(cloud.points(), &centroid(cloud.points()))
        }
    };
    let mut voxel = by_extent(source).min(by_extent(target));
    if voxel <= 0.0 {
        return Err(Error::invalid("most points of a cloud are identical: give a voxel size"));
    }
    for cloud in [source, target] {
        while voxel_downsample(cloud.points(), voxel)?.len() as f64 > SPARSE * cloud.len() as f64 {
            voxel *= 1.25;
        }
    }
    Ok(two_digits(voxel))
}

fn centroid(points: &[Point3<f64>]) -> Point3<f64> {
    let sum = points.iter().fold(nalgebra::Vector3::zeros(), |sum, point| sum + point.coords);
    Point3::from(sum / points.len() as f64)
}

fn median_distance(points: &[Point3<f64>], from: &Point3<f64>) -> f64 {
    let mut distances: Vec<f64> = points.iter().map(|point| (point - from).norm()).collect();
    let middle = distances.len() / 2;
    *distances.select_nth_unstable_by(middle, f64::total_cmp).1
}

fn two_digits(value: f64) -> f64 {
    if value <= 0.0 || !value.is_finite() {
        return 0.0;
    }
    let unit = 10_f64.powf(value.log10().floor() - 1.0);
    (value / unit).round() * unit
}
