//! From clouds to keypoints, correspondences and a pose.

use std::collections::HashMap;

use rare::nalgebra::{Point3, Vector3};
use rare::{Correspondence, Error, PointFeatures, Result, RigidTransform};

use super::{GeoTransformer, Registration};
use crate::Matrix;
use crate::backbones::kpconv::{NeighbourLimits, Pyramid, StagePoints};
use crate::backbones::sampling::{Sampled, sampled};
use crate::backbones::{Description, Keypoints, Selection};

impl GeoTransformer {
    /// Keypoints, correspondences and the pose of two clouds, each in its local frame, metres.
    ///
    /// Clouds that are denser than the network's voxel are thinned to it first. The keypoints are the points of the best
    /// correspondences by `selection`, with the features of the second finest stage; the pose is that of local-to-global
    /// registration on all correspondences (Qin et al., CVPR 2022, section 3.4), whose test of significance may find that
    /// there is none.
    ///
    /// # Errors
    /// `InvalidInput` if a cloud is not finite, spans too much, or has too few points for the coarsest stage, or if the
    /// limits are not one for each stage.
    pub fn describe(
        &self,
        source: &[Point3<f64>],
        target: &[Point3<f64>],
        limits: &NeighbourLimits,
        selection: &Selection,
    ) -> Result<Description> {
        let sampled = self.sampled(source, target)?;
        let stages = self.stages(&sampled)?;
        let pyramid = Pyramid::over(stages, &self.config.pyramid, limits)?;
        let registration = self.register(&pyramid, &mut |_, _| {})?;
        let shifts = [sampled[0].shift, sampled[1].shift];
        let (pairs, groups) = registration.correspondences(&pyramid);
        let pose = self.config.fine.local_to_global().estimate(&pairs, &groups);
        let scores: Vec<f32> = registration.point_matches.iter().map(|pair| pair.score).collect();
        let kept = selection.choose(&scores);
        let chosen = pairs_at(&pairs, &kept);
        Ok(Description {
            source: keypoints(&registration, &chosen, &kept, Side::Source)?.moved(&shifts[1]),
            target: keypoints(&registration, &chosen, &kept, Side::Target)?.moved(&shifts[0]),
            correspondences: chosen.iter().map(|pair| moved(pair, &shifts)).collect(),
            target_from_source: pose.map(|found| unshifted(&found.target_from_source, &shifts)),
            neighbour_limits: Some(limits.clone()),
            warnings: self.warnings(&sampled),
        })
    }

    /// An estimate of the bytes that [`GeoTransformer::describe`] takes for these clouds. The clouds are thinned for it,
    /// which takes less than they do.
    ///
    /// # Errors
    /// Those of [`GeoTransformer::describe`].
    pub fn expected_bytes(
        &self,
        source: &[Point3<f64>],
        target: &[Point3<f64>],
        limits: &NeighbourLimits,
    ) -> Result<u64> {
        let stages = self.stages(&self.sampled(source, target)?)?;
        Ok(self.bytes(&stages, limits))
    }

    /// Target and source as the network wants them.
    fn sampled(&self, source: &[Point3<f64>], target: &[Point3<f64>]) -> Result<[Sampled; 2]> {
        let of = |points, name| sampled(points, name, &self.config.pyramid);
        Ok([of(target, "target")?, of(source, "source")?])
    }

    /// The points of all stages, if there are enough.
    fn stages(&self, sampled: &[Sampled; 2]) -> Result<Vec<StagePoints>> {
        let config = &self.config;
        let clouds = [&sampled[0].points, &sampled[1].points].map(Vec::as_slice);
        let stages = StagePoints::new(clouds, &config.pyramid)?;
        let needed = config.transformer.angle_neighbours + 1;
        let coarsest = stages.last().map(|stage| stage.lengths).unwrap_or_default();
        for ((name, count), cloud) in ["target", "source"].into_iter().zip(coarsest).zip(sampled) {
            if count < needed {
                let voxel = config.pyramid.voxel(config.pyramid.stages - 1);
                return Err(Error::invalid(format!(
                    "the {name} has {count} of the {needed} points that the network for {} needs at {voxel} m (and {} at \
                     {} m): give a larger cloud, make sure that it is in metres, or use a network for smaller scenes",
                    config.name,
                    cloud.points.len(),
                    config.pyramid.voxel
                )));
            }
        }
        Ok(stages)
    }

    fn warnings(&self, [target, source]: &[Sampled; 2]) -> Vec<String> {
        let voxel = self.config.pyramid.voxel;
        let named = [("source", source), ("target", target)];
        named.into_iter().filter_map(|(name, cloud)| cloud.warning(name, voxel)).collect()
    }
}

/// Of what keypoints are wanted.
#[derive(Clone, Copy)]
enum Side {
    Target,
    Source,
}

/// The different points of one side of the chosen pairs, the best pair first; a point is worth as much as its best pair.
fn keypoints(
    registration: &Registration,
    chosen: &[Correspondence],
    places: &[usize],
    side: Side,
) -> Result<Keypoints> {
    let features: &Matrix = match side {
        Side::Target => &registration.point_features[0],
        Side::Source => &registration.point_features[1],
    };
    // Only asked, never iterated: its order cannot show.
    let mut seen = HashMap::new();
    let (mut points, mut values, mut scores) = (Vec::new(), Vec::new(), Vec::new());
    for (pair, &place) in chosen.iter().zip(places) {
        let Some(found) = registration.point_matches.get(place) else { continue };
        let (index, point) = match side {
            Side::Target => (found.target, pair.target),
            Side::Source => (found.source, pair.source),
        };
        if seen.insert(index, ()).is_none() && index < features.rows() {
            points.push(point);
            values.extend_from_slice(features.row(index));
            scores.push(found.score);
        }
    }
    Ok(Keypoints { features: PointFeatures::new(points, features.columns(), values)?, scores })
}

fn pairs_at(pairs: &[Correspondence], places: &[usize]) -> Vec<Correspondence> {
    places.iter().filter_map(|&place| pairs.get(place)).copied().collect()
}

fn moved(pair: &Correspondence, [target, source]: &[Vector3<f64>; 2]) -> Correspondence {
    Correspondence { source: pair.source + source, target: pair.target + target, ..*pair }
}

/// A pose between shifted clouds as one between the clouds themselves.
fn unshifted(pose: &RigidTransform, [target, source]: &[Vector3<f64>; 2]) -> RigidTransform {
    let translation = pose.translation() + target - pose.rotate(source);
    RigidTransform::new(*pose.rotation(), translation)
}
