//! Normalisations of the rows of a matrix.

use rare::{Error, Result};
use rayon::prelude::*;

use super::Activation;
use crate::Matrix;

/// Rows of a block of sums.
const BLOCK: usize = 512;
/// Added to variances.
const EPSILON: f64 = 1e-5;
/// The least norm by which a row is divided.
const LEAST_NORM: f32 = 1e-12;

/// Group normalisation (Wu and He, 2018) with one mean and variance for the channels of a group over all rows together,
/// then a factor and a summand per channel, then an activation.
///
/// # Errors
/// `Internal` if the groups do not divide the channels or the factors do not fit.
pub(crate) fn group_normalization(
    matrix: &mut Matrix,
    groups: usize,
    scale: &[f32],
    shift: &[f32],
    activation: Activation,
) -> Result<()> {
    let channels = matrix.columns();
    let divides = groups > 0 && channels.is_multiple_of(groups);
    if !divides || scale.len() != channels || shift.len() != channels {
        return Err(Error::Internal(format!("{groups} groups of {channels} channels do not fit")));
    }
    let width = channels / groups;
    let affine: Vec<(f32, f32)> = sums(matrix)
        .chunks_exact(width)
        .flat_map(|group| {
            let total = group.iter().fold(Sums::default(), |total, sums| total.plus(*sums));
            let (factor, offset) = total.standardisation(matrix.rows() * width);
            std::iter::repeat_n((factor, offset), width)
        })
        .zip(scale.iter().zip(shift))
        .map(|((factor, offset), (&scale, &shift))| {
            let (scale, shift) = (f64::from(scale), f64::from(shift));
            ((factor * scale) as f32, (offset * scale + shift) as f32)
        })
        .collect();
    apply(matrix, &affine, activation);
    Ok(())
}

/// Instance normalisation (Ulyanov et al., 2016): a mean and variance for each channel over all rows, then an activation.
pub(crate) fn instance_normalization(matrix: &mut Matrix, activation: Activation) {
    let rows = matrix.rows();
    let affine: Vec<(f32, f32)> = sums(matrix)
        .iter()
        .map(|sums| {
            let (factor, offset) = sums.standardisation(rows);
            (factor as f32, offset as f32)
        })
        .collect();
    apply(matrix, &affine, activation);
}

/// Layer normalisation (Ba, Kiros, Hinton, 2016): a mean and variance for each row, a factor and a summand per channel.
pub(crate) fn layer_normalization(matrix: &mut Matrix, scale: &[f32], shift: &[f32]) {
    let channels = matrix.columns().max(1);
    matrix.values_mut().par_chunks_mut(channels).for_each(|row| {
        let sums = row.iter().fold(Sums::default(), |sums, &value| sums.with(value));
        let (factor, offset) = sums.standardisation(channels);
        let (factor, offset) = (factor as f32, offset as f32);
        for ((value, scale), shift) in row.iter_mut().zip(scale).zip(shift) {
            *value = (*value * factor + offset) * scale + shift;
        }
    });
}

/// Divides each row by its Euclidean norm.
pub(crate) fn unit_rows(matrix: &mut Matrix) {
    let columns = matrix.columns().max(1);
    matrix.values_mut().par_chunks_mut(columns).for_each(|row| {
        let squared: f32 = row.iter().map(|value| value * value).sum();
        let norm = squared.sqrt().max(LEAST_NORM);
        row.iter_mut().for_each(|value| *value /= norm);
    });
}

/// The sum of numbers and of their squares.
#[derive(Debug, Clone, Copy, Default)]
struct Sums {
    values: f64,
    squares: f64,
}

impl Sums {
    fn with(self, value: f32) -> Sums {
        let value = f64::from(value);
        Sums { values: self.values + value, squares: self.squares + value * value }
    }

    fn plus(self, other: Sums) -> Sums {
        Sums { values: self.values + other.values, squares: self.squares + other.squares }
    }

    /// Factor and summand that give numbers of mean 0 and (biased) variance 1.
    fn standardisation(self, count: usize) -> (f64, f64) {
        let count = count.max(1) as f64;
        let mean = self.values / count;
        let variance = (self.squares / count - mean * mean).max(0.0);
        let factor = 1.0 / (variance + EPSILON).sqrt();
        (factor, -mean * factor)
    }
}

/// The sums of each column, added up in blocks of rows, one after the other.
fn sums(matrix: &Matrix) -> Vec<Sums> {
    let columns = matrix.columns().max(1);
    let blocks: Vec<Vec<Sums>> = matrix
        .values()
        .par_chunks(BLOCK * columns)
        .map(|block| {
            let mut sums = vec![Sums::default(); columns];
            for row in block.chunks_exact(columns) {
                sums.iter_mut().zip(row).for_each(|(sums, &value)| *sums = sums.with(value));
            }
            sums
        })
        .collect();
    let mut total = vec![Sums::default(); columns];
    for block in &blocks {
        total.iter_mut().zip(block).for_each(|(total, sums)| *total = total.plus(*sums));
    }
    total
}

/// Multiplies and shifts each column, then activates.
fn apply(matrix: &mut Matrix, affine: &[(f32, f32)], activation: Activation) {
    let columns = matrix.columns().max(1);
    matrix.values_mut().par_chunks_mut(columns).for_each(|row| {
        for (value, (factor, offset)) in row.iter_mut().zip(affine) {
            *value = activation.apply(*value * factor + offset);
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    fn matrix() -> Matrix {
        let values =
            (0..1200).map(|index| ((index * 37 % 101) as f32).sin() + index as f32 / 600.0);
        Matrix::new(300, 4, values.collect()).unwrap()
    }

    /// Mean and variance of some columns.
    fn moments(matrix: &Matrix, columns: std::ops::Range<usize>) -> (f64, f64) {
        let values = (0..matrix.rows()).flat_map(|row| matrix.row(row)[columns.clone()].to_vec());
        let values: Vec<f64> = values.map(f64::from).collect();
        let mean = values.iter().sum::<f64>() / values.len() as f64;
        let variance = values.iter().map(|value| (value - mean).powi(2)).sum::<f64>();
        (mean, variance / values.len() as f64)
    }

    #[test]
    fn groups_are_pooled_over_all_rows() {
        let mut matrix = matrix();
        let scale = [1.0, 1.0, 2.0, 2.0];
        let shift = [0.0, 0.0, 3.0, 3.0];
        group_normalization(&mut matrix, 2, &scale, &shift, Activation::None).unwrap();
        let (mean, variance) = moments(&matrix, 0..2);
        assert!(mean.abs() < 1e-6 && (variance - 1.0).abs() < 1e-4, "{mean} {variance}");
        let (mean, variance) = moments(&matrix, 2..4);
        assert!((mean - 3.0).abs() < 1e-6 && (variance - 4.0).abs() < 1e-3, "{mean} {variance}");
        assert!(group_normalization(&mut matrix, 3, &scale, &shift, Activation::None).is_err());
    }

    #[test]
    fn channels_are_normalised_over_rows_and_rows_over_channels() {
        let mut channels = matrix();
        instance_normalization(&mut channels, Activation::None);
        for column in 0..4 {
            let (mean, variance) = moments(&channels, column..column + 1);
            assert!(mean.abs() < 1e-6 && (variance - 1.0).abs() < 1e-4, "{mean} {variance}");
        }
        let mut rows = matrix();
        layer_normalization(&mut rows, &[1.0; 4], &[0.5; 4]);
        let mean = rows.row(7).iter().sum::<f32>() / 4.0;
        assert!((mean - 0.5).abs() < 1e-6, "{mean}");
        unit_rows(&mut rows);
        let norm: f32 = rows.row(7).iter().map(|value| value * value).sum();
        assert!((norm - 1.0).abs() < 1e-6, "{norm}");
    }

    #[test]
    fn what_is_negative_shrinks() {
        let mut matrix = Matrix::new(2, 1, vec![-1.0, 1.0]).unwrap();
        instance_normalization(&mut matrix, Activation::LeakyRelu);
        let [low, high] = matrix.values() else { panic!("two rows") };
        assert!((high - 1.0).abs() < 1e-4 && (low + 0.1).abs() < 1e-5, "{low} {high}");
    }
}
