//! Which point is nearest to which, round after round.
//!
//! Most points keep their partner from round to round. Each remembers where it was last sought and how far away all
//! other points were then; as long as it has travelled less than that allows, its partner is known to be the nearest
//! point still, and no search is made.

use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

use crate::data::{Neighbour, RigidTransform};
use crate::pose::IcpTarget;

/// Points per unit of parallel work; independent of the number of threads, so that sums are too.
pub(super) const CHUNK: usize = 1024;

/// How far a search looks beyond the nearest point: so many times as far as the point has come since the last search,
/// which is about how far it will go until the alignment is at rest, ...
const MARGIN: f64 = 2.0;
/// ... within these shares of the largest distance of a pair.
const MARGIN_SHARES: [f64; 2] = [0.01, 0.1];

/// Guards a comparison of distances against the rounding of their square roots.
const ROUNDING: f64 = 1.0 - 1e-12;

/// A source point under the current pose and its partner.
#[derive(Debug, Clone, Copy)]
pub(super) struct Match {
    pub(super) moved: Point3<f64>,
    /// Infinite if it has no partner within reach.
    pub(super) squared_distance: f64,
    /// The target point or voxel it was matched with last; of points a good first guess of the next one.
    pub(super) partner: u32,
    /// Where it was when its partner was last sought, ...
    searched_at: Point3<f64>,
    /// ... and a distance that no other target point was closer than then.
    clearance: f64,
}

/// Where partners are sought.
pub(super) struct Search<'a> {
    pub(super) target: &'a IcpTarget,
    pub(super) max_distance: f64,
    /// Of the points that seek, metres: a small cloud looks less far beyond.
    pub(super) spread: f64,
}

impl Match {
    /// Of a point that was not yet moved.
    pub(super) const UNSOUGHT: Match = Match {
        moved: Point3::new(0.0, 0.0, 0.0),
        squared_distance: f64::INFINITY,
        partner: 0,
        searched_at: Point3::new(0.0, 0.0, 0.0),
        clearance: f64::NEG_INFINITY,
    };

    fn is_unsought(&self) -> bool {
        self.clearance == f64::NEG_INFINITY
    }

    /// Finds the nearest point closer than `max_distance`.
    pub(super) fn with_point(&mut self, moved: Point3<f64>, search: &Search<'_>) {
        let max_distance = search.max_distance;
        let guess = Neighbour::of(search.target.points(), self.partner as usize, &moved);
        let travelled = if self.is_unsought() { 0.0 } else { (moved - self.searched_at).norm() };
        let others = self.clearance * ROUNDING - travelled;
        let distance = guess.map_or(f64::INFINITY, |guess| guess.squared_distance.sqrt());
        self.moved = moved;
        let known = distance < others || (distance > max_distance && others > max_distance);
        let nearest = if known { guess } else { self.sought(guess, travelled, search) };
        let within = nearest.filter(|n| n.squared_distance < max_distance * max_distance);
        self.squared_distance = within.map_or(f64::INFINITY, |nearest| nearest.squared_distance);
    }

    fn sought(
        &mut self,
        guess: Option<Neighbour>,
        travelled: f64,
        search: &Search<'_>,
    ) -> Option<Neighbour> {
        let [least, most] =
            MARGIN_SHARES.map(|share| share * search.max_distance.min(search.spread));
        let margin = (MARGIN * travelled).clamp(least, most);
        let radius = search.max_distance + margin;
        let (nearest, clearance) =
            search.target.tree().nearest_with_clearance(&self.moved, guess, radius, margin);
        self.searched_at = self.moved;
        self.clearance = clearance;
        self.partner = nearest.map_or(self.partner, |nearest| nearest.index as u32);
        nearest
    }

    /// Whether it has a partner at most `limit` (squared distance) away.
    pub(super) fn is_kept(&self, limit: f64) -> bool {
        self.squared_distance.is_finite() && self.squared_distance <= limit
    }
}

/// Where a cloud is and how far it reaches.
#[derive(Debug, Clone, Copy)]
pub(super) struct Extent {
    /// Points that are finite; only they count.
    pub(super) finite: usize,
    /// Not finite if there is no point.
    pub(super) centroid: Point3<f64>,
    /// Root mean square distance from the centroid, metres; 1 if all points coincide.
    pub(super) spread: f64,
}

impl Extent {
    pub(super) fn of(points: &[Point3<f64>]) -> Extent {
        let is_finite = |point: &&Point3<f64>| point.iter().all(|value| value.is_finite());
        let finite = points.iter().filter(is_finite);
        let number = finite.clone().count();
        let count = number as f64;
        let centroid = Point3::from(finite.clone().map(|p| p.coords).sum::<Vector3<f64>>() / count);
        let square = finite.map(|p| (p - centroid).norm_squared()).sum::<f64>() / count;
        // One point, or copies of it, have no spread: any unit will do.
        let spread = if square > 0.0 { square.sqrt() } else { 1.0 };
        Extent { finite: number, centroid, spread }
    }
}

/// Lets `find` match each point, moved by `pose`, chunk by chunk. `matches` has one entry per point.
pub(super) fn match_each(
    points: &[Point3<f64>],
    matches: &mut [Match],
    pose: &RigidTransform,
    find: impl Fn(&mut Match, Point3<f64>) + Sync,
) {
    let chunks = points.par_chunks(CHUNK).zip(matches.par_chunks_mut(CHUNK));
    chunks.for_each(|(points, matches)| {
        let mut neighbour = 0;
        for (point, found) in points.iter().zip(matches) {
            // Points that follow one another are often close.
            if found.is_unsought() {
                found.partner = neighbour;
            }
            find(found, pose.apply(point));
            neighbour = found.partner;
        }
    });
}
