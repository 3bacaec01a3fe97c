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
use crate::features::{estimate_normals, fpfh_at, orient_towards};
use crate::pose::IcpTarget;
use crate::random::Random;
use crate::refine::RefinerConfig;
use crate::scale::{Scale, SceneKind};
use crate::verify::{Overlap, overlap};

/// The voxel size in working units, for which the recipe's constants are made.
const WORKING_VOXEL: f64 = 0.05;

/// Two clouds ready to be registered; lengths in working units.
pub(crate) struct WorkingPair<'a> {
    pub(crate) source: WorkingCloud<'a>,
    pub(crate) target: WorkingCloud<'a>,
    /// The target's half-voxel points with normals and an index: what the polish aligns to.
    pub(crate) target_surface: IcpTarget,
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
    /// One point per half voxel.
    pub(crate) fine: Vec<Point3<f64>>,
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
            target_surface: surface(&target_side.fine, &scale)?,
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
    pub(crate) fn to_world_sets(&self, sets: &CorrespondenceSets) -> CorrespondenceSets {
        let to_world = |pair: &Correspondence| Correspondence {
            source: pair.source * self.unit + self.source_cloud.shift(),
            target: pair.target * self.unit + self.target_cloud.shift(),
            score: pair.score,
        };
        let set_to_world = |set: &CorrespondenceSet| CorrespondenceSet {
            name: set.name,
            pairs: set.pairs.iter().map(to_world).collect(),
        };
        CorrespondenceSets { sets: sets.sets.iter().map(set_to_world).collect() }
    }

    /// How much of the source lies on the target under a pose, in metres.
    pub(crate) fn overlap(&self, target_from_source: &RigidTransform) -> Overlap {
        let tree = self.target_surface.tree();
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
        let count = config.recipe.keypoints.unwrap_or(scale.keypoints);
        let mut random = Random::new(config.seed, stream);
        let keypoints = match &scan.features {
            Some(features) => sampled(features, scan.cloud.shift(), unit, count, &mut random),
            None => histograms(&coarse, scale, count, &mut random)?,
        };
        Ok(WorkingCloud { points, coarse, fine, keypoints })
    }

    /// Fast point feature histograms at `count` seeded voxel points.
    pub(crate) fn histograms(
        &self,
        scale: &Scale,
        count: usize,
        random: &mut Random,
    ) -> Result<PointFeatures> {
        histograms(&self.coarse, scale, count, random)
    }
}

fn in_units(points: &[Point3<f64>], unit: f64) -> Cow<'_, [Point3<f64>]> {
    if unit == 1.0 {
        Cow::Borrowed(points)
    } else {
        Cow::Owned(points.iter().map(|point| point / unit).collect())
    }
}

/// Normals from 20 neighbours within two voxels.
fn surface(fine: &[Point3<f64>], scale: &Scale) -> Result<IcpTarget> {
    let normals = estimate_normals(fine, &KdTree::new(fine), 2.0 * scale.voxel, 20);
    IcpTarget::new(fine.to_vec(), normals)
}

/// The caller's keypoints in the working frame, at most `count` of them.
fn sampled(
    features: &PointFeatures,
    shift: &Vector3<f64>,
    unit: f64,
    count: usize,
    random: &mut Random,
) -> PointFeatures {
    let mut chosen = random.sample(count, features.len());
    chosen.sort_unstable();
    features.select(&chosen).normalised().map_points(|point| (point - shift) / unit)
}

/// Fast point feature histograms at `count` random voxel points: normals from 30 neighbours within 2 voxels, features
/// from 100 neighbours within 5, as the official evaluations have it.
fn histograms(
    coarse: &[Point3<f64>],
    scale: &Scale,
    count: usize,
    random: &mut Random,
) -> Result<PointFeatures> {
    let tree = KdTree::new(coarse);
    let mut normals = estimate_normals(coarse, &tree, 2.0 * scale.voxel, 30);
    if scale.kind != SceneKind::Object {
        orient_towards(&mut normals, coarse, &Point3::origin());
    }
    let mut chosen = random.sample(count, coarse.len());
    chosen.sort_unstable();
    Ok(fpfh_at(coarse, &normals, &tree, 5.0 * scale.voxel, 100, &chosen)?.normalised())
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
