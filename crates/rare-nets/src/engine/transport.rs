//! Optimal transport between two sets with a dustbin each (Sinkhorn, 1967; Cuturi, 2013; Sarlin et al., `SuperGlue`, CVPR
//! 2020), in the logarithmic domain.

use super::math::exp2;
use super::simd::{LANES, Processor, Simd, Vectorized};
use crate::Matrix;

/// The score of columns that only fill up vectors.
const UNSEEN: f32 = -1e30;

/// The logarithms of the transport plan of `scores`, `m x n`, with a row and a column more for what finds no partner,
/// whose scores are `dustbin`: `(m + 1) x (n + 1)`. Every row and column carries 1, the dustbins as much as the other side
/// has rows or columns.
pub(crate) fn log_transport(
    processor: Processor,
    scores: &Matrix,
    dustbin: f32,
    iterations: usize,
) -> Matrix {
    processor.run(Transport { scores, dustbin, iterations })
}

struct Transport<'a> {
    scores: &'a Matrix,
    dustbin: f32,
    iterations: usize,
}

/// Scores as powers of two, and what is added to their rows and columns.
struct Plan {
    /// Rows of whole vectors.
    scores: Vec<[f32; LANES]>,
    vectors: usize,
    rows: Vec<f32>,
    columns: Vec<[f32; LANES]>,
}

impl Vectorized for Transport<'_> {
    type Output = Matrix;

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> Matrix {
        let (m, n) = (self.scores.rows(), self.scores.columns());
        let share = -((m + n).max(1) as f32).log2();
        let bin = |others: usize| (others.max(1) as f32).log2() + share;
        let (row_bin, column_bin) = (bin(n), bin(m));
        let mut plan = self.plan();
        for _ in 0..self.iterations {
            for row in 0..=m {
                let target = if row < m { share } else { row_bin };
                plan.rows[row] = target - plan.row(simd, row);
            }
            plan.balance_columns(simd, [share, column_bin], n);
        }
        let ln_2 = std::f32::consts::LN_2;
        let mut values = Vec::with_capacity((m + 1) * (n + 1));
        for row in 0..=m {
            let scores = plan.scores[row * plan.vectors..(row + 1) * plan.vectors].as_flattened();
            let columns = plan.columns.as_flattened();
            let sums = scores.iter().zip(columns).take(n + 1);
            values.extend(
                sums.map(|(score, column)| (score + plan.rows[row] + column - share) * ln_2),
            );
        }
        Matrix::from_rows(n + 1, values)
    }
}

impl Transport<'_> {
    fn plan(&self) -> Plan {
        let (m, n) = (self.scores.rows(), self.scores.columns());
        let vectors = (n + 1).div_ceil(LANES);
        let mut scores = vec![[UNSEEN; LANES]; (m + 1) * vectors];
        for (row, scores) in scores.as_flattened_mut().chunks_exact_mut(vectors * LANES).enumerate()
        {
            let log2 = |score: f32| score * std::f32::consts::LOG2_E;
            scores[..=n].fill(log2(self.dustbin));
            if row < m {
                let pairs = scores.iter_mut().zip(self.scores.row(row));
                pairs.for_each(|(score, &given)| *score = log2(given));
            }
        }
        Plan { scores, vectors, rows: vec![0.0; m + 1], columns: vec![[0.0; LANES]; vectors] }
    }
}

impl Plan {
    /// The logarithm of the sum of a row.
    #[inline(always)]
    fn row<S: Simd>(&self, simd: S, row: usize) -> f32 {
        let scores = &self.scores[row * self.vectors..(row + 1) * self.vectors];
        let entries =
            || scores.iter().zip(&self.columns).map(|(a, b)| simd.add(simd.load(a), simd.load(b)));
        let largest = entries().fold(simd.splat(UNSEEN), |a, b| simd.max(a, b));
        let largest = simd.maximum(largest);
        let shift = simd.splat(largest);
        let sum = entries()
            .fold(simd.splat(0.0), |sum, entry| simd.add(sum, exp2(simd, simd.sub(entry, shift))));
        largest + simd.sum(sum).log2()
    }

    /// Gives every column its target: the first for the `n` columns, the second for the dustbin.
    #[inline(always)]
    fn balance_columns<S: Simd>(&mut self, simd: S, [share, bin]: [f32; 2], n: usize) {
        for at in 0..self.vectors {
            let entries = || {
                let column = self.scores.iter().skip(at).step_by(self.vectors);
                column
                    .zip(&self.rows)
                    .map(|(score, &row)| simd.add(simd.load(score), simd.splat(row)))
            };
            let largest = entries().fold(simd.splat(UNSEEN), |a, b| simd.max(a, b));
            let sum = entries().fold(simd.splat(0.0), |sum, entry| {
                simd.add(sum, exp2(simd, simd.sub(entry, largest)))
            });
            let (mut largest_lanes, mut sums) = ([0.0; LANES], [0.0; LANES]);
            simd.store(largest, &mut largest_lanes);
            simd.store(sum, &mut sums);
            for (lane, value) in self.columns[at].iter_mut().enumerate() {
                let column = at * LANES + lane;
                // What only fills up vectors stays out of sight.
                *value = match column.cmp(&n) {
                    std::cmp::Ordering::Less => share - largest_lanes[lane] - sums[lane].log2(),
                    std::cmp::Ordering::Equal => bin - largest_lanes[lane] - sums[lane].log2(),
                    std::cmp::Ordering::Greater => 0.0,
                };
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The same in double precision, as it is written down.
    fn reference(scores: &Matrix, dustbin: f64, iterations: usize) -> Vec<f64> {
        let (m, n) = (scores.rows(), scores.columns());
        let score = |i: usize, j: usize| {
            if i < m && j < n { f64::from(scores.row(i)[j]) } else { dustbin }
        };
        let norm = -((m + n) as f64).ln();
        let mu = |i: usize| if i < m { norm } else { (n as f64).ln() + norm };
        let nu = |j: usize| if j < n { norm } else { (m as f64).ln() + norm };
        let (mut u, mut v) = (vec![0.0; m + 1], vec![0.0; n + 1]);
        for _ in 0..iterations {
            for (i, u) in u.iter_mut().enumerate() {
                *u = mu(i) - (0..=n).map(|j| (score(i, j) + v[j]).exp()).sum::<f64>().ln();
            }
            for (j, v) in v.iter_mut().enumerate() {
                *v = nu(j) - (0..=m).map(|i| (score(i, j) + u[i]).exp()).sum::<f64>().ln();
            }
        }
        let value = |at: usize| {
            let (i, j) = (at / (n + 1), at % (n + 1));
            score(i, j) + u[i] + v[j] - norm
        };
        (0..(m + 1) * (n + 1)).map(value).collect()
    }

    #[test]
    fn plans_are_those_of_the_definition() {
        for (m, n) in [(1, 1), (5, 31), (17, 16), (33, 7)] {
            let values = (0..m * n).map(|at| ((at * 37 % 101) as f32 / 8.0).sin() * 12.0);
            let scores = Matrix::new(m, n, values.collect()).unwrap();
            let expected = reference(&scores, 1.0, 100);
            for processor in Processor::available() {
                let plan = log_transport(processor, &scores, 1.0, 100);
                assert_eq!([plan.rows(), plan.columns()], [m + 1, n + 1]);
                for (found, expected) in plan.values().iter().zip(&expected) {
                    assert!((f64::from(*found) - expected).abs() < 1e-4, "{found} {expected}");
                }
            }
        }
    }
}
