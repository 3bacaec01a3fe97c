//! One alignment: matching, and the sums over the matched pairs.
//!
//! Most source points keep their partner from round to round. Each remembers where it was last sought and how far away
//! all other target points were then; as long as it has travelled less than that allows, its partner is known to be
//! the nearest point still, and no search is made.

use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

use crate::data::{Neighbour, RigidTransform};
use crate::pose::icp::method::{IcpMethod, Pair, add_difference, voxel_to_plane};
use crate::pose::icp::{GaussianVoxels, Icp, IcpStage};
use crate::pose::normal_equations::NormalEquations;
use crate::pose::{IcpTarget, RobustKernel};

/// Points per unit of parallel work; independent of the number of threads, so that sums are too.
const CHUNK: usize = 1024;

/// How far a search looks beyond the nearest point: so many times as far as the point has come since the last search,
/// which is about how far it will go until the alignment is at rest, ...
const MARGIN: f64 = 2.0;
/// ... within these shares of the largest distance of a pair.
const MARGIN_SHARES: [f64; 2] = [0.01, 0.1];

/// Guards a comparison of distances against the rounding of their square roots.
const ROUNDING: f64 = 1.0 - 1e-12;

/// What one alignment carries from round to round.
pub(super) struct Run<'a> {
    icp: &'a Icp,
    points: &'a [Point3<f64>],
    /// One per point, or none at all.
    normals: &'a [Vector3<f64>],
    target: &'a IcpTarget,
    centroid: Point3<f64>,
    spread: f64,
    /// Source points that are finite.
    pub(super) finite: usize,
    matches: Vec<Match>,
}

/// A source point under the current pose and its partner.
#[derive(Debug, Clone, Copy)]
struct Match {
    moved: Point3<f64>,
    /// Infinite if it has no partner within reach.
    squared_distance: f64,
    /// The target point or voxel it was matched with last; of points a good first guess of the next one.
    partner: u32,
    /// Where it was when its partner was last sought, ...
    searched_at: Point3<f64>,
    /// ... and a distance that no other target point was closer than then.
    clearance: f64,
}

/// Where partners are sought.
struct Search<'a> {
    target: &'a IcpTarget,
    max_distance: f64,
    spread: f64,
}

/// How many pairs were matched, and the sum of their squared distances.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Fit {
    pub(super) matched: usize,
    pub(super) squared_distance: f64,
    /// The largest squared distance that trimming lets through.
    pub(super) limit: f64,
    /// Pairs that trimming lets through.
    pub(super) kept: usize,
}

impl Match {
    const UNSOUGHT: Match = Match {
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
    fn with_point(&mut self, moved: Point3<f64>, search: &Search<'_>) {
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

    /// Takes the mean of the voxel that the point lies in, if that is closer than `max_distance`.
    fn with_voxel(&mut self, moved: Point3<f64>, voxels: &GaussianVoxels, max_distance: f64) {
        self.moved = moved;
        self.squared_distance = f64::INFINITY;
        if let Some((index, voxel)) = voxels.find(&moved) {
            let squared_distance = (voxel.mean - moved).norm_squared();
            if squared_distance < max_distance * max_distance {
                (self.partner, self.squared_distance) = (index, squared_distance);
            }
        }
    }

    fn is_kept(&self, limit: f64) -> bool {
        self.squared_distance.is_finite() && self.squared_distance <= limit
    }
}

impl<'a> Run<'a> {
    pub(super) fn new(
        icp: &'a Icp,
        points: &'a [Point3<f64>],
        normals: &'a [Vector3<f64>],
        target: &'a IcpTarget,
    ) -> Run<'a> {
        let is_finite = |point: &&Point3<f64>| point.iter().all(|value| value.is_finite());
        let finite = points.iter().filter(is_finite);
        let number = finite.clone().count();
        let count = number as f64;
        let centroid = Point3::from(finite.clone().map(|p| p.coords).sum::<Vector3<f64>>() / count);
        let square = finite.map(|p| (p - centroid).norm_squared()).sum::<f64>() / count;
        // One point, or copies of it, have no spread: any unit will do.
        let spread = if square > 0.0 { square.sqrt() } else { 1.0 };
        let matches = vec![Match::UNSOUGHT; points.len()];
        Run { icp, points, normals, target, centroid, spread, finite: number, matches }
    }

    /// The voxels, if points are matched with them.
    fn voxels(&self) -> Option<&'a GaussianVoxels> {
        self.target.voxels().filter(|_| self.icp.method == IcpMethod::VoxelisedGeneralised)
    }

    /// Matches all points under `pose` and sums up what the pairs say.
    pub(super) fn round(&mut self, pose: &RigidTransform, stage: &IcpStage) -> NormalEquations {
        match self.voxels() {
            Some(voxels) => self.match_each(pose, |found, moved| {
                found.with_voxel(moved, voxels, stage.max_distance);
            }),
            None => self.match_points(pose, stage),
        }
        let limit = self.trim_limit();
        self.sums(self.icp.method, pose, stage, limit)
    }

    /// Counts what the last round matched.
    pub(super) fn fit(&self) -> Fit {
        let limit = self.trim_limit();
        let mut fit = Fit { limit, ..Fit::default() };
        for found in self.matches.iter().filter(|found| found.squared_distance.is_finite()) {
            fit.matched += 1;
            fit.squared_distance += found.squared_distance;
            fit.kept += usize::from(found.is_kept(limit));
        }
        fit
    }

    fn match_points(&mut self, pose: &RigidTransform, stage: &IcpStage) {
        let (target, spread) = (self.target, self.spread);
        let search = Search { target, max_distance: stage.max_distance, spread };
        self.match_each(pose, |found, moved| found.with_point(moved, &search));
    }

    fn match_each(&mut self, pose: &RigidTransform, find: impl Fn(&mut Match, Point3<f64>) + Sync) {
        let chunks = self.points.par_chunks(CHUNK).zip(self.matches.par_chunks_mut(CHUNK));
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

    fn trim_limit(&self) -> f64 {
        if self.icp.trim == super::Trim::Off {
            return f64::INFINITY;
        }
        let distances = self.matches.iter().map(|found| found.squared_distance);
        let mut distances: Vec<f64> = distances.filter(|distance| distance.is_finite()).collect();
        self.icp.trim.limit(&mut distances, self.finite)
    }

    /// Sums up what the pairs at most `limit` (squared distance) apart say to `method`, chunk by chunk in fixed order.
    pub(super) fn sums(
        &self,
        method: IcpMethod,
        pose: &RigidTransform,
        stage: &IcpStage,
        limit: f64,
    ) -> NormalEquations {
        let empty = NormalEquations::new(pose.apply(&self.centroid), self.spread);
        let turned = if method.needs_source_normals() { self.normals } else { &[] };
        let adder = Adder {
            method,
            voxels: self.voxels(),
            kernel: self.icp.kernel,
            width: stage.kernel_width,
        };
        let starts = (0..self.matches.len()).into_par_iter().step_by(CHUNK);
        let sums: Vec<NormalEquations> = (self.matches.par_chunks(CHUNK))
            .zip(starts)
            .map(|(matches, start)| {
                let mut sums = empty.clone();
                for (found, index) in matches.iter().zip(start..) {
                    if found.is_kept(limit) {
                        let normal =
                            turned.get(index).map_or_else(Vector3::zeros, |n| pose.rotate(n));
                        adder.add(&mut sums, found, &normal, self.target);
                    }
                }
                sums
            })
            .collect();
        sums.iter().fold(empty, NormalEquations::merge)
    }
}

/// How a pair enters the sums.
struct Adder<'a> {
    method: IcpMethod,
    /// If partners are voxels.
    voxels: Option<&'a GaussianVoxels>,
    kernel: RobustKernel,
    width: f64,
}

impl Adder<'_> {
    #[inline]
    fn add(
        &self,
        sums: &mut NormalEquations,
        found: &Match,
        moved_normal: &Vector3<f64>,
        target: &IcpTarget,
    ) {
        let (moved, partner) = (found.moved, found.partner as usize);
        if let Some(voxel) = self.voxels.and_then(|voxels| voxels.get(partner)) {
            if self.method == IcpMethod::VoxelisedGeneralised {
                let metric = voxel_to_plane(&voxel.covariance, moved_normal);
                add_difference(sums, &moved, &voxel.mean, &metric, self.kernel, self.width);
            } else {
                let (target, target_normal) = (voxel.mean, voxel.normal);
                let pair = Pair { moved, target, moved_normal: *moved_normal, target_normal };
                self.method.add(sums, &pair, self.kernel, self.width);
            }
            return;
        }
        let pair = target.points().get(partner).zip(target.normals().get(partner));
        if let Some((&target, &target_normal)) = pair {
            let pair = Pair { moved, target, moved_normal: *moved_normal, target_normal };
            self.method.add(sums, &pair, self.kernel, self.width);
        }
    }
}
