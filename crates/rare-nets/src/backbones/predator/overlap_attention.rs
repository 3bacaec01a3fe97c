//! What each cloud has seen of the other.

use rare::Result;

use crate::Matrix;
use crate::engine::CpuBackend;
use crate::layers::{products, unit_rows};

/// Added to the temperature, so that it is never 0.
const LEAST_TEMPERATURE: f32 = 0.03;

/// For each point of both clouds the scores of the other cloud's points, weighed by how alike the features are:
/// a column for each cloud. `epsilon` is the logarithm of the temperature.
pub(super) fn cross_scores(
    cpu: &CpuBackend,
    features: &[Matrix; 2],
    scores: &[Matrix; 2],
    epsilon: f32,
) -> Result<[Matrix; 2]> {
    let mut units = features.clone();
    units.iter_mut().for_each(unit_rows);
    let [source, target] = &units;
    let temperature = epsilon.exp() + LEAST_TEMPERATURE;
    let alike = products(cpu, source, target)?;
    let [of_source, of_target] = scores;
    Ok([
        expected(&alike, of_target, temperature)?,
        expected(&alike.transposed(), of_source, temperature)?,
    ])
}

/// The mean of the scores, weighed by the softmax of each row over the temperature.
fn expected(alike: &Matrix, scores: &Matrix, temperature: f32) -> Result<Matrix> {
    let mean = |row: usize| {
        let row = alike.row(row);
        let largest = row.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        let weights = row.iter().map(|value| f64::from((value - largest) / temperature).exp());
        let (mut sum, mut total) = (0.0, 0.0);
        for (weight, &score) in weights.zip(scores.values()) {
            total += weight;
            sum += weight * f64::from(score);
        }
        (sum / total) as f32
    };
    Matrix::new(alike.rows(), 1, (0..alike.rows()).map(mean).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::Precision;

    #[test]
    fn scores_come_from_the_points_that_are_alike() {
        let cpu = CpuBackend::new(Precision::F32).unwrap();
        let source = Matrix::new(1, 2, vec![5.0, 0.0]).unwrap();
        let target = Matrix::new(2, 2, vec![1.0, 0.0, 0.0, 3.0]).unwrap();
        let scores =
            [Matrix::new(1, 1, vec![7.0]).unwrap(), Matrix::new(2, 1, vec![-2.0, 4.0]).unwrap()];
        let [of_source, of_target] = cross_scores(&cpu, &[source, target], &scores, -20.0).unwrap();
        assert!((of_source.values()[0] + 2.0).abs() < 1e-5, "{of_source:?}");
        assert_eq!(of_target.values(), [7.0, 7.0]);
    }
}
