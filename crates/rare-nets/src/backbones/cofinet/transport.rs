//! Optimal transport between the points of two clouds with a bin for those that have no partner (Sarlin et al.:
//! `SuperGlue`, CVPR 2020; Cuturi: Sinkhorn distances, NIPS 2013).

use rare::Result;

use crate::Matrix;

/// How likely each row of `scores` and each column belong together, 0 to 1; rows and columns may also go into a bin of
/// the score `bin`, which takes as much as all of the other side.
///
/// The iterations alternate between the factors of rows and columns instead of their logarithms. Scores are taken
/// relative to the largest of their row, so that nothing grows beyond what numbers hold.
///
/// # Errors
/// None: the result has the size of `scores`.
pub(super) fn optimal_transport(scores: &Matrix, bin: f32, iterations: usize) -> Result<Matrix> {
    let (rows, columns) = (scores.rows(), scores.columns());
    let kernel = Kernel::new(scores, bin);
    let mut columns_factors = vec![1.0; columns + 1];
    let mut row_factors = vec![1.0; rows + 1];
    for _ in 0..iterations {
        let sums = kernel.row_sums(&columns_factors);
        row_factors = factors(&sums, columns as f64);
        let sums = kernel.column_sums(&row_factors);
        columns_factors = factors(&sums, rows as f64);
    }
    let mut values = Vec::with_capacity(rows * columns);
    for (row, factor) in kernel.rows().zip(&row_factors).take(rows) {
        let pairs = row.iter().zip(&columns_factors).take(columns);
        values.extend(pairs.map(|(value, other)| (value * factor * other) as f32));
    }
    Matrix::new(rows, columns, values)
}

/// What gives all sums 1, and the last, that of the bin, `of_bin`.
fn factors(sums: &[f64], of_bin: f64) -> Vec<f64> {
    let wanted = std::iter::repeat_n(1.0, sums.len().saturating_sub(1)).chain([of_bin]);
    sums.iter().zip(wanted).map(|(sum, wanted)| wanted / sum).collect()
}

/// Exponentials of scores relative to the largest of their row; a last row and column for the bins.
struct Kernel {
    columns: usize,
    values: Vec<f64>,
}

impl Kernel {
    fn new(scores: &Matrix, bin: f32) -> Kernel {
        let columns = scores.columns() + 1;
        let mut values = Vec::with_capacity((scores.rows() + 1) * columns);
        for index in 0..scores.rows() {
            let row = scores.row(index);
            let largest = f64::from(row.iter().fold(bin, |largest, &value| largest.max(value)));
            let all = row.iter().chain([&bin]);
            values.extend(all.map(|&value| (f64::from(value) - largest).exp()));
        }
        values.resize((scores.rows() + 1) * columns, 1.0);
        Kernel { columns, values }
    }

    fn rows(&self) -> impl Iterator<Item = &[f64]> {
        self.values.chunks_exact(self.columns)
    }

    fn row_sums(&self, factors: &[f64]) -> Vec<f64> {
        let sum = |row: &[f64]| row.iter().zip(factors).map(|(value, factor)| value * factor).sum();
        self.rows().map(sum).collect()
    }

    fn column_sums(&self, factors: &[f64]) -> Vec<f64> {
        let mut sums = vec![0.0; self.columns];
        for (row, factor) in self.rows().zip(factors) {
            sums.iter_mut().zip(row).for_each(|(sum, value)| *sum += value * factor);
        }
        sums
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_and_columns_are_shared_out() {
        let scores = Matrix::new(2, 3, vec![9.0, 1.0, -300.0, 0.0, 8.0, -2.0]).unwrap();
        let shares = optimal_transport(&scores, 1.0, 100).unwrap();
        assert!(shares.row(0)[0] > 0.9 && shares.row(1)[1] > 0.9, "{shares:?}");
        assert!(shares.row(0)[2] < 1e-30);
        for index in 0..2 {
            let sum: f32 = shares.row(index).iter().sum();
            assert!(sum < 1.0, "{sum}");
        }
    }

    #[test]
    fn large_scores_stay_finite() {
        let scores = Matrix::new(2, 2, vec![1e4, -1e4, -1e4, 1e4]).unwrap();
        let shares = optimal_transport(&scores, 1.0, 100).unwrap();
        assert!(shares.values().iter().all(|share| share.is_finite()), "{shares:?}");
        assert!((shares.row(0)[0] - 1.0).abs() < 1e-3, "{shares:?}");
    }
}
