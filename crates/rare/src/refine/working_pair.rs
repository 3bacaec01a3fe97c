//! Both clouds, made ready once: recentred, in working units, downsampled, with normals and 3D keypoints.
//!
//! Working units make one voxel 5 cm, so that the recipe's constants (nearest depth 5 cm, deepest 15 m, ...) hold for
//! a figurine and for a street alike. Poses are brought into the working frames on entry and out of them on return.

use std::borrow::Cow;

use nalgebra::{Matrix3, Point3, Vector3};

use crate::data::{
    Correspondence, CorrespondenceSet, CorrespondenceSets, KdTree, PointCloud, PointFeatures,
    RigidTransform, Scan, voxel_downsample,
};
use crate::error::{Error, Result};
use crate::features::{Landmarks, estimate_normals, fpfh_at, orient_towards};
use crate::pose::{IcpTarget, RING_REACH};
use crate::random::Random;
use crate::refine::RefinerConfig;
use crate::scale::{Scale, SceneKind};
use crate::verify::{JudgedCloud, Overlap, overlap};

/// The voxel size in working units, for which the recipe's constants are made.
const WORKING_VOXEL: f64 = 0.05;
/// Voxel points that get a descriptor, at most.
const LANDMARKS: usize = 5000;
/// Normals are taken over no less than twice this, voxels: over less they show noise.
const FINEST_NORMALS: f64 = 0.75;

/// Two clouds ready to be registered; lengths in working units.
pub(crate) struct WorkingPair<'a> {
    pub(crate) source: WorkingCloud<'a>,
    pub(crate) target: WorkingCloud<'a>,
    /// All thresholds, working units.
    pub(crate) scale: Scale,
    /// Metres per working unit.
    pub(crate) unit: f64,
    pub(crate) source_cloud: &'a PointCloud,
    pub(crate) target_cloud: &'a PointCloud,
}

/// One cloud; local frame, working units.
pub(crate) struct WorkingCloud<'a> {
    /// All points.
    pub(crate) points: Cow<'a, [Point3<f64>]>,
    /// One point per voxel.
    pub(crate) coarse: Vec<Point3<f64>>,
    /// One point per half voxel, with normals and an index.
    pub(crate) surface: IcpTarget,
    /// Voxel points with descriptors, at most 5000.
    pub(crate) landmarks: Landmarks,
    /// 3D keypoints with features.
    pub(crate) keypoints: PointFeatures,
}

impl<'a> WorkingPair<'a> {
    /// Checks and prepares both clouds.
    ///
    /// # Errors
    /// `InvalidInput` if a cloud has fewer than three points, no extent or a single line of points, if only one side
    /// brings features, or if their dimensions differ.
    pub(crate) fn new(
        source: &'a Scan,
        target: &'a Scan,
        config: &RefinerConfig,
    ) -> Result<WorkingPair<'a>> {
        check_shape("source", &source.cloud)?;
        check_shape("reference", &target.cloud)?;
        check_features(source, target)?;
        let metric = Scale::new(config.profile, config.voxel, &source.cloud, &target.cloud)?;
        let (scale, unit) = if config.recipe.metric {
            (Scale::of_paper(metric.kind, config.voxel), 1.0)
        } else {
            let unit = metric.voxel / WORKING_VOXEL;
            (metric.in_units(unit), unit)
        };
        let prepare = |scan, stream| WorkingCloud::new(scan, &scale, unit, config, stream);
        // The two sides take turns, not threads: each step inside is parallel already.
        let (source_side, target_side) = (prepare(source, 0)?, prepare(target, 1)?);
        Ok(WorkingPair {
            source: source_side,
            target: target_side,
            scale,
            unit,
            source_cloud: &source.cloud,
            target_cloud: &target.cloud,
        })
    }

    /// A pose between the callers' frames as one between the working frames.
    pub(crate) fn to_working(&self, target_from_source: &RigidTransform) -> RigidTransform {
        let local = PointCloud::to_local(self.target_cloud, self.source_cloud, target_from_source);
        RigidTransform::new(*local.rotation(), local.translation() / self.unit)
    }

    /// A pose between the working frames as one between the callers' frames.
    pub(crate) fn to_world(&self, target_from_source: &RigidTransform) -> RigidTransform {
        let local = RigidTransform::new(
            *target_from_source.rotation(),
            target_from_source.translation() * self.unit,
        );
        PointCloud::to_world(self.target_cloud, self.source_cloud, &local)
    }

    /// The caller's correspondences in the working frames.
    pub(crate) fn to_working_pairs(&self, pairs: &[Correspondence]) -> Vec<Correspondence> {
        let to_working = |pair: &Correspondence| Correspondence {
            source: (pair.source - self.source_cloud.shift()) / self.unit,
            target: (pair.target - self.target_cloud.shift()) / self.unit,
            score: pair.score,
        };
        pairs.iter().map(to_working).collect()
    }

    /// Correspondences of the working frames in the callers' frames.
    pub(crate) fn to_world_pairs(&self, pairs: &[Correspondence]) -> Vec<Correspondence> {
        let to_world = |pair: &Correspondence| Correspondence {
            source: pair.source * self.unit + self.source_cloud.shift(),
            target: pair.target * self.unit + self.target_cloud.shift(),
            score: pair.score,
        };
        pairs.iter().map(to_world).collect()
    }

    /// The same for all sets.
    pub(crate) fn to_world_sets(&self, sets: &CorrespondenceSets) -> CorrespondenceSets {
        let set_to_world = |set: &CorrespondenceSet| CorrespondenceSet {
            name: set.name,
            pairs: self.to_world_pairs(&set.pairs),
        };
        CorrespondenceSets { sets: sets.sets.iter().map(set_to_world).collect() }
    }

    /// How much of the source lies on the target under a pose, in metres.
    pub(crate) fn overlap(&self, target_from_source: &RigidTransform) -> Overlap {
        let tree = self.target.surface.tree();
        overlap(tree, &self.source.coarse, target_from_source, self.scale.voxel, self.unit)
    }

    /// What was done to the clouds that the caller may not expect.
    pub(crate) fn warnings(&self) -> Vec<String> {
        let mut warnings = Vec::new();
        for (name, cloud) in [("source", self.source_cloud), ("reference", self.target_cloud)] {
            if cloud.dropped() > 0 {
                warnings.push(format!(
                    "{} points of the {name} cloud are not finite and were dropped",
                    cloud.dropped()
                ));
            }
        }
        warnings
    }
}

impl<'a> WorkingCloud<'a> {
    fn new(
        scan: &'a Scan,
        scale: &Scale,
        unit: f64,
        config: &RefinerConfig,
        stream: u64,
    ) -> Result<WorkingCloud<'a>> {
        let points = in_units(scan.cloud.points(), unit);
        let fine = voxel_downsample(&points, scale.voxel / 2.0)?;
        let coarse = voxel_downsample(&fine, scale.voxel)?;
        let mut random = Random::new(config.seed, stream);
        let landmarks = landmarks(&coarse, scale.voxel, scale.kind, LANDMARKS, &mut random)?;
        let count = config.recipe.keypoints.unwrap_or(scale.keypoints);
        let keypoints = match &scan.features {
            Some(features) => sampled(features, scan.cloud.shift(), unit, count, &mut random),
            None => chosen(landmarks.features(), count, &mut random),
        };
        Ok(WorkingCloud { points, coarse, surface: surface(fine, scale)?, landmarks, keypoints })
    }

    /// What the verification looks at.
    pub(crate) fn judged(&self) -> JudgedCloud<'_> {
        JudgedCloud { points: &self.points, surface: &self.surface, landmarks: &self.landmarks }
    }

    /// Fast point feature histograms of the cloud sampled at `sampling` voxels, over at most `neighbours` points within
    /// `reach` voxels; of no more than 5000 points, evenly chosen.
    ///
    /// # Errors
    /// `InvalidInput` if the cloud cannot be sampled so.
    pub(crate) fn described(
        &self,
        scale: &Scale,
        sampling: f64,
        reach: f64,
        neighbours: usize,
    ) -> Result<PointFeatures> {
        let dense = if sampling < 1.0 { self.surface.points() } else { &self.coarse };
        let points = voxel_downsample(dense, sampling * scale.voxel)?;
        let tree = KdTree::new(&points);
        let radius = 2.0 * sampling.max(FINEST_NORMALS) * scale.voxel;
        let mut normals = estimate_normals(&points, &tree, radius, 30);
        if scale.kind != SceneKind::Object {
            orient_towards(&mut normals, &points, &Point3::origin());
        }
        let step = points.len().div_ceil(LANDMARKS).max(1);
        let chosen: Vec<usize> = (0..points.len()).step_by(step).collect();
        let reach = reach * scale.voxel;
        Ok(fpfh_at(&points, &normals, &tree, reach, neighbours, &chosen)?.normalised())
    }
}

/// Landmarks at no more than `count` random points of a sampled cloud.
fn landmarks(
    points: &[Point3<f64>],
    voxel: f64,
    kind: SceneKind,
    count: usize,
    random: &mut Random,
) -> Result<Landmarks> {
    let mut indices = random.sample(count, points.len());
    indices.sort_unstable();
    let sensor = (kind != SceneKind::Object).then(Point3::origin);
    Landmarks::describe(points, &indices, voxel, sensor.as_ref())
}

fn in_units(points: &[Point3<f64>], unit: f64) -> Cow<'_, [Point3<f64>]> {
    if unit == 1.0 {
        Cow::Borrowed(points)
    } else {
        Cow::Owned(points.iter().map(|point| point / unit).collect())
    }
}

/// Normals from 20 neighbours within two voxels, or, so that they are not all of one ring of a rotating scanner, as far
/// as its rings may lie apart.
fn surface(fine: Vec<Point3<f64>>, scale: &Scale) -> Result<IcpTarget> {
    let reach = match scale.kind {
        SceneKind::Lidar => RING_REACH,
        SceneKind::Indoor | SceneKind::Object => 2.0,
    };
    let normals = estimate_normals(&fine, &KdTree::new(&fine), reach * scale.voxel, 20);
    IcpTarget::new(fine, normals)
}

/// The caller's keypoints in the working frame, at most `count` of them.
fn sampled(
    features: &PointFeatures,
    shift: &Vector3<f64>,
    unit: f64,
    count: usize,
    random: &mut Random,
) -> PointFeatures {
    chosen(features, count, random).normalised().map_points(|point| (point - shift) / unit)
}

/// At most `count` random ones, in their order.
fn chosen(features: &PointFeatures, count: usize, random: &mut Random) -> PointFeatures {
    let mut indices = random.sample(count, features.len());
    indices.sort_unstable();
    features.select(&indices)
}

/// Three points that are not on one line are the least that determine a pose.
fn check_shape(name: &str, cloud: &PointCloud) -> Result<()> {
    let points = cloud.points();
    if points.len() < 3 {
        return Err(Error::invalid(format!(
            "the {name} cloud has {} points, at least 3 are needed",
            points.len()
        )));
    }
    let count = points.len() as f64;
    let centre = points.iter().map(|point| point.coords).sum::<Vector3<f64>>() / count;
    let scatter = points.iter().fold(Matrix3::zeros(), |sum, point| {
        let offset = point.coords - centre;
        sum + offset * offset.transpose()
    });
    let mut spread = scatter.symmetric_eigenvalues();
    spread.as_mut_slice().sort_by(f64::total_cmp);
    if spread[2] <= 0.0 {
        return Err(Error::invalid(format!(
            "all points of the {name} cloud are identical: nothing can be registered"
        )));
    }
    if spread[1] <= 1e-12 * spread[2] {
        return Err(Error::invalid(format!(
            "all points of the {name} cloud lie on one line: the turn about it cannot be determined"
        )));
    }
    Ok(())
}

fn check_features(source: &Scan, target: &Scan) -> Result<()> {
    match (&source.features, &target.features) {
        (Some(_), None) | (None, Some(_)) => Err(Error::invalid(
            "only one of the clouds has features: give them for both, or for neither",
        )),
        (Some(source), Some(target)) if source.dimension() != target.dimension() => {
            Err(Error::invalid(format!(
                "the source features have {} dimensions, those of the reference {}: they must be the same features",
                source.dimension(),
                target.dimension()
            )))
        }
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Rotation3;

    use super::*;
    use crate::refine::Recipe;

    /// A corner of a room of `size`, a point every 1/20 of it.
    fn corner(size: f64, shift: Vector3<f64>) -> Scan {
        let step = |i: u32| f64::from(i) / 20.0 * size;
        let pairs = (0..20).flat_map(|a| (0..20).map(move |b| (step(a), step(b))));
        let points = pairs.flat_map(|(a, b)| {
            [Point3::new(a, b, 0.0), Point3::new(a, 0.0, b), Point3::new(0.0, a, b)]
        });
        PointCloud::new(points.map(|point| point + shift).collect()).unwrap().into()
    }

    fn scan(points: Vec<Point3<f64>>) -> Scan {
        PointCloud::new(points).unwrap().into()
    }

    fn message(source: &Scan, target: &Scan) -> String {
        match WorkingPair::new(source, target, &RefinerConfig::default()) {
            Ok(_) => String::new(),
            Err(error) => error.to_string(),
        }
    }

    #[test]
    fn clouds_that_do_not_determine_a_pose_are_refused() {
        let good = corner(1.0, Vector3::zeros());
        let line =
            |i: i32| Point3::new(1.0, 2.0, 3.0) + Vector3::new(0.3, -0.2, 1.0) * f64::from(i);
        for (bad, word) in [
            (scan((0..2).map(line).collect()), "2 points"),
            (scan(vec![Point3::new(1.0, 2.0, 3.0); 50]), "identical"),
            (scan((0..50).map(line).collect()), "one line"),
        ] {
            let (first, second) = (message(&bad, &good), message(&good, &bad));
            assert!(first.contains(word) && first.contains("source"), "{first}");
            assert!(second.contains(word) && second.contains("reference"), "{second}");
        }
        assert_eq!(message(&good, &good), "");
    }

    #[test]
    fn features_of_one_side_only_or_of_two_kinds_are_refused() {
        let with_features = |dimension| {
            let points = vec![Point3::origin(); 4];
            let values = vec![1.0; 4 * dimension];
            let features = PointFeatures::new(points, dimension, values).unwrap();
            Scan { features: Some(features), ..corner(1.0, Vector3::zeros()) }
        };
        let without = corner(1.0, Vector3::zeros());
        assert!(message(&with_features(2), &without).contains("only one"));
        assert!(message(&without, &with_features(2)).contains("only one"));
        let different = message(&with_features(2), &with_features(3));
        assert!(different.contains("2 dimensions") && different.contains('3'), "{different}");
        assert_eq!(message(&with_features(2), &with_features(2)), "");
    }

    #[test]
    fn a_working_voxel_is_5_centimetres_and_all_lengths_follow() {
        let clouds = (corner(40.0, Vector3::zeros()), corner(40.0, Vector3::zeros()));
        let pair = WorkingPair::new(&clouds.0, &clouds.1, &RefinerConfig::default()).unwrap();
        assert!((pair.scale.voxel - 0.05).abs() < 1e-12, "{}", pair.scale.voxel);
        assert!(pair.unit > 10.0);
        let back = pair.source.points[7] * pair.unit - clouds.0.cloud.points()[7].coords;
        assert!(back.coords.norm() < 1e-9);
        // The paper's recipe stays in metres.
        let config = RefinerConfig { recipe: Recipe::paper(), ..RefinerConfig::default() };
        let metric = WorkingPair::new(&clouds.0, &clouds.1, &config).unwrap();
        assert_eq!(metric.unit, 1.0);
        assert_eq!(&*metric.source.points, clouds.0.cloud.points());
    }

    fn pose() -> RigidTransform {
        RigidTransform::new(
            Rotation3::new(Vector3::new(0.2, -0.5, 1.1)),
            Vector3::new(3.0, 4.0, 5.0),
        )
    }

    #[test]
    fn poses_go_into_the_working_frames_and_back() {
        let far = Vector3::new(500_123.0, 5_400_321.0, 120.0);
        for (source_shift, target_shift) in [
            (Vector3::zeros(), Vector3::zeros()),
            (far, far + Vector3::new(200.0, -70.0, 3.0)),
            (Vector3::zeros(), far),
        ] {
            let (source, target) = (corner(7.0, source_shift), corner(7.0, target_shift));
            let pair = WorkingPair::new(&source, &target, &RefinerConfig::default()).unwrap();
            let working = pair.to_working(&pose());
            let error = pair.to_world(&working).error_to(&pose());
            assert!(error.rotation_degrees < 1e-9 && error.translation < 1e-6, "{error:?}");
            // The working pose moves working points as the pose moves points.
            let world = source.cloud.world_points()[11];
            let expected = (pose().apply(&world) - target.cloud.shift()) / pair.unit;
            let moved = working.apply(&pair.source.points[11]);
            // Coordinates of 5 000 km have steps of a nanometre.
            assert!((moved - expected).norm() < 1e-7, "{moved} {expected}");
            let given = Correspondence { source: world, target: pose().apply(&world), score: 0.5 };
            let pairs = pair.to_working_pairs(&[given]);
            assert!((pairs[0].source - pair.source.points[11]).norm() < 1e-7);
            assert!((pairs[0].target - expected).norm() < 1e-7);
            assert_eq!(pairs[0].score, 0.5);
        }
    }

    #[test]
    fn given_features_are_thinned_and_moved_with_their_cloud() {
        let far = Vector3::new(500_000.0, 0.0, 0.0);
        let mut source = corner(1.0, far);
        let points = source.cloud.world_points();
        let values = (0..points.len()).flat_map(|i| [i as f32 + 1.0, 0.0]).collect();
        source.features = Some(PointFeatures::new(points, 2, values).unwrap());
        let pair = WorkingPair::new(&source, &source, &RefinerConfig::default()).unwrap();
        let keypoints = &pair.source.keypoints;
        assert_eq!((keypoints.len(), keypoints.dimension()), (500, 2));
        assert!(keypoints.points().iter().all(|point| pair.source.points.contains(point)));
        assert!(keypoints.values().iter().all(|&value| value == 0.0 || (value - 1.0).abs() < 1e-4));
    }

    #[test]
    fn dropped_points_are_reported() {
        let mut points = corner(1.0, Vector3::zeros()).cloud.points().to_vec();
        points.push(Point3::new(f64::NAN, 0.0, 0.0));
        let (broken, whole) = (scan(points), corner(1.0, Vector3::zeros()));
        let config = RefinerConfig::default();
        let warnings = WorkingPair::new(&broken, &whole, &config).unwrap().warnings();
        assert_eq!(warnings.len(), 1);
        assert!(warnings[0].contains("1 points") && warnings[0].contains("source"), "{warnings:?}");
        assert!(WorkingPair::new(&whole, &whole, &config).unwrap().warnings().is_empty());
    }
}
