//! Where the clouds touch under a pose: how closely, at which angles, and whether the same things meet there.
//!
//! Planes touch planes under many wrong poses. What distinguishes the right one is that the *variation* meets, too:
//! where the source is curved, edged or cluttered, so is the reference. The descriptors of touching points tell, once
//! what all of them have in common is taken away: their correlation over the contact is near 0 for planes that happen
//! to coincide and near 1 for two scans of one surface.

use nalgebra::{Matrix6, Point3, Vector3, Vector6};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::data::RigidTransform;
use crate::features::Landmarks;
use crate::pose::IcpTarget;

/// Points per unit of parallel work; independent of the number of threads.
const CHUNK: usize = 256;
/// What looseness is called where nothing holds.
const LOOSEST: f64 = 1000.0;
/// Landmarks of a cloud that are looked at.
const PROBES: usize = 1500;

/// What is found where moved landmarks of one cloud come closer than a voxel to the other; both ways together.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Contact {
    /// Share of the source's landmarks that touch the reference.
    pub source_share: f64,
    /// Share of the reference's landmarks that touch the source.
    pub reference_share: f64,
    /// Root mean square distance to the other surface's tangent planes, voxels.
    pub residual: f64,
    /// Mean cosine between the normals, either sign.
    pub normal_agreement: f64,
    /// Correlation of the descriptors over the contact, -1 to 1; the mean of both ways.
    pub correlation: f64,
    /// Pairs of landmarks whose descriptors were compared; the fewer of both ways.
    pub compared: usize,
    /// How far the origin of the source moves (root mean square over all directions) for one unit of distance between
    /// the touching surfaces: large where they can slide or turn on one another, or lie far away. At most 1000.
    pub looseness: f64,
}

/// A cloud whose contact is judged.
#[derive(Debug, Clone, Copy)]
pub(super) struct Body<'a> {
    pub(super) surface: &'a IcpTarget,
    pub(super) landmarks: &'a Landmarks,
}

/// What one way of looking finds.
struct OneWay {
    probes: usize,
    touching: usize,
    squared_distance: f64,
    cosine: f64,
    correlation: f64,
    compared: usize,
    /// Mean of `J^T J` over the touching landmarks, turn first, about the origin of the cloud that stands still.
    information: Matrix6<f64>,
}

/// The contact of the clouds under a pose.
pub(super) fn contact(
    reference: Body<'_>,
    source: Body<'_>,
    reference_from_source: &RigidTransform,
    voxel: f64,
) -> Contact {
    let forth = one_way(source, reference, reference_from_source, voxel);
    let back = one_way(reference, source, &reference_from_source.inverse(), voxel);
    let touching = (forth.touching + back.touching).max(1) as f64;
    let share = |way: &OneWay| way.touching as f64 / way.probes.max(1) as f64;
    Contact {
        source_share: share(&forth),
        reference_share: share(&back),
        residual: ((forth.squared_distance + back.squared_distance) / touching).sqrt() / voxel,
        normal_agreement: (forth.cosine + back.cosine) / touching,
        correlation: (forth.correlation + back.correlation) / 2.0,
        compared: forth.compared.min(back.compared),
        looseness: looseness(&forth.information, reference_from_source),
    }
}

/// From `J^T J / n` of the distances to the tangent planes for a turn and a shift of the source's origin.
fn looseness(information: &Matrix6<f64>, reference_from_source: &RigidTransform) -> f64 {
    // The increment is taken about the reference's origin; here about where the source's origin has come to.
    let origin = Vector3::from(*reference_from_source.translation());
    let mut about_source = Matrix6::identity();
    about_source.fixed_view_mut::<3, 3>(3, 0).copy_from(&origin.cross_matrix());
    let about_source = about_source.transpose() * information * about_source;
    let covariance = about_source.try_inverse().unwrap_or_else(|| Matrix6::from_element(f64::MAX));
    let variance = covariance.fixed_view::<3, 3>(3, 3).trace();
    if variance.is_finite() && variance > 0.0 { variance.sqrt().min(LOOSEST) } else { LOOSEST }
}

fn one_way(moved: Body<'_>, still: Body<'_>, still_from_moved: &RigidTransform, voxel: f64) -> OneWay {
    let points = moved.landmarks.points();
    let step = points.len().div_ceil(PROBES).max(1);
    let probes: Vec<usize> = (0..points.len()).step_by(step).collect();
    let found: Vec<Probe> = (probes.par_iter().with_min_len(CHUNK))
        .map(|&index| Probe::new(index, moved, still, still_from_moved, voxel))
        .collect();
    let touching = || found.iter().filter_map(|probe| probe.touch);
    let mut information = Matrix6::zeros();
    for Touch { point, across, .. } in touching() {
        let turn = point.coords.cross(&across);
        let row = Vector6::new(turn.x, turn.y, turn.z, across.x, across.y, across.z);
        information += row * row.transpose();
    }
    let pairs: Vec<(usize, usize)> = found.iter().filter_map(|probe| probe.pair).collect();
    OneWay {
        probes: probes.len(),
        touching: touching().count(),
        squared_distance: touching().map(|touch| touch.distance * touch.distance).sum(),
        cosine: touching().map(|touch| touch.cosine).sum(),
        information: information / touching().count().max(1) as f64,
        correlation: correlation(moved.landmarks, still.landmarks, &pairs),
        compared: pairs.len(),
    }
}

/// Where a moved landmark touches the other surface.
#[derive(Clone, Copy)]
struct Touch {
    point: Point3<f64>,
    /// The other surface's normal.
    across: Vector3<f64>,
    /// To its tangent plane.
    distance: f64,
    /// Between the normals, either sign.
    cosine: f64,
}

/// A moved landmark and what it meets.
struct Probe {
    touch: Option<Touch>,
    /// Its index and that of the landmark it meets.
    pair: Option<(usize, usize)>,
}

impl Probe {
    fn new(
        index: usize,
        moved: Body<'_>,
        still: Body<'_>,
        still_from_moved: &RigidTransform,
        voxel: f64,
    ) -> Probe {
        let point: Point3<f64> = still_from_moved.apply(&moved.landmarks.points()[index]);
        let normal = still_from_moved.rotate(&moved.landmarks.normals()[index]);
        let (points, normals) = (still.surface.points(), still.surface.normals());
        let nearest = still.surface.tree().nearest_within(&point, voxel);
        let touch = nearest.and_then(|nearest| {
            let (place, across) = (points.get(nearest.index)?, normals.get(nearest.index)?);
            let (distance, cosine) = ((point - place).dot(across), normal.dot(across).abs());
            Some(Touch { point, across: *across, distance, cosine })
        });
        let met = touch.and_then(|_| still.landmarks.tree().nearest_within(&point, voxel));
        Probe { touch, pair: met.map(|met| (index, met.index)) }
    }
}

/// Pearson's correlation of the descriptors, over all pairs and numbers, about each side's mean descriptor; 0 for fewer
/// than ten pairs.
fn correlation(moved: &Landmarks, still: &Landmarks, pairs: &[(usize, usize)]) -> f64 {
    if pairs.len() < 10 {
        return 0.0;
    }
    let dimension = moved.features().dimension();
    let mut means = [vec![0.0; dimension], vec![0.0; dimension]];
    let sides = |&(a, b): &(usize, usize)| [moved.features().feature(a), still.features().feature(b)];
    for features in pairs.iter().map(sides) {
        for (mean, feature) in means.iter_mut().zip(features) {
            for (mean, &value) in mean.iter_mut().zip(feature) {
                *mean += f64::from(value) / pairs.len() as f64;
            }
        }
    }
    let [mut both, mut first, mut second] = [0.0; 3];
    for [a, b] in pairs.iter().map(sides) {
        let means = means[0].iter().zip(&means[1]);
        for ((&a, &b), (mean_a, mean_b)) in a.iter().zip(b).zip(means) {
            let (a, b) = (f64::from(a) - mean_a, f64::from(b) - mean_b);
            both += a * b;
            first += a * a;
            second += b * b;
        }
    }
    let product = (first * second).sqrt();
    if product > 0.0 { both / product } else { 0.0 }
}
