//! Which correspondences can be right together: a rigid motion keeps the distance between any two points.
//!
//! For the pairs `(p_i, q_i)` let `D_ij = | |p_i - p_j| - |q_i - q_j| |`. Distances are computed in `f32` about the
//! centroid (millimetres of kilometres), row by row, and kept only as bits `D_ij < threshold`: `N^2 / 8` bytes instead
//! of the `4 N^2` of a float matrix.

use nalgebra::{Point3, Vector3};

use crate::data::Correspondence;

const WORD: usize = u64::BITS as usize;

/// Coordinates, column by column, about their centroid.
#[derive(Debug, Clone)]
struct Columns {
    x: Vec<f32>,
    y: Vec<f32>,
    z: Vec<f32>,
}

impl Columns {
    fn new(pairs: &[Correspondence], point: fn(&Correspondence) -> Point3<f64>) -> Columns {
        let sum: Vector3<f64> = pairs.iter().map(|pair| point(pair).coords).sum();
        let centroid = sum / pairs.len().max(1) as f64;
        let column = |axis: usize| {
            pairs.iter().map(|pair| (point(pair)[axis] - centroid[axis]) as f32).collect()
        };
        Columns { x: column(0), y: column(1), z: column(2) }
    }

    fn distance(&self, i: usize, j: usize) -> f32 {
        let (x, y, z) = (self.x[i] - self.x[j], self.y[i] - self.y[j], self.z[i] - self.z[j]);
        (x * x + y * y + z * z).sqrt()
    }
}

/// The pairwise length differences of a set of correspondences.
#[derive(Debug, Clone)]
pub struct Consistency {
    source: Columns,
    target: Columns,
}

impl Consistency {
    /// Takes the points of `pairs`; nothing quadratic is computed yet.
    #[must_use]
    pub fn new(pairs: &[Correspondence]) -> Consistency {
        Consistency {
            source: Columns::new(pairs, |pair| pair.source),
            target: Columns::new(pairs, |pair| pair.target),
        }
    }

    /// Number of correspondences.
    #[must_use]
    pub fn len(&self) -> usize {
        self.source.x.len()
    }

    /// Whether there is no correspondence.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.source.x.is_empty()
    }

    /// `D_ij`, metres.
    #[must_use]
    pub fn difference(&self, i: usize, j: usize) -> f32 {
        (self.source.distance(i, j) - self.target.distance(i, j)).abs()
    }

    /// The soft compatibility `max(0, 1 - D_ij^2 / threshold^2)`.
    #[must_use]
    pub fn soft(&self, i: usize, j: usize, threshold: f64) -> f32 {
        soft(self.difference(i, j), threshold as f32)
    }

    /// `D_ij` for `j = first, first + 1, ...`, as many as `row` has room for: the caller knows that there are so many.
    pub fn differences(&self, i: usize, first: usize, row: &mut [f32]) {
        let end = first + row.len();
        let columns = |columns: &Columns| (columns.x[i], columns.y[i], columns.z[i]);
        let (px, py, pz) = columns(&self.source);
        let (qx, qy, qz) = columns(&self.target);
        let source = (self.source.x[first..end].iter())
            .zip(&self.source.y[first..end])
            .zip(&self.source.z[first..end]);
        let target = (self.target.x[first..end].iter())
            .zip(&self.target.y[first..end])
            .zip(&self.target.z[first..end]);
        for ((difference, ((sx, sy), sz)), ((tx, ty), tz)) in row.iter_mut().zip(source).zip(target)
        {
            let (sx, sy, sz) = (px - sx, py - sy, pz - sz);
            let (tx, ty, tz) = (qx - tx, qy - ty, qz - tz);
            *difference =
                ((sx * sx + sy * sy + sz * sz).sqrt() - (tx * tx + ty * ty + tz * tz).sqrt()).abs();
        }
    }

    /// The graphs that join correspondences with `D_ij < threshold` (metres), one for each threshold. Every
    /// correspondence is joined to itself.
    #[must_use]
    pub fn graphs<const COUNT: usize>(
        &self,
        thresholds: [f64; COUNT],
    ) -> [CompatibilityGraph; COUNT] {
        let size = self.len();
        let mut graphs = thresholds.map(|_| CompatibilityGraph::empty(size));
        let mut row = vec![0.0; size];
        for i in 0..size {
            // The upper triangle, from the word that holds the diagonal on.
            let first = i / WORD * WORD;
            let row = &mut row[first..];
            self.differences(i, first, row);
            for (graph, threshold) in graphs.iter_mut().zip(thresholds) {
                graph.set_row(i, first / WORD, row, threshold as f32);
            }
        }
        graphs.iter_mut().for_each(CompatibilityGraph::mirror);
        graphs
    }
}

fn soft(difference: f32, threshold: f32) -> f32 {
    let ratio = difference / threshold;
    (1.0 - ratio * ratio).max(0.0)
}

/// A symmetric graph over correspondences as a matrix of bits.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CompatibilityGraph {
    size: usize,
    /// Words per row.
    stride: usize,
    bits: Vec<u64>,
}

impl CompatibilityGraph {
    fn empty(size: usize) -> CompatibilityGraph {
        let stride = size.div_ceil(WORD);
        CompatibilityGraph { size, stride, bits: vec![0; size * stride] }
    }

    /// Number of correspondences.
    #[must_use]
    pub fn len(&self) -> usize {
        self.size
    }

    /// Whether there is no correspondence.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.size == 0
    }

    /// The neighbours of `i` as a bit set (empty if there is no `i`).
    #[must_use]
    pub fn row(&self, i: usize) -> &[u64] {
        self.bits.get(i * self.stride..(i + 1) * self.stride).unwrap_or(&[])
    }

    /// Whether `i` and `j` are joined.
    pub(super) fn contains(&self, i: usize, j: usize) -> bool {
        self.row(i).get(j / WORD).is_some_and(|word| word >> (j % WORD) & 1 == 1)
    }

    /// The neighbours of `i`, ascending, `i` among them.
    pub fn neighbours(&self, i: usize) -> impl Iterator<Item = usize> + '_ {
        ones(self.row(i))
    }

    /// Number of neighbours of `i`, `i` not among them.
    #[must_use]
    pub fn degree(&self, i: usize) -> u32 {
        self.row(i).iter().map(|word| word.count_ones()).sum::<u32>().saturating_sub(1)
    }

    /// How many neighbours `i` and `j` share.
    #[must_use]
    pub fn common(&self, i: usize, j: usize) -> u32 {
        self.row(i).iter().zip(self.row(j)).map(|(a, b)| (a & b).count_ones()).sum()
    }

    fn set_row(&mut self, i: usize, first_word: usize, differences: &[f32], threshold: f32) {
        let row = &mut self.bits[i * self.stride..(i + 1) * self.stride];
        for (word, differences) in row[first_word..].iter_mut().zip(differences.chunks(WORD)) {
            for (bit, &difference) in differences.iter().enumerate() {
                *word |= u64::from(difference < threshold) << bit;
            }
        }
    }

    /// Copies the upper triangle to the lower one.
    fn mirror(&mut self) {
        for i in 0..self.size {
            let (word, bit) = (i / WORD, 1 << (i % WORD));
            for w in word..self.stride {
                for j in ones_of_word(self.bits[i * self.stride + w]).map(|b| w * WORD + b) {
                    self.bits[j * self.stride + word] |= bit;
                }
            }
        }
    }
}

/// The positions of the set bits, ascending.
pub(super) fn ones(words: &[u64]) -> impl Iterator<Item = usize> + '_ {
    words.iter().enumerate().flat_map(|(w, &word)| ones_of_word(word).map(move |b| w * WORD + b))
}

fn ones_of_word(mut word: u64) -> impl Iterator<Item = usize> {
    std::iter::from_fn(move || {
        let bit = word.trailing_zeros() as usize;
        let any = word != 0;
        word &= word.wrapping_sub(1);
        any.then_some(bit)
    })
}

/// The soft compatibilities of the joined pairs alone, for products with vectors.
///
/// Only the values above the diagonal are kept, in the order of the graph's bits: at most `2 N^2` bytes for a set in
/// which everything agrees, a tenth of that for a usual one.
#[derive(Debug, Clone)]
pub(super) struct SoftMatrix<'a> {
    graph: &'a CompatibilityGraph,
    upper: Vec<f32>,
}

impl SoftMatrix<'_> {
    /// `max(0, 1 - D_ij^2 / threshold^2)` where `graph`, made with the same threshold, joins; 1 on the diagonal.
    pub(super) fn new<'a>(
        consistency: &Consistency,
        graph: &'a CompatibilityGraph,
        threshold: f64,
    ) -> SoftMatrix<'a> {
        let size = graph.len();
        let joined: usize = (0..size).map(|i| graph.neighbours_after(i).count()).sum();
        let mut upper = Vec::with_capacity(joined);
        let mut row = vec![0.0; size];
        for i in 0..size {
            // A whole row at once is faster than its few joined pairs one by one.
            let row = &mut row[i..];
            consistency.differences(i, i, row);
            upper.extend(graph.neighbours_after(i).map(|j| soft(row[j - i], threshold as f32)));
        }
        SoftMatrix { graph, upper }
    }

    /// `product = S vector`.
    pub(super) fn multiply(&self, vector: &[f64], product: &mut [f64]) {
        // The diagonal is 1.
        product.copy_from_slice(vector);
        let mut values = self.upper.iter();
        for i in 0..self.graph.len() {
            let mut sum = 0.0;
            // The values come second: the iterator that ends must not take one of the next row.
            for (j, &value) in self.graph.neighbours_after(i).zip(values.by_ref()) {
                sum += f64::from(value) * vector[j];
                product[j] += f64::from(value) * vector[i];
            }
            product[i] += sum;
        }
    }
}

impl CompatibilityGraph {
    /// The neighbours of `i` with a higher index, ascending.
    fn neighbours_after(&self, i: usize) -> impl Iterator<Item = usize> + '_ {
        let (word, bit) = (i / WORD, i % WORD);
        let row = self.row(i);
        // Bits above `bit`, shifted in two steps because a shift by the word's length is none.
        let first = row.get(word).map_or(0, |&bits| bits & (u64::MAX << bit << 1));
        let rest = row.get(word + 1..).unwrap_or(&[]);
        ones_of_word(first)
            .map(move |b| word * WORD + b)
            .chain(ones(rest).map(move |b| (word + 1) * WORD + b))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Random;

    fn random_pairs(count: usize) -> Vec<Correspondence> {
        let mut random = Random::new(11, 0);
        let mut point = || Point3::from([0; 3].map(|_| 5000.0 + random.normal()));
        (0..count)
            .map(|_| Correspondence { source: point(), target: point(), score: 1.0 })
            .collect()
    }

    #[test]
    fn bits_and_products_agree_with_the_definition() {
        for count in [0, 1, 3, 63, 64, 65, 200] {
            let pairs = random_pairs(count);
            let difference = |i: usize, j: usize| {
                ((pairs[i].source - pairs[j].source).norm()
                    - (pairs[i].target - pairs[j].target).norm())
                .abs()
            };
            let consistency = Consistency::new(&pairs);
            let [loose, tight] = consistency.graphs([0.8, 0.4]);
            let vector: Vec<f64> = (0..count).map(|i| 1.0 + i as f64).collect();
            let mut product = vec![0.0; count];
            SoftMatrix::new(&consistency, &loose, 0.8).multiply(&vector, &mut product);
            for (i, product) in product.into_iter().enumerate() {
                let joined = |threshold| (0..count).filter(move |&j| difference(i, j) < threshold);
                assert!(loose.neighbours(i).eq(joined(0.8)));
                assert!(tight.neighbours(i).eq(joined(0.4)));
                assert_eq!(tight.degree(i) as usize, joined(0.4).count() - 1);
                let shared = joined(0.4).filter(|&j| difference(0, j) < 0.4).count();
                assert_eq!(tight.common(0, i) as usize, shared);
                let soft = |j| (1.0 - (difference(i, j) / 0.8_f64).powi(2)).max(0.0);
                let expected: f64 = (0..count).map(|j| soft(j) * vector[j]).sum();
                assert!((product - expected).abs() < 1e-5 * expected, "{product} {expected}");
            }
        }
    }
}
