//! The normalisation of scores with slack (Yew and Lee: `RPM-Net`, CVPR 2020).

use rare::Result;

use crate::Matrix;

/// The logarithms of scores whose rows and columns sum up to 1 together with a last column and row for points without
/// partner, which are not normalised themselves. One row and one column more than `scores`, whose entries of patches'
/// filling are far below all others.
///
/// What the iterations change is a summand for each row and each column. Their exponentials are iterated, relative to the
/// largest score of each row, which the slack, 0, keeps from falling below 0: so every sum is positive and finite.
pub(super) fn with_slack(scores: &Matrix, iterations: usize) -> Result<Matrix> {
    let columns = scores.columns();
    let largest: Vec<f64> = (0..scores.rows())
        .map(|row| f64::from(scores.row(row).iter().fold(0.0, |largest: f32, &v| largest.max(v))))
        .collect();
    let mut kernel = Vec::with_capacity(scores.rows() * columns);
    for (row, largest) in largest.iter().enumerate() {
        kernel.extend(scores.row(row).iter().map(|&value| (f64::from(value) - largest).exp()));
    }
    let slack: Vec<f64> = largest.iter().map(|largest| (-largest).exp()).collect();
    let mut of_rows = vec![1.0; scores.rows()];
    let mut of_columns = vec![1.0; columns];
    for _ in 0..iterations {
        let rows = kernel.chunks_exact(columns.max(1)).zip(&slack);
        for (factor, (row, slack)) in of_rows.iter_mut().zip(rows) {
            *factor = 1.0 / (slack + inner_product(row, &of_columns));
        }
        let mut sums = vec![1.0; columns];
        for (row, factor) in kernel.chunks_exact(columns.max(1)).zip(&of_rows) {
            sums.iter_mut().zip(row).for_each(|(sum, value)| *sum += value * factor);
        }
        of_columns.iter_mut().zip(&sums).for_each(|(factor, sum)| *factor = 1.0 / sum);
    }
    let logarithms: Vec<f64> = of_columns.iter().map(|factor| factor.ln()).chain([0.0]).collect();
    let mut values = Vec::with_capacity((scores.rows() + 1) * (columns + 1));
    for (row, (largest, factor)) in largest.iter().zip(&of_rows).enumerate() {
        let summand = factor.ln() - largest;
        let entries = scores.row(row).iter().chain([&0.0]).zip(&logarithms);
        values.extend(entries.map(|(&score, other)| (f64::from(score) + summand + other) as f32));
    }
    values.extend(logarithms.iter().map(|&value| value as f32));
    Matrix::new(scores.rows() + 1, columns + 1, values)
}

/// Lanes of a sum: several at a time, always the same ones.
const LANES: usize = 8;

fn inner_product(left: &[f64], right: &[f64]) -> f64 {
    let mut lanes = [0.0; LANES];
    let (left, right) = (left.chunks_exact(LANES), right.chunks_exact(LANES));
    let rest = left.remainder().iter().zip(right.remainder()).map(|(a, b)| a * b).sum::<f64>();
    for (left, right) in left.zip(right) {
        lanes.iter_mut().zip(left.iter().zip(right)).for_each(|(lane, (a, b))| *lane += a * b);
    }
    lanes.iter().sum::<f64>() + rest
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_and_columns_sum_up_to_one() {
        let values = (0..90).map(|index| ((index * 31 % 17) as f32 - 8.0) * 3.0).collect();
        let result = with_slack(&Matrix::new(9, 10, values).unwrap(), 200).unwrap();
        assert_eq!((result.rows(), result.columns()), (10, 11));
        for row in 0..9 {
            let sum: f32 = result.row(row).iter().map(|value| value.exp()).sum();
            assert!((sum - 1.0).abs() < 1e-2, "{sum}");
        }
        for column in 0..10 {
            let sum: f32 = (0..10).map(|row| result.row(row)[column].exp()).sum();
            assert!((sum - 1.0).abs() < 1e-5, "{sum}");
        }
    }

    #[test]
    fn what_is_far_below_takes_no_part() {
        let scores = Matrix::new(2, 2, vec![3000.0, -1e6, -1e6, -1e6]).unwrap();
        let result = with_slack(&scores, 100).unwrap();
        assert!(result.values().iter().all(|value| value.is_finite()), "{result:?}");
        assert!(result.row(0)[0].exp() > 0.99 && result.row(1)[2].abs() < 1e-6, "{result:?}");
    }
}
