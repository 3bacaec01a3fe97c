//! One alignment: matching, and the sums over the matched pairs.

use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

use crate::data::RigidTransform;
use crate::pose::icp::method::{IcpMethod, Pair, add_difference, voxel_to_plane};
use crate::pose::icp::{GaussianVoxels, Icp, IcpStage};
use crate::pose::normal_equations::NormalEquations;
use crate::pose::partners::{CHUNK, Extent, Match, Search, match_each};
use crate::pose::{IcpTarget, RobustKernel};

/// What one alignment carries from round to round.
pub(super) struct Run<'a> {
    icp: &'a Icp,
    points: &'a [Point3<f64>],
    /// One per point, or none at all.
    normals: &'a [Vector3<f64>],
    target: &'a IcpTarget,
    /// Of the source.
    pub(super) extent: Extent,
    matches: Vec<Match>,
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

impl<'a> Run<'a> {
    pub(super) fn new(
        icp: &'a Icp,
        points: &'a [Point3<f64>],
        normals: &'a [Vector3<f64>],
        target: &'a IcpTarget,
    ) -> Run<'a> {
        let extent = Extent::of(points);
        let matches = vec![Match::UNSOUGHT; points.len()];
        Run { icp, points, normals, target, extent, matches }
    }

    /// The voxels, if points are matched with them.
    fn voxels(&self) -> Option<&'a GaussianVoxels> {
        self.target.voxels().filter(|_| self.icp.method == IcpMethod::VoxelisedGeneralised)
    }

    /// Matches all points under `pose` and sums up what the pairs say.
    pub(super) fn round(&mut self, pose: &RigidTransform, stage: &IcpStage) -> NormalEquations {
        match self.voxels() {
            Some(voxels) => match_each(self.points, &mut self.matches, pose, |found, moved| {
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
        let search = Search {
            target: self.target,
            max_distance: stage.max_distance,
            spread: self.extent.spread,
        };
        match_each(self.points, &mut self.matches, pose, |found, moved| {
            found.with_point(moved, &search);
        });
    }

    fn trim_limit(&self) -> f64 {
        if self.icp.trim == super::Trim::Off {
            return f64::INFINITY;
        }
        let distances = self.matches.iter().map(|found| found.squared_distance);
        let mut distances: Vec<f64> = distances.filter(|distance| distance.is_finite()).collect();
        self.icp.trim.limit(&mut distances, self.extent.finite)
    }

    /// Sums up what the pairs at most `limit` (squared distance) apart say to `method`, chunk by chunk in fixed order.
    pub(super) fn sums(
        &self,
        method: IcpMethod,
        pose: &RigidTransform,
        stage: &IcpStage,
        limit: f64,
    ) -> NormalEquations {
        let empty = NormalEquations::new(pose.apply(&self.extent.centroid), self.extent.spread);
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

impl Match {
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
