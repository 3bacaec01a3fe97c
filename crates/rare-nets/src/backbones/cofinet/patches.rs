//! The fine points around each coarse one.

use rare::data::KdTree;
use rare::nalgebra::Point3;
use rayon::prelude::*;

use crate::backbones::kpconv::Point;

/// The fine points of a cloud by the coarse point that is nearest to them.
///
/// Where there are more than fit, those that come first are kept. The published code replaces some of them by others at
/// random, which cannot be repeated.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Patches {
    /// Most points of a patch.
    pub size: usize,
    /// For each coarse point indices into the fine points, ascending; no more than `size`.
    pub members: Vec<Vec<usize>>,
}

impl Patches {
    /// Gives each of the `fine` points to the nearest of the `coarse` ones.
    pub(super) fn new(fine: &[Point], coarse: &[Point], size: usize) -> Patches {
        let wide = |point: &Point| Point3::from(point.map(f64::from));
        let tree = KdTree::new(&coarse.iter().map(wide).collect::<Vec<_>>());
        let nearest = fine.par_iter().map(|point| tree.nearest(&wide(point)));
        let owners: Vec<Option<usize>> =
            nearest.map(|found| found.map(|found| found.index)).collect();
        let mut members = vec![Vec::new(); coarse.len()];
        for (index, owner) in owners.into_iter().enumerate() {
            if let Some(patch) = owner.and_then(|owner| members.get_mut(owner))
                && patch.len() < size
            {
                patch.push(index);
            }
        }
        Patches { size, members }
    }

    /// The points of a patch.
    #[must_use]
    pub fn members(&self, coarse: usize) -> &[usize] {
        self.members.get(coarse).map_or(&[], Vec::as_slice)
    }

    /// As many indices as fit into a patch: its points, then the first point of the cloud, which fills it up.
    pub(super) fn slots(&self, coarse: usize) -> impl Iterator<Item = usize> + '_ {
        let members = self.members(coarse).iter().copied();
        members.chain(std::iter::repeat(0)).take(self.size)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_go_to_the_nearest_and_patches_fill_up() {
        let fine: Vec<Point> = [0.0, 9.0, 1.0, 2.0, 8.0].map(|x| [x, 0.0, 0.0]).to_vec();
        let patches = Patches::new(&fine, &[[1.0, 0.0, 0.0], [9.0, 0.0, 0.0], [99.0, 0.0, 0.0]], 2);
        assert_eq!(patches.members, [vec![0, 2], vec![1, 4], vec![]]);
        assert_eq!(patches.slots(2).collect::<Vec<_>>(), [0, 0]);
        assert_eq!(patches.slots(1).collect::<Vec<_>>(), [1, 4]);
    }
}
