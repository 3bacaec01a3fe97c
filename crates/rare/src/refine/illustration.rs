//! What the refiner sees, matches and judges, for people to look at.
//!
//! Nothing of it is kept during a registration: it is made again for the transforms of interest. The depth maps, their
//! features and matches are those of the first round, seen under the initial transform; whether a match is right is
//! said of the result.

use nalgebra::Point3;
use rayon::prelude::*;

use crate::data::{
    Correspondence, DepthMap, FeatureMap, PointFeatures, RigidTransform, Scan, SetName,
};
use crate::error::Result;
use crate::pose::IcpTarget;
use crate::project::pixel;
use crate::reduce::JointPca;
use crate::refine::Refiner;
use crate::refine::encoded_views::DenseViews;
use crate::refine::stopwatch::Stopwatch;
use crate::refine::views::{self, Both};
use crate::refine::working_pair::WorkingPair;
use crate::verify::{Verifier, Visibility, VisibilityMask};
use crate::viewpoints::{Frame, Viewpoint};

/// Surfaces are sought within so many voxels: whatever is farther off is not compared.
const RESIDUAL_REACH: f64 = 5.0;

/// What is to be shown of a pair.
#[derive(Debug, Clone, PartialEq)]
pub struct IllustrationRequest {
    /// The transform under which the depth maps are rendered, encoded and matched.
    pub seen_from: RigidTransform,
    /// The transforms that are judged, all of source to target as the caller gave the clouds; at least one, the result last.
    pub poses: Vec<RigidTransform>,
    /// Of each cloud no more points than that are judged, evenly chosen.
    pub most_points: usize,
}

/// What the refiner sees of a pair.
#[derive(Debug, Clone, PartialEq)]
pub struct Illustration {
    /// The virtual cameras, first those of the reference.
    pub views: Vec<IllustratedView>,
    /// What is known of the source's points.
    pub source: IllustratedCloud,
    /// What is known of the reference's points.
    pub reference: IllustratedCloud,
    /// The distance up to which a correspondence is an inlier, metres.
    pub acceptance_radius: f64,
}

/// What one virtual camera sees.
#[derive(Debug, Clone, PartialEq)]
pub struct IllustratedView {
    /// The cloud in whose frame the camera stands still.
    pub frame: Frame,
    /// What it sees of the reference.
    pub reference: IllustratedMap,
    /// What it sees of the source.
    pub source: IllustratedMap,
    /// What features match in it.
    pub matches: Vec<PixelMatch>,
    /// For every pose what it says of the cloud that moves.
    pub masks: Vec<VisibilityMask>,
}

/// What one virtual camera sees of one cloud.
#[derive(Debug, Clone, PartialEq)]
pub struct IllustratedMap {
    /// The depth of the points, metres.
    pub sparse: DepthMap,
    /// The gaps between them closed, metres.
    pub dense: DepthMap,
    /// The three principal components of the features, common to both maps of a view; all 0 where nothing is known.
    pub features: FeatureMap,
}

/// A correspondence where a camera sees it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PixelMatch {
    /// Which kind of features matched.
    pub set: SetName,
    /// Column and row in the map of the source.
    pub source: (usize, usize),
    /// Column and row in the map of the reference.
    pub reference: (usize, usize),
    /// Whether the last pose agrees.
    pub inlier: bool,
}

/// Points of a cloud and what the poses make of them.
#[derive(Debug, Clone, PartialEq)]
pub struct IllustratedCloud {
    /// Which of the cloud's points these are.
    pub indices: Vec<usize>,
    /// For every pose the distance of each to the surface of the other cloud, metres; infinite beyond five voxels.
    pub residuals: Vec<Vec<f32>>,
    /// For every pose what the other cloud's sensor says of each.
    pub visibility: Vec<Vec<Visibility>>,
}

impl Refiner {
    /// Looks at a pair under given transforms. Costs about as much as one round of [`Refiner::refine`].
    ///
    /// # Errors
    /// As [`Refiner::refine`].
    pub fn illustrate(
        &self,
        source: &Scan,
        target: &Scan,
        request: &IllustrationRequest,
    ) -> Result<Illustration> {
        let mut clock = self.stopwatch();
        let pair = clock.time("prepare", || WorkingPair::new(source, target, &self.config))?;
        let poses: Vec<RigidTransform> =
            request.poses.iter().map(|pose| pair.to_working(pose)).collect();
        let seen_from = pair.to_working(&request.seen_from);
        let seen = self.see(&pair, &seen_from, &mut clock)?;
        let verifier = clock.time("verify", || self.verifier(&pair, &seen_from));
        let judge = Judge { pair: &pair, verifier: &verifier, seen_from, poses: &poses };
        Ok(Illustration {
            views: clock.time("illustrate", || judge.views(seen))?,
            source: judge.cloud(Frame::Source, request.most_points),
            reference: judge.cloud(Frame::Reference, request.most_points),
            acceptance_radius: pair.scale.acceptance_radius * pair.unit,
        })
    }

    /// Steps 1 to 6 under a pose, with all that they make.
    fn see(
        &self,
        pair: &WorkingPair<'_>,
        pose: &RigidTransform,
        clock: &mut Stopwatch<'_>,
    ) -> Result<Vec<SeenView>> {
        let DenseViews { viewpoints, sparse, maps } = self.dense_views(pair, pose, clock);
        let layers = clock.time("encode", || self.encode(pair, &maps))?;
        let components = self.config.recipe.components;
        let features = clock.time("reduce", || views::reduce_all(layers, components))?;
        let lifted = clock.time("transfer", || {
            views::transfer_all(pair, &viewpoints, pose, &maps, &features, self.sampling())
        });
        let fused = clock.time("fuse", || views::fuse_all(pair, &lifted));
        let (sparse, dense) = (in_pairs(&sparse, pair.unit)?, in_pairs(&maps, pair.unit)?);
        let maps = sparse.into_iter().zip(dense).zip(features);
        let points = lifted.into_iter().zip(fused);
        let seen = viewpoints.into_iter().zip(maps).zip(points);
        Ok(seen
            .map(|((viewpoint, ((sparse, dense), features)), (lifted, fused))| SeenView {
                viewpoint,
                sparse,
                dense,
                features,
                lifted,
                fused,
            })
            .collect())
    }
}

/// One view as it goes through the steps.
struct SeenView {
    viewpoint: Viewpoint,
    sparse: Both<DepthMap>,
    dense: Both<DepthMap>,
    features: Both<FeatureMap>,
    lifted: Both<PointFeatures>,
    fused: Both<PointFeatures>,
}

/// Says of what is seen whether it is right; lengths and frames of the working pair.
struct Judge<'a> {
    pair: &'a WorkingPair<'a>,
    verifier: &'a Verifier<'a>,
    seen_from: RigidTransform,
    poses: &'a [RigidTransform],
}

impl Judge<'_> {
    fn views(&self, seen: Vec<SeenView>) -> Result<Vec<IllustratedView>> {
        let masks: Vec<_> = self.poses.iter().map(|pose| self.verifier.masks(pose)).collect();
        let of_view = |index| masks.iter().filter_map(|masks| masks.get(index).cloned()).collect();
        let views = seen.into_iter().enumerate();
        views.map(|(index, view)| self.view(view, of_view(index))).collect()
    }

    fn view(&self, seen: SeenView, masks: Vec<VisibilityMask>) -> Result<IllustratedView> {
        let matches = self.matches(&seen)?;
        let colours = principal_colours(&seen.features)?;
        let map = |sparse, dense, features| IllustratedMap { sparse, dense, features };
        Ok(IllustratedView {
            frame: seen.viewpoint.frame,
            reference: map(seen.sparse.reference, seen.dense.reference, colours.reference),
            source: map(seen.sparse.source, seen.dense.source, colours.source),
            matches,
            masks,
        })
    }

    /// The correspondences of one view, those of its common points first.
    fn matches(&self, seen: &SeenView) -> Result<Vec<PixelMatch>> {
        let (common, dense) = match seen.viewpoint.frame {
            Frame::Reference => (SetName::CommonReference, SetName::DiffusionReference),
            Frame::Source => (SetName::CommonSource, SetName::DiffusionSource),
        };
        let mut matches = Vec::new();
        for (set, points, kinds) in [(common, &seen.fused, 2), (dense, &seen.lifted, 1)] {
            let pairs = views::matched(&points.source, &points.reference, kinds)?;
            let seen = pairs.iter().filter_map(|pair| self.pixels(set, pair, &seen.viewpoint));
            matches.extend(seen);
        }
        Ok(matches)
    }

    /// Where a camera sees both sides of a correspondence; `None` if it does not.
    fn pixels(
        &self,
        set: SetName,
        pair: &Correspondence,
        viewpoint: &Viewpoint,
    ) -> Option<PixelMatch> {
        let camera = &viewpoint.camera.intrinsics;
        let source = viewpoint.camera_from_source(&self.seen_from).apply(&pair.source);
        let reference = viewpoint.camera_from_reference(&self.seen_from).apply(&pair.target);
        let result = self.poses.last().unwrap_or(&self.seen_from);
        let distance = (result.apply(&pair.source) - pair.target).norm();
        Some(PixelMatch {
            set,
            source: pixel(&source, camera)?,
            reference: pixel(&reference, camera)?,
            inlier: distance < self.pair.scale.acceptance_radius,
        })
    }

    /// What is known of the points of the cloud of `frame`.
    fn cloud(&self, frame: Frame, most_points: usize) -> IllustratedCloud {
        let (own, other, other_frame) = match frame {
            Frame::Reference => (&self.pair.target, &self.pair.source, Frame::Source),
            Frame::Source => (&self.pair.source, &self.pair.target, Frame::Reference),
        };
        let step = own.points.len().div_ceil(most_points.max(1)).max(1);
        let indices: Vec<usize> = (0..own.points.len()).step_by(step).collect();
        let points: Vec<Point3<f64>> = own.points.iter().step_by(step).copied().collect();
        let residuals = |reference_from_source: &RigidTransform| {
            let other_from_own = match frame {
                Frame::Reference => reference_from_source.inverse(),
                Frame::Source => *reference_from_source,
            };
            self.residuals(&points, &other.surface, &other_from_own)
        };
        let visibility = |pose| self.verifier.visibility(other_frame, &points, pose);
        IllustratedCloud {
            indices,
            residuals: self.poses.iter().map(residuals).collect(),
            visibility: self.poses.iter().map(visibility).collect(),
        }
    }

    /// Distances from a surface, metres. It consists of discs around its points, as wide as a voxel: between points no one
    /// knows better, and beyond its edge the distance grows from 0. Infinite where nothing is within reach.
    fn residuals(
        &self,
        points: &[Point3<f64>],
        surface: &IcpTarget,
        surface_from_points: &RigidTransform,
    ) -> Vec<f32> {
        let reach = RESIDUAL_REACH * self.pair.scale.voxel;
        let distance = |point: &Point3<f64>| {
            let point = surface_from_points.apply(point);
            let nearest = surface.tree().nearest_within(&point, reach)?;
            let on = surface.points().get(nearest.index)?;
            let normal = surface.normals().get(nearest.index)?;
            let across = (point - on).dot(normal);
            let along = (nearest.squared_distance - across * across).max(0.0).sqrt();
            Some(across.hypot((along - self.pair.scale.voxel).max(0.0)))
        };
        let metres = |point| distance(point).map_or(f32::INFINITY, |d| (d * self.pair.unit) as f32);
        points.par_iter().map(metres).collect()
    }
}

/// The maps of each view, the reference's and the source's, with lengths in metres.
fn in_pairs(maps: &[DepthMap], unit: f64) -> Result<Vec<Both<DepthMap>>> {
    let in_metres = |map: &DepthMap| {
        let metres = |&depth: &f32| (f64::from(depth) * unit) as f32;
        DepthMap::new(*map.intrinsics(), map.depth().iter().map(metres).collect())
    };
    let (pairs, _) = maps.as_chunks::<2>();
    let both = |[reference, source]: &[DepthMap; 2]| {
        Ok(Both { reference: in_metres(reference)?, source: in_metres(source)? })
    };
    pairs.iter().map(both).collect()
}

/// The three principal components that both maps of a view have in common.
fn principal_colours(features: &Both<FeatureMap>) -> Result<Both<FeatureMap>> {
    let components = JointPca::fit(&features.reference, &features.source, 3)?;
    Ok(Both {
        reference: components.project(&features.reference)?,
        source: components.project(&features.source)?,
    })
}
