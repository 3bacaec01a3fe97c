//! Thinning clouds: one centroid per occupied voxel, and how dense a cloud is.

use std::collections::{HashMap, HashSet};
use std::hash::{BuildHasherDefault, Hasher};

use nalgebra::{Point3, Vector3};

use crate::data::KdTree;
use crate::data::cloud::bounds;
use crate::error::{Error, Result};
use crate::random::Random;

/// Voxels per axis that a grid can count.
const CELLS_PER_AXIS: f64 = u32::MAX as f64;

/// How many points [`resolution`] asks for their nearest neighbour.
const RESOLUTION_SAMPLE: usize = 1000;

/// Replaces the points of every occupied voxel (edge `voxel`, metres) by their centroid.
///
/// The grid is anchored half a voxel below the lowest corner of the bounding box, as in Open3D. The centroids come in
/// the order in which their voxels first appear among `points`.
///
/// # Errors
/// `InvalidInput` if `voxel` is not a positive number, or so small that the cloud spans more than `2^32` voxels.
pub fn voxel_downsample(points: &[Point3<f64>], voxel: f64) -> Result<Vec<Point3<f64>>> {
    let grid = VoxelGrid::over(points, voxel)?;
    // The map is only asked, never iterated: its order cannot show.
    let mut slots = HashMap::<Cell, u32, BuildHasherDefault<CellHasher>>::default();
    let mut sums: Vec<(Vector3<f64>, f64)> = Vec::new();
    for point in points {
        let cell = grid.cell(point);
        let slot = *slots.entry(cell).or_insert(sums.len() as u32) as usize;
        match sums.get_mut(slot) {
            Some((sum, count)) => {
                *sum += point.coords;
                *count += 1.0;
            }
            None => sums.push((point.coords, 1.0)),
        }
    }
    Ok(sums.into_iter().map(|(sum, count)| Point3::from(sum / count)).collect())
}

/// The first point in every occupied voxel (edge `voxel`, metres): their indices, ascending. The grid is that of
/// [`voxel_downsample`].
///
/// # Errors
/// As [`voxel_downsample`].
pub(crate) fn first_of_every_voxel(points: &[Point3<f64>], voxel: f64) -> Result<Vec<usize>> {
    let grid = VoxelGrid::over(points, voxel)?;
    let mut occupied = HashSet::<Cell, BuildHasherDefault<CellHasher>>::default();
    let first = points.iter().enumerate().filter(|(_, point)| occupied.insert(grid.cell(point)));
    Ok(first.map(|(index, _)| index).collect())
}

/// The median distance of a point to its nearest neighbour, metres, over a fixed sample of 1000 points.
///
/// Copies of a point are passed over. 0 if no two different points are found.
#[must_use]
pub fn resolution(points: &[Point3<f64>]) -> f64 {
    // A few more neighbours than one, to look past copies.
    const NEIGHBOURS: usize = 8;
    let tree = KdTree::new(points);
    let mut random = Random::new(0, 0);
    let mut found = Vec::new();
    let mut distances = Vec::new();
    for i in 0..RESOLUTION_SAMPLE.min(points.len()) {
        // Every point of a small cloud, random ones of a large one.
        let index = if points.len() <= RESOLUTION_SAMPLE { i } else { random.below(points.len()) };
        tree.k_nearest_within(&points[index], NEIGHBOURS, f64::INFINITY, &mut found);
        distances.extend(found.iter().map(|n| n.squared_distance).find(|&distance| distance > 0.0));
    }
    if distances.is_empty() {
        return 0.0;
    }
    let middle = distances.len() / 2;
    distances.select_nth_unstable_by(middle, f64::total_cmp).1.sqrt()
}

/// Cubes that cover some points, anchored half an edge below their lowest corner.
#[derive(Debug, Clone, Copy)]
pub(crate) struct VoxelGrid {
    anchor: Point3<f64>,
    voxel: f64,
}

impl VoxelGrid {
    /// The grid with edges of `voxel` metres over `points`.
    ///
    /// # Errors
    /// As [`voxel_downsample`].
    pub(crate) fn over(points: &[Point3<f64>], voxel: f64) -> Result<VoxelGrid> {
        if !(voxel.is_finite() && voxel > 0.0) {
            return Err(Error::invalid(format!(
                "the voxel size is {voxel} m, it must be positive"
            )));
        }
        if points.is_empty() {
            return Ok(VoxelGrid { anchor: Point3::origin(), voxel });
        }
        let (low, high) = bounds(points);
        let extent = (high - low).amax();
        let spanned = extent / voxel;
        if spanned.is_nan() || spanned >= CELLS_PER_AXIS - 1.0 {
            return Err(Error::invalid(format!(
                "the cloud spans {extent} m, too much for voxels of {voxel} m: remove stray points or use voxels of at least {:.1e} m",
                extent / CELLS_PER_AXIS * 2.0
            )));
        }
        Ok(VoxelGrid { anchor: low - Vector3::repeat(voxel * 0.5), voxel })
    }

    /// The voxel that holds one of the points of the grid.
    pub(crate) fn cell(&self, point: &Point3<f64>) -> Cell {
        Cell::of(&((point - self.anchor) / self.voxel))
    }

    /// The voxel that holds any point; `None` outside the grid.
    pub(crate) fn cell_of_any(&self, point: &Point3<f64>) -> Option<Cell> {
        let position = (point - self.anchor) / self.voxel;
        let inside = position.iter().all(|value| (0.0..CELLS_PER_AXIS).contains(value));
        inside.then(|| Cell::of(&position))
    }
}

/// A voxel: x and y in one word, z in another.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) struct Cell(u64, u32);

impl Cell {
    /// The voxel that holds `position`, given in voxels from the anchor, each coordinate below `2^32`.
    fn of(position: &Vector3<f64>) -> Cell {
        let [x, y, z] = [position.x as u32, position.y as u32, position.z as u32];
        Cell(u64::from(x) << 32 | u64::from(y), z)
    }
}

/// A fast hash for [`Cell`]: the default one costs more than everything else here together.
#[derive(Default)]
pub(crate) struct CellHasher(u64);

impl Hasher for CellHasher {
    fn write(&mut self, bytes: &[u8]) {
        for &byte in bytes {
            self.write_u64(u64::from(byte));
        }
    }

    fn write_u32(&mut self, value: u32) {
        self.write_u64(u64::from(value));
    }

    fn write_u64(&mut self, value: u64) {
        let mixed = (self.0 ^ value).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        self.0 = mixed ^ (mixed >> 32);
    }

    fn finish(&self) -> u64 {
        // The table takes its bits from both ends.
        self.0.wrapping_mul(0xbf58_476d_1ce4_e5b9)
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn every_voxel_gives_its_centroid(
            points in prop::collection::vec(prop::array::uniform3(-3.0..3.0_f64), 1..200),
            voxel in 0.05..2.0_f64,
        ) {
            let points: Vec<Point3<f64>> = points.into_iter().map(Point3::from).collect();
            let (low, _) = bounds(&points);
            let mut cells = BTreeMap::<[i64; 3], Vec<usize>>::new();
            for (i, point) in points.iter().enumerate() {
                let cell = ((point - low) / voxel).map(|x| (x + 0.5).floor() as i64);
                cells.entry(cell.into()).or_default().push(i);
            }
            let mut expected: Vec<Vec<usize>> = cells.into_values().collect();
            expected.sort();
            let thinned = voxel_downsample(&points, voxel).unwrap();
            prop_assert_eq!(thinned.len(), expected.len());
            for (centroid, members) in thinned.iter().zip(expected) {
                let sum: Vector3<f64> = members.iter().map(|&i| points[i].coords).sum();
                prop_assert!((centroid.coords - sum / members.len() as f64).norm() < 1e-9);
            }
        }
    }

    #[test]
    fn the_first_point_of_a_voxel_stands_for_it() {
        let points = [0.9, 0.0, 1.6, 0.2, 1.4, 2.6].map(|x| Point3::new(x, 0.0, 0.0));
        // Voxels begin half a voxel below the lowest point: at -0.5, 0.5, 1.5 and 2.5.
        assert_eq!(first_of_every_voxel(&points, 1.0).unwrap(), [0, 1, 2, 5]);
        assert!(first_of_every_voxel(&[], 1.0).unwrap().is_empty());
        assert!(first_of_every_voxel(&points, 0.0).is_err());
    }

    #[test]
    fn sizes_that_make_no_sense_are_refused() {
        let points = [Point3::origin(), Point3::new(1e300, 0.0, 0.0)];
        for voxel in [0.0, -1.0, f64::NAN, f64::INFINITY, 0.1] {
            let message = voxel_downsample(&points, voxel).unwrap_err().to_string();
            assert!(message.contains("voxel"), "{message}");
        }
        assert_eq!(voxel_downsample(&[], 0.1).unwrap(), []);
        let far = [Point3::origin(), Point3::new(4e8, 0.0, 0.0)];
        assert_eq!(voxel_downsample(&far, 0.1).unwrap(), far);
    }

    #[test]
    fn the_resolution_of_a_lattice_is_its_spacing() {
        let mut points: Vec<_> = (0..60 * 60)
            .map(|i| Point3::new(f64::from(i % 60) * 0.25, f64::from(i / 60) * 0.25, 1.0))
            .collect();
        assert!((resolution(&points) - 0.25).abs() < 1e-12);
        points.extend(points.clone());
        assert!((resolution(&points) - 0.25).abs() < 1e-12);
        assert_eq!(resolution(&vec![Point3::origin(); 5000]), 0.0);
        assert_eq!(resolution(&[]), 0.0);
    }
}
