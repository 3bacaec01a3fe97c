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
/// A given voxel size may divide the extent of a cloud into this many.
const FINEST: f64 = 1e6;
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
        if let Some(voxel) = voxel {
            check_fineness(voxel, source, target)?;
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

/// A voxel that is lost in the extent of the clouds is a slip of the keyboard.
fn check_fineness(voxel: f64, source: &PointCloud, target: &PointCloud) -> Result<()> {
    for cloud in [source, target] {
        let (low, high) = cloud.bounds();
        let extent = (high - low).amax();
        if extent > FINEST * voxel {
            return Err(Error::invalid(format!(
                "the voxel size of {voxel} m is too small for a cloud of {extent} m: give at least {:.1e} m",
                extent / FINEST
            )));
        }
    }
    Ok(())
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

#[cfg(test)]
mod tests {
    use std::f64::consts::TAU;

    use nalgebra::Vector3;

    use super::*;
    use crate::random::Random;

    fn cloud(mut point: impl FnMut(&mut Random) -> Point3<f64>) -> PointCloud {
        let mut random = Random::new(1, 0);
        PointCloud::new((0..4000).map(|_| point(&mut random)).collect()).unwrap()
    }

    /// A wall and a floor before a depth camera.
    fn seen_by_a_camera() -> PointCloud {
        cloud(|random| {
            let z = 1.0 + 2.0 * random.uniform();
            Point3::new((random.uniform() - 0.5) * z, (random.uniform() - 0.5) * 0.8 * z, z)
        })
    }

    /// Walls all around a scanner, 5 to 25 m away.
    fn around_a_scanner() -> PointCloud {
        cloud(|random| {
            let (angle, range) = (TAU * random.uniform(), 5.0 + 20.0 * random.uniform());
            Point3::new(range * angle.cos(), range * angle.sin(), 3.0 * random.uniform() - 1.5)
        })
    }

    /// A ball of 10 cm beside the origin.
    fn object() -> PointCloud {
        cloud(|random| {
            let direction = Vector3::from_fn(|_, _| random.normal()).normalize();
            Point3::new(0.5, 0.4, 0.1) + direction * 0.1
        })
    }

    fn moved(cloud: &PointCloud, by: Vector3<f64>) -> PointCloud {
        PointCloud::new(cloud.points().iter().map(|point| point + by).collect()).unwrap()
    }

    #[test]
    fn the_kind_shows_in_where_the_points_lie() {
        assert_eq!(SceneKind::detect(&seen_by_a_camera()), SceneKind::Indoor);
        assert_eq!(SceneKind::detect(&around_a_scanner()), SceneKind::Lidar);
        assert_eq!(SceneKind::detect(&object()), SceneKind::Object);
        // Behind the camera there is no frustum, and a recentred cloud has no sensor at its origin.
        let behind = moved(&seen_by_a_camera(), Vector3::new(3.0, 0.0, -6.0));
        assert_eq!(SceneKind::detect(&behind), SceneKind::Object);
        for cloud in [seen_by_a_camera(), around_a_scanner()] {
            let far = moved(&cloud, Vector3::new(5e5, 5e6, 0.0));
            assert_eq!(SceneKind::detect(&far), SceneKind::Object);
        }
    }

    #[test]
    fn clouds_of_different_kinds_are_objects() {
        let kind = |source: &PointCloud, target: &PointCloud| {
            Scale::new(Profile::Auto, None, source, target).unwrap().kind
        };
        let (camera, scanner) = (seen_by_a_camera(), around_a_scanner());
        assert_eq!(kind(&camera, &camera), SceneKind::Indoor);
        assert_eq!(kind(&camera, &scanner), SceneKind::Object);
    }

    #[test]
    fn all_lengths_are_multiples_of_the_voxel() {
        for (kind, common_point, keypoints) in [
            (SceneKind::Indoor, 1.0, 500),
            (SceneKind::Lidar, 5.0 / 3.0, 1000),
            (SceneKind::Object, 1.0, 500),
        ] {
            let scale = Scale::with_voxel(kind, 0.3);
            let in_voxels = |length: f64| length / 0.3;
            assert!((in_voxels(scale.acceptance_radius) - 2.0).abs() < 1e-12);
            assert!((in_voxels(scale.common_point_distance) - common_point).abs() < 1e-12);
            assert!((in_voxels(scale.depth_range.min) - 0.2).abs() < 1e-12);
            assert!((in_voxels(scale.depth_range.max) - 300.0).abs() < 1e-9);
            assert_eq!((scale.kind, scale.keypoints), (kind, keypoints));
            assert_eq!(scale.in_units(6.0), Scale::with_voxel(kind, 0.3 / 6.0));
        }
    }

    #[test]
    fn a_given_voxel_precedes_the_profile_and_the_profile_the_cloud() {
        let cloud = object();
        let scale = |profile, voxel| Scale::new(profile, voxel, &cloud, &cloud).unwrap();
        for (profile, kind, voxel) in [
            (Profile::Indoor, SceneKind::Indoor, 0.05),
            (Profile::Lidar, SceneKind::Lidar, 0.3),
            // 5 % of the ball's radius of 10 cm, until a voxel holds more than a point.
            (Profile::Object, SceneKind::Object, scale(Profile::Auto, None).voxel),
        ] {
            assert_eq!(scale(profile, None), Scale::with_voxel(kind, voxel));
            assert_eq!(scale(profile, Some(0.017)), Scale::with_voxel(kind, 0.017));
        }
    }

    #[test]
    fn a_voxel_without_a_length_is_refused() {
        let cloud = object();
        for voxel in [0.0, -0.05, f64::NAN, f64::INFINITY] {
            let message = Scale::new(Profile::Auto, Some(voxel), &cloud, &cloud).unwrap_err();
            assert!(message.to_string().contains(&format!("{voxel}")), "{message}");
        }
        let one_place = PointCloud::new(vec![Point3::new(1.0, 2.0, 3.0); 10]).unwrap();
        let message = Scale::new(Profile::Auto, None, &cloud, &one_place).unwrap_err();
        assert!(message.to_string().contains("identical"), "{message}");
    }

    #[test]
    fn the_automatic_voxel_follows_the_size_of_the_scene() {
        for cloud in [seen_by_a_camera(), around_a_scanner(), object()] {
            let large = cloud.points().iter().map(|point| point * 1000.0).collect();
            // No recentring: a scanner's cloud stays one in millimetres only while its middle is near the origin.
            let large = PointCloud::new(large).unwrap();
            let small = Scale::new(Profile::Auto, None, &cloud, &cloud).unwrap();
            let large = Scale::new(Profile::Auto, None, &large, &large).unwrap();
            assert_eq!(large.kind, small.kind);
            assert!((large.voxel / small.voxel - 1000.0).abs() < 1e-6, "{small:?} {large:?}");
        }
    }

    #[test]
    fn the_automatic_voxel_is_a_share_of_the_scene() {
        // Dense: every point many times, so that no voxel is too small to average some.
        let dense = |cloud: PointCloud| PointCloud::new(cloud.points().repeat(2)).unwrap();
        let (ball, scanner) = (dense(object()), dense(around_a_scanner()));
        let voxel = |source, target| Scale::new(Profile::Auto, None, source, target).unwrap().voxel;
        assert!((voxel(&ball, &ball) - 0.05 * 0.1).abs() < 1e-9, "{}", voxel(&ball, &ball));
        // Ranges are uniform from 5 m to 25 m.
        assert!((voxel(&scanner, &scanner) - 0.02 * 15.0).abs() < 0.011);
        let half = PointCloud::new(ball.points().iter().map(|p| p * 0.5).collect()).unwrap();
        assert!((voxel(&ball, &half) - 0.0025).abs() < 1e-9);
        assert_eq!(voxel(&ball, &half), voxel(&half, &ball));
    }

    #[test]
    fn voxels_of_a_sparse_cloud_grow_until_they_average_points() {
        let sparse: Vec<_> = object().points().iter().step_by(40).copied().collect();
        let sparse = PointCloud::new(sparse).unwrap();
        let voxel = Scale::new(Profile::Auto, None, &sparse, &object()).unwrap().voxel;
        let kept = |voxel| voxel_downsample(sparse.points(), voxel).unwrap().len();
        assert!(kept(0.05 * 0.1) > 90, "the test needs a sparse cloud");
        assert!(kept(voxel) <= 92 && voxel < 0.05, "{voxel}: {}", kept(voxel));
    }

    #[test]
    fn the_papers_constants_do_not_depend_on_the_clouds() {
        let indoor = Scale::of_paper(SceneKind::Indoor, None);
        assert_eq!((indoor.voxel, indoor.acceptance_radius), (0.05, 0.1));
        assert_eq!(indoor.depth_range, DepthRange { min: 0.01, max: 10.0 });
        let lidar = Scale::of_paper(SceneKind::Lidar, None);
        assert_eq!((lidar.voxel, lidar.acceptance_radius), (0.3, 0.6));
        assert!((lidar.common_point_distance - 0.5).abs() < 1e-12);
        assert_eq!(lidar.depth_range, DepthRange { min: 0.5, max: 80.0 });
        assert_eq!(Scale::of_paper(SceneKind::Lidar, Some(0.2)).acceptance_radius, 0.4);
    }

    #[test]
    fn two_digits_are_kept() {
        for (value, kept) in [(0.0347, 0.035), (1234.0, 1200.0), (0.0996, 0.1), (7.0, 7.0)] {
            assert!((two_digits(value) - kept).abs() < 1e-12 * kept, "{value}");
        }
        for value in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            assert_eq!(two_digits(value), 0.0);
        }
    }

    #[test]
    fn a_voxel_lost_in_the_cloud_is_refused() {
        let cloud = cloud(|random| Point3::new(random.uniform() * 30.0, random.uniform(), 2.0));
        let scale = |voxel| Scale::new(Profile::Auto, Some(voxel), &cloud, &cloud);
        assert!(scale(1e-6).unwrap_err().to_string().contains("too small"));
        assert_eq!(scale(1e-3).unwrap().voxel, 1e-3);
    }
}
