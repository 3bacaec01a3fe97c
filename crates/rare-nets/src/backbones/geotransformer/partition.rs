//! Which points belong to which superpoint (Qin et al., CVPR 2022, section 3.1).

use rayon::prelude::*;

use crate::backbones::kpconv::Point;

/// The patches of a cloud: each point goes to its nearest superpoint, and each superpoint keeps the nearest of its own.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Partition {
    /// For each superpoint the indices of its points, the nearest first; empty if it is nearest to none.
    pub patches: Vec<Vec<u32>>,
}

impl Partition {
    /// Patches of at most `most` points; lengths in metres, of equal distances the first.
    pub(super) fn new(points: &[Point], superpoints: &[Point], most: usize) -> Partition {
        let nearest = |point: &Point| {
            let mut best = (f32::INFINITY, 0);
            for (index, superpoint) in superpoints.iter().enumerate() {
                let squared = squared_distance(point, superpoint);
                if squared < best.0 {
                    best = (squared, index);
                }
            }
            best
        };
        let owners: Vec<(f32, usize)> = points.par_iter().map(nearest).collect();
        let mut owned: Vec<Vec<(f32, u32)>> = vec![Vec::new(); superpoints.len()];
        for ((squared, owner), index) in owners.into_iter().zip(0..) {
            if let Some(points) = owned.get_mut(owner) {
                points.push((squared, index));
            }
        }
        let patch = |mut points: Vec<(f32, u32)>| {
            points.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
            points.into_iter().take(most).map(|(_, index)| index).collect()
        };
        Partition { patches: owned.into_par_iter().map(patch).collect() }
    }

    /// The superpoints that have points.
    pub(super) fn occupied(&self) -> Vec<usize> {
        let patches = self.patches.iter().enumerate();
        patches.filter(|(_, patch)| !patch.is_empty()).map(|(index, _)| index).collect()
    }
}

/// The squared distance of two points, square metres.
pub(super) fn squared_distance(a: &Point, b: &Point) -> f32 {
    let [x, y, z] = [0, 1, 2].map(|axis| a[axis] - b[axis]);
    x * x + y * y + z * z
}
