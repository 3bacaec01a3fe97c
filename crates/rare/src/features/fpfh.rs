//! Fast point feature histograms (Rusu, Blodow and Beetz, ICRA 2009), value for value those of Open3D.
//!
//! First the histogram of every point's own angles to its neighbours (SPFH), then for every asked point the sum of its
//! neighbours' histograms over their squared distance, plus its own. Histograms are counted in whole numbers, and the
//! one angle that would need an arc tangent is sorted into its bin by signs.

use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

use crate::data::{KdTree, Neighbour, PointFeatures};
use crate::error::{Error, Result};

/// Bins per angle.
const BINS: usize = 11;

/// Values per descriptor: three angles.
const DIMENSION: usize = 3 * BINS;

/// Points per unit of parallel work; independent of the number of threads.
const CHUNK: usize = 256;

/// The upper ends, as (cosine, sine), of the five bins that lie between the middle bin's end and pi.
/// Bin `k` of the angle begins at `pi (2 k - 11) / 11`.
const UPPER_BINS: [(f64, f64); 5] = [
    (0.959_492_973_614_497_4, 0.281_732_556_841_429_67),
    (0.654_860_733_945_285_1, 0.755_749_574_354_258_3),
    (0.142_314_838_273_285_14, 0.989_821_441_880_932_7),
    (-0.415_415_013_001_886_4, 0.909_631_995_354_518_4),
    (-0.841_253_532_831_181_2, 0.540_640_817_455_597_6),
];

/// Three histograms of 11 bins, each of sum 100 (or all 0).
type Histogram = [f32; DIMENSION];

/// The 33 values of every point: [`fpfh_at`] for all of them.
///
/// # Errors
/// As [`fpfh_at`].
pub fn fpfh(
    points: &[Point3<f64>],
    normals: &[Vector3<f64>],
    tree: &KdTree,
    radius: f64,
    max_neighbours: usize,
) -> Result<PointFeatures> {
    let all: Vec<usize> = (0..points.len()).collect();
    fpfh_at(points, normals, tree, radius, max_neighbours, &all)
}

/// The 33 values (three histograms of 11 bins, each of sum 200, or 100 without neighbours) of the points at `indices`.
///
/// `normals` are unit vectors, one per point (zero where unknown), `tree` indexes the same `points` (metres). A
/// neighbourhood is the `max_neighbours` closest points, the point itself included, among those closer than `radius`.
/// The usual choice is five times the sampling distance and 100. The neighbour lists of all asked points are held
/// meanwhile, 8 bytes per neighbour.
///
/// # Errors
/// `InvalidInput` if points, normals and tree differ in number or an index is out of range.
pub fn fpfh_at(
    points: &[Point3<f64>],
    normals: &[Vector3<f64>],
    tree: &KdTree,
    radius: f64,
    max_neighbours: usize,
    indices: &[usize],
) -> Result<PointFeatures> {
    if points.len() != normals.len() || points.len() != tree.len() {
        return Err(Error::invalid(format!(
            "fpfh needs one normal per point and an index over the same points: there are {} points, {} normals and {} indexed points",
            points.len(),
            normals.len(),
            tree.len()
        )));
    }
    if let Some(index) = indices.iter().find(|&&index| index >= points.len()) {
        return Err(Error::invalid(format!(
            "fpfh was asked for point {index} of {}",
            points.len()
        )));
    }
    let surface = Surface { points, normals, tree, radius, max_neighbours };
    let lists = surface.neighbour_lists(indices);
    let simple = surface.simple_histograms(indices, &lists);
    let mut values = vec![0.0; indices.len() * DIMENSION];
    (values.par_chunks_mut(DIMENSION).with_min_len(CHUNK))
        .zip(indices.par_iter().zip(&lists))
        .for_each(|(values, (&index, list))| simple.combine(index, list, values));
    let asked = indices.iter().map(|&index| points[index]).collect();
    PointFeatures::new(asked, DIMENSION, values)
}

/// Marks points whose SPFH nobody asks for.
const NOT_NEEDED: u32 = u32::MAX;

/// A neighbour: its index and squared distance, square metres.
type Item = (u32, f32);

struct Surface<'a> {
    points: &'a [Point3<f64>],
    normals: &'a [Vector3<f64>],
    tree: &'a KdTree,
    radius: f64,
    max_neighbours: usize,
}

impl Surface<'_> {
    fn neighbour_lists(&self, indices: &[usize]) -> Vec<Box<[Item]>> {
        let search = |found: &mut Vec<Neighbour>, &index: &usize| {
            self.neighbours(index, found);
            found.iter().map(|n| (n.index as u32, n.squared_distance as f32)).collect()
        };
        indices.par_iter().with_min_len(CHUNK).map_init(Vec::new, search).collect()
    }

    fn neighbours(&self, index: usize, found: &mut Vec<Neighbour>) {
        let point = &self.points[index];
        self.tree.k_nearest_unordered(point, self.max_neighbours, self.radius, found);
    }

    /// The SPFH of every point in the neighbour lists of `indices`.
    fn simple_histograms(&self, indices: &[usize], lists: &[Box<[Item]>]) -> SimpleHistograms {
        let (needed, slots) = self.needed_points(lists);
        // The asked ones among them have a list already.
        let mut known: Vec<Option<&[Item]>> = vec![None; needed.len()];
        for (list, &index) in lists.iter().zip(indices) {
            if let Some(known) = known.get_mut(slots[index] as usize) {
                *known = Some(list);
            }
        }
        let compute = |found: &mut Vec<Neighbour>, (&index, known): (&usize, &Option<&[Item]>)| {
            if let Some(list) = known {
                return self.simple(index, list.iter().map(|&(neighbour, _)| neighbour as usize));
            }
            self.neighbours(index, found);
            self.simple(index, found.iter().map(|neighbour| neighbour.index))
        };
        let histograms = (needed.par_iter().zip(&known).with_min_len(CHUNK))
            .map_init(Vec::new, compute)
            .collect();
        SimpleHistograms { slots, histograms }
    }

    /// The points in any of the lists, ascending, and for every point its position among them (or `NOT_NEEDED`).
    fn needed_points(&self, lists: &[Box<[Item]>]) -> (Vec<usize>, Vec<u32>) {
        let mut slots = vec![NOT_NEEDED; self.points.len()];
        for &(neighbour, _) in lists.iter().flatten() {
            slots[neighbour as usize] = 0;
        }
        let mut needed = Vec::new();
        for (index, slot) in slots.iter_mut().enumerate().filter(|(_, slot)| **slot != NOT_NEEDED) {
            *slot = needed.len() as u32;
            needed.push(index);
        }
        (needed, slots)
    }

    /// The histogram of the angles between a point and its neighbours, which may include the point.
    fn simple(&self, index: usize, neighbours: impl Iterator<Item = usize>) -> Histogram {
        let (point, normal) = (&self.points[index], &self.normals[index]);
        let mut counts = [0_u32; DIMENSION];
        let mut total = 0_u32;
        for other in neighbours.filter(|&other| other != index) {
            let [f1, f2, f3] =
                pair_bins(&(self.points[other] - point), normal, &self.normals[other]);
            counts[f1] += 1;
            counts[BINS + f2] += 1;
            counts[2 * BINS + f3] += 1;
            total += 1;
        }
        let share = if total > 0 { 100.0 / total as f32 } else { 0.0 };
        counts.map(|count| count as f32 * share)
    }
}

/// The SPFH of the points that are needed.
struct SimpleHistograms {
    /// Where each point's histogram stands, or `NOT_NEEDED`.
    slots: Vec<u32>,
    histograms: Vec<Histogram>,
}

impl SimpleHistograms {
    fn of(&self, index: usize) -> Option<&Histogram> {
        self.histograms.get(*self.slots.get(index)? as usize)
    }

    /// FPFH = SPFH of the point + the sum of its neighbours' SPFH / distance^2, each third scaled to 100.
    fn combine(&self, index: usize, list: &[Item], values: &mut [f32]) {
        let mut sum = [0.0_f32; DIMENSION];
        // The point itself and copies of it, at distance 0, are passed over.
        for &(neighbour, squared_distance) in list.iter().filter(|(_, d)| *d > 0.0) {
            if let Some(histogram) = self.of(neighbour as usize) {
                let weight = 1.0 / squared_distance;
                for (sum, value) in sum.iter_mut().zip(histogram) {
                    *sum += value * weight;
                }
            }
        }
        let own = self.of(index).unwrap_or(&[0.0; DIMENSION]);
        for third in 0..3 {
            let range = third * BINS..(third + 1) * BINS;
            let total: f32 = sum[range.clone()].iter().sum();
            let scale = if total > 0.0 { 100.0 / total } else { 0.0 };
            for bin in range {
                values[bin] = sum[bin] * scale + own[bin];
            }
        }
    }
}

/// The bins of the three angles of a pair of points with normals `n1` and `n2`, `d` = second minus first point.
fn pair_bins(d: &Vector3<f64>, n1: &Vector3<f64>, n2: &Vector3<f64>) -> [usize; 3] {
    let length = d.norm();
    let (cosine_1, cosine_2) = (n1.dot(d) / length, n2.dot(d) / length);
    // The normal that leans more towards the line between the points spans the frame.
    let (d, n1, n2, f3) = if cosine_1.abs() < cosine_2.abs() {
        (-d, n2, n1, -cosine_2)
    } else {
        (*d, n1, n2, cosine_1)
    };
    let v = d.cross(n1);
    let scale = v.norm();
    if scale == 0.0 {
        return [BINS / 2; 3];
    }
    let v = v / scale;
    // f1 = atan2(w . n2, n1 . n2) with w = n1 x v; f2 = v . n2; f3 = n1 . d / |d|
    let f1 = angle_bin(n1.cross(&v).dot(n2), n1.dot(n2));
    [f1, cosine_bin(v.dot(n2)), cosine_bin(f3)]
}

/// The bin of a value in [-1, 1].
fn cosine_bin(value: f64) -> usize {
    // Casting clamps at 0 and turns a NaN into 0.
    (((value + 1.0) * 0.5 * BINS as f64) as usize).min(BINS - 1)
}

/// The bin of `atan2(y, x)` in [-pi, pi]: how many of the bins' ends the direction has passed.
fn angle_bin(y: f64, x: f64) -> usize {
    let height = y.abs();
    let passed = UPPER_BINS.iter().filter(|(cos, sin)| height * cos >= x * sin).count();
    // Also at -0, where the arc tangent jumps.
    if y.is_sign_negative() { BINS / 2 - passed } else { BINS / 2 + passed }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn signs_sort_angles_as_the_arc_tangent_does(y in -1.0..1.0_f64, x in -1.0..1.0_f64) {
            let turns = (y.atan2(x) / std::f64::consts::PI + 1.0) / 2.0 * 11.0;
            prop_assume!((turns - turns.round()).abs() > 1e-9);
            prop_assert_eq!(angle_bin(y, x), turns as usize);
        }

        #[test]
        fn a_pair_has_the_same_bins_from_both_ends(
            d in prop::array::uniform3(-1.0..1.0_f64),
            n1 in prop::array::uniform3(-1.0..1.0_f64),
            n2 in prop::array::uniform3(-1.0..1.0_f64),
        ) {
            let [d, n1, n2] = [d, n1, n2].map(Vector3::from);
            prop_assume!(n1.norm() > 0.1 && n2.norm() > 0.1);
            let (n1, n2) = (n1.normalize(), n2.normalize());
            prop_assume!((n1.dot(&d).abs() - n2.dot(&d).abs()).abs() > 1e-9);
            prop_assert_eq!(pair_bins(&d, &n1, &n2), pair_bins(&-d, &n2, &n1));
        }
    }
}
