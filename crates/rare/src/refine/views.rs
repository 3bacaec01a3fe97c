//! The paper's steps over all virtual cameras at once: each function is one step, applied to every view.

use rayon::prelude::*;

use crate::data::{
    Correspondence, CorrespondenceSet, CorrespondenceSets, DepthMap, FeatureMap, LayeredFeatures,
    PointFeatures, RigidTransform, SetName,
};
use crate::densify::Densifier;
use crate::error::{Error, Result};
use crate::fuse::fuse;
use crate::matching::{correspondences, mutual_nearest};
use crate::project::project_moved;
use crate::reduce::reduce;
use crate::refine::working_pair::WorkingPair;
use crate::transfer::{Sampling, common_points, lift};
use crate::viewpoints::{Frame, Viewpoint};

/// Two things of one view, one per cloud.
#[derive(Debug, Clone)]
pub(super) struct Both<T> {
    pub(super) reference: T,
    pub(super) source: T,
}

/// Step 1: both clouds seen by every camera under a pose. Order: for each view the reference's map, then the source's.
pub(super) fn project_all(
    pair: &WorkingPair<'_>,
    viewpoints: &[Viewpoint],
    pose: &RigidTransform,
) -> Vec<DepthMap> {
    let see = |view: &Viewpoint| {
        let camera = &view.camera.intrinsics;
        let reference =
            project_moved(&pair.target.points, &view.camera_from_reference(pose), camera);
        let source = project_moved(&pair.source.points, &view.camera_from_source(pose), camera);
        [reference.depth_map, source.depth_map]
    };
    viewpoints.par_iter().flat_map_iter(see).collect()
}

/// Step 2: the gaps between the points of every map closed.
pub(super) fn densify_all(sparse: &[DepthMap], densifier: Densifier) -> Vec<DepthMap> {
    sparse.par_iter().map(|map| densifier.densify(map)).collect()
}

/// Step 4: one merged feature map per cloud and view. A single layer that is not to be reduced is used as it is.
pub(super) fn reduce_all(
    layers: Vec<LayeredFeatures>,
    components: Option<usize>,
) -> Result<Vec<Both<FeatureMap>>> {
    let maps = layers.len();
    let mut views = Vec::with_capacity(maps / 2);
    let mut layers = layers.into_iter();
    while let Some(reference) = layers.next() {
        let source = layers.next();
        let source = source
            .ok_or_else(|| Error::Internal(format!("features for {maps} maps, an odd number")))?;
        views.push(match (components, <[FeatureMap; 1]>::try_from(reference), source) {
            (None, Ok([reference]), mut source) if source.len() == 1 => {
                Both { reference, source: source.remove(0) }
            }
            (_, reference, source) => {
                let reference = reference.map_or_else(|layers| layers, Vec::from);
                let (reference, source) = reduce(&reference, &source, components)?;
                Both { reference, source }
            }
        });
    }
    Ok(views)
}

/// Step 5: pixels become points of their own cloud, with features.
pub(super) fn transfer_all(
    pair: &WorkingPair<'_>,
    viewpoints: &[Viewpoint],
    pose: &RigidTransform,
    maps: &[DepthMap],
    features: &[Both<FeatureMap>],
    sampling: Sampling,
) -> Vec<Both<PointFeatures>> {
    let (maps, _) = maps.as_chunks::<2>();
    let lift_view =
        |view: &Viewpoint, [reference, source]: &[DepthMap; 2], features: &Both<FeatureMap>| {
            let in_own_frame = |features, map, camera_from_cloud: RigidTransform| {
                let cloud_from_camera = camera_from_cloud.inverse();
                let lifted = lift(features, map, pair.scale.depth_range, sampling).keypoints;
                lifted.map_points(|point| cloud_from_camera.apply(point))
            };
            Both {
                reference: in_own_frame(
                    &features.reference,
                    reference,
                    view.camera_from_reference(pose),
                ),
                source: in_own_frame(&features.source, source, view.camera_from_source(pose)),
            }
        };
    let views: Vec<_> = viewpoints.iter().zip(maps).zip(features).collect();
    views.into_par_iter().map(|((view, maps), features)| lift_view(view, maps, features)).collect()
}

/// Step 5 of the reference alone, which has a map in every view: what all views show, one after the other.
pub(super) fn lift_own(
    pair: &WorkingPair<'_>,
    viewpoints: &[Viewpoint],
    maps: &[DepthMap],
    features: &[FeatureMap],
    sampling: Sampling,
) -> Result<PointFeatures> {
    let dimension = features.first().map_or(0, FeatureMap::channels);
    let (mut points, mut values) = (Vec::new(), Vec::new());
    for ((view, map), features) in viewpoints.iter().zip(maps).zip(features) {
        let cloud_from_camera = view.camera.camera_from_world.inverse();
        let lifted = lift(features, map, pair.scale.depth_range, sampling).keypoints;
        points.extend(lifted.points().iter().map(|point| cloud_from_camera.apply(point)));
        values.extend_from_slice(lifted.values());
    }
    PointFeatures::new(points, dimension, values)
}

/// Step 6: the common points of every view with fused features.
pub(super) fn fuse_all(
    pair: &WorkingPair<'_>,
    lifted: &[Both<PointFeatures>],
) -> Vec<Both<PointFeatures>> {
    let distance = pair.scale.common_point_distance;
    let fused = |keypoints: &PointFeatures, lifted: &PointFeatures| {
        fuse(keypoints, lifted, &common_points(keypoints.points(), lifted.points(), distance))
    };
    lifted
        .par_iter()
        .map(|view| Both {
            reference: fused(&pair.target.keypoints, &view.reference),
            source: fused(&pair.source.keypoints, &view.source),
        })
        .collect()
}

/// Step 7: the five sets of correspondences; views of one frame share a set. `given` replaces the 3D matches.
pub(super) fn match_all(
    pair: &WorkingPair<'_>,
    viewpoints: &[Viewpoint],
    lifted: &[Both<PointFeatures>],
    fused: &[Both<PointFeatures>],
    given: Option<&[Correspondence]>,
) -> Result<CorrespondenceSets> {
    let in_views =
        |frame, features: &[Both<PointFeatures>], kinds| -> Result<Vec<Correspondence>> {
            let mut pairs = Vec::new();
            for (_, view) in viewpoints.iter().zip(features).filter(|(view, _)| view.frame == frame)
            {
                pairs.extend(matched(&view.source, &view.reference, kinds)?);
            }
            Ok(pairs)
        };
    let features_3d = match given {
        Some(pairs) => pairs.to_vec(),
        None => matched(&pair.source.keypoints, &pair.target.keypoints, 1)?,
    };
    let sets = [
        (SetName::CommonReference, in_views(Frame::Reference, fused, 2)?),
        (SetName::CommonSource, in_views(Frame::Source, fused, 2)?),
        (SetName::DiffusionReference, in_views(Frame::Reference, lifted, 1)?),
        (SetName::DiffusionSource, in_views(Frame::Source, lifted, 1)?),
        (SetName::Features3d, features_3d),
    ];
    let sets = sets.into_iter().map(|(name, pairs)| CorrespondenceSet { name, pairs }).collect();
    Ok(CorrespondenceSets { sets })
}

/// Mutual nearest neighbours among features of `kinds` kinds side by side.
pub(super) fn matched(
    source: &PointFeatures,
    target: &PointFeatures,
    kinds: usize,
) -> Result<Vec<Correspondence>> {
    let matches = mutual_nearest(source, target, None)?;
    Ok(correspondences(source, target, &matches, kinds))
}
