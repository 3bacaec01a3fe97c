//! The pairs of surface points, sought from both clouds.

use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

use crate::data::RigidTransform;
use crate::error::{Error, Result};
use crate::pose::partners::{CHUNK, Extent, Match, Search, match_each};
use crate::pose::{IcpStage, IcpTarget, RobustKernel};

/// Cosine of the largest angle between the normals of a pair.
const LEAST_COSINE: f64 = 0.5;

/// The sampled points of both clouds and their partners.
pub(super) struct Surfaces<'a> {
    source: Sample<'a>,
    target: Sample<'a>,
}

/// What one pair says, in the target's frame.
#[derive(Debug, Clone, Copy)]
pub(super) struct SurfacePair {
    /// The source's point.
    pub(super) point: Point3<f64>,
    /// The mean of both normals, of unit length.
    pub(super) normal: Vector3<f64>,
    /// How far the source's point lies before the target's along the normal, metres.
    pub(super) residual: f64,
    /// Above 0, at most 1.
    pub(super) weight: f64,
}

/// Points of one cloud that seek partners in the other.
struct Sample<'a> {
    points: Vec<Point3<f64>>,
    normals: Vec<Vector3<f64>>,
    extent: Extent,
    matches: Vec<Match>,
    other: &'a IcpTarget,
}

#[derive(Clone, Copy)]
struct SurfacePoint {
    point: Point3<f64>,
    normal: Vector3<f64>,
}

impl<'a> Surfaces<'a> {
    /// # Errors
    /// `InvalidInput` if an index lies beyond its cloud or no sampled point is finite.
    pub(super) fn new(
        source: &'a IcpTarget,
        target: &'a IcpTarget,
        source_sample: &[usize],
        target_sample: &[usize],
    ) -> Result<Surfaces<'a>> {
        let surfaces = Surfaces {
            source: Sample::new("source", source, source_sample, target)?,
            target: Sample::new("target", target, target_sample, source)?,
        };
        if surfaces.source.extent.finite + surfaces.target.extent.finite == 0 {
            return Err(Error::invalid("anchored icp was given no sampled points that are finite"));
        }
        Ok(surfaces)
    }

    /// The pairs that have a say under `target_from_source`: first those that the source sought.
    pub(super) fn pairs(
        &mut self,
        target_from_source: &RigidTransform,
        stage: &IcpStage,
    ) -> Vec<SurfacePair> {
        let source_from_target = target_from_source.inverse();
        let Surfaces { source, target } = self;
        let (mut pairs, others) = rayon::join(
            || {
                source.seek(target_from_source, stage);
                source.pairs(stage, |own, other, weight| {
                    SurfacePair::between(&own.moved(target_from_source), other, weight)
                })
            },
            || {
                target.seek(&source_from_target, stage);
                target.pairs(stage, |own, other, weight| {
                    SurfacePair::between(&other.moved(target_from_source), own, weight)
                })
            },
        );
        pairs.extend(others);
        pairs
    }
}

impl SurfacePair {
    /// `None` if the normals are too far apart or one is missing.
    fn between(source: &SurfacePoint, target: &SurfacePoint, weight: f64) -> Option<SurfacePair> {
        let cosine = source.normal.dot(&target.normal);
        if cosine.is_nan() || cosine.abs() < LEAST_COSINE {
            return None;
        }
        let normal = (target.normal + source.normal * cosine.signum()).try_normalize(0.0)?;
        let residual = (source.point - target.point).dot(&normal);
        Some(SurfacePair { point: source.point, normal, residual, weight })
    }
}

impl SurfacePoint {
    fn moved(&self, pose: &RigidTransform) -> SurfacePoint {
        SurfacePoint { point: pose.apply(&self.point), normal: pose.rotate(&self.normal) }
    }
}

impl<'a> Sample<'a> {
    fn new(
        role: &str,
        own: &IcpTarget,
        sample: &[usize],
        other: &'a IcpTarget,
    ) -> Result<Sample<'a>> {
        let at = |&index: &usize| {
            let found = own.points().get(index).zip(own.normals().get(index));
            found.map(|(&point, &normal)| (point, normal)).ok_or_else(|| {
                Error::invalid(format!(
                    "the {role} sample of anchored icp has the index {index}, the cloud has {} points",
                    own.points().len()
                ))
            })
        };
        let (points, normals): (Vec<_>, Vec<_>) =
            sample.iter().map(at).collect::<Result<Vec<_>>>()?.into_iter().unzip();
        let (extent, matches) = (Extent::of(&points), vec![Match::UNSOUGHT; points.len()]);
        Ok(Sample { points, normals, extent, matches, other })
    }

    fn seek(&mut self, other_from_own: &RigidTransform, stage: &IcpStage) {
        let search = Search {
            target: self.other,
            max_distance: stage.max_distance,
            spread: self.extent.spread,
        };
        match_each(&self.points, &mut self.matches, other_from_own, |found, moved| {
            found.with_point(moved, &search);
        });
    }

    /// What `pair` makes of each point of this cloud, its partner in the other, both in their own frames, and the
    /// weight of their distance; in the order of the points.
    fn pairs(
        &self,
        stage: &IcpStage,
        pair: impl Fn(&SurfacePoint, &SurfacePoint, f64) -> Option<SurfacePair> + Sync,
    ) -> Vec<SurfacePair> {
        let own = self.points.par_iter().zip(&self.normals).zip(&self.matches);
        let found = own.with_min_len(CHUNK).filter_map(|((&point, &normal), found)| {
            let distance = found.squared_distance.sqrt();
            let weight = RobustKernel::Tukey.weight(distance, stage.kernel_width);
            if !(distance.is_finite() && weight > 0.0) {
                return None;
            }
            let partner = found.partner as usize;
            let other = SurfacePoint {
                point: *self.other.points().get(partner)?,
                normal: *self.other.normals().get(partner)?,
            };
            pair(&SurfacePoint { point, normal }, &other, weight)
        });
        found.collect()
    }
}
