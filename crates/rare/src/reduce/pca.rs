//! Principal components of the features of two maps together (FreeReg's formula: columns of length 1, mean taken off,
//! covariance divided by their number).
//!
//! All of it is `f64`: the products are small next to the eigenvectors, and those are sensitive where two eigenvalues
//! lie close together.

use faer::linalg::matmul::matmul;
use faer::linalg::matmul::triangular::{self, BlockStructure};
use faer::{Accum, Mat, MatRef, Par, Side};

use crate::data::FeatureMap;
use crate::error::{Error, Result};

/// Directions with less than this part of the largest eigenvalue are rounding, not data.
const NEGLIGIBLE: f64 = 1e-14;

/// The feature vectors of a map as the columns of a matrix, each divided by its length. Pixels whose features are all
/// 0 are left out.
pub(super) struct Columns {
    height: usize,
    width: usize,
    /// The pixels of the columns, ascending.
    pixels: Vec<usize>,
    /// Channels x pixels.
    matrix: Mat<f64>,
}

impl Columns {
    /// Takes the columns of a map and gives each the length 1.
    pub(super) fn normalised(map: &FeatureMap) -> Result<Columns> {
        let size = map.height() * map.width();
        let mut squares = vec![0.0_f64; size];
        for channel in map.values().chunks_exact(size) {
            for (square, &value) in squares.iter_mut().zip(channel) {
                *square += f64::from(value) * f64::from(value);
            }
        }
        if let Some(pixel) = squares.iter().position(|square| !square.is_finite()) {
            return Err(Error::invalid(format!(
                "the features of pixel ({}, {}) are not finite",
                pixel % map.width(),
                pixel / map.width()
            )));
        }
        let pixels: Vec<usize> = (0..size).filter(|&pixel| squares[pixel] > 0.0).collect();
        let matrix = Mat::from_fn(map.channels(), pixels.len(), |channel, column| {
            let pixel = pixels[column];
            f64::from(map.values()[channel * size + pixel]) / squares[pixel].sqrt()
        });
        Ok(Columns { height: map.height(), width: map.width(), pixels, matrix })
    }

    /// The columns as a map again.
    pub(super) fn to_map(&self) -> Result<FeatureMap> {
        self.scatter(self.matrix.as_ref())
    }

    /// A map with the columns of `matrix` at the pixels of these columns, 0 elsewhere.
    fn scatter(&self, matrix: MatRef<'_, f64>) -> Result<FeatureMap> {
        let size = self.height * self.width;
        let mut values = vec![0.0; matrix.nrows() * size];
        for (channel, values) in values.chunks_exact_mut(size).enumerate() {
            for (column, &pixel) in self.pixels.iter().enumerate() {
                values[pixel] = matrix[(channel, column)] as f32;
            }
        }
        FeatureMap::new(matrix.nrows(), self.height, self.width, values)
    }
}

/// The principal components of the features of two maps.
#[derive(Debug, Clone, PartialEq)]
pub struct JointPca {
    mean: Vec<f64>,
    eigenvalues: Vec<f64>,
    components: Vec<f64>,
}

impl JointPca {
    /// Analyses the features of all pixels of two maps, each divided by its length; keeps `components`
    /// components, or as many as there are channels. Where there are fewer pixels than that, the last ones are 0.
    ///
    /// # Errors
    /// `InvalidInput` if the maps have different numbers of channels, features that are not finite, or if no component
    /// is to be kept.
    pub fn fit(a: &FeatureMap, b: &FeatureMap, components: usize) -> Result<JointPca> {
        JointPca::fit_columns(&Columns::normalised(a)?, &Columns::normalised(b)?, components)
    }

    /// The mean feature vector, one value per channel.
    #[must_use]
    pub fn mean(&self) -> &[f64] {
        &self.mean
    }

    /// The largest eigenvalues of the covariance, descending: as many as there are channels or pixels, whichever is
    /// fewer. All others are 0.
    #[must_use]
    pub fn eigenvalues(&self) -> &[f64] {
        &self.eigenvalues
    }

    /// The components that are kept, in the order of the eigenvalues, each of length 1 (or 0 where nothing varies) with one value per
    /// channel. The value of largest magnitude is positive, since the sign of an eigenvector is arbitrary.
    pub fn components(&self) -> impl ExactSizeIterator<Item = &[f64]> {
        self.components.chunks_exact(self.mean.len())
    }

    /// Writes the features of each pixel, divided by their length, as coordinates along the components.
    ///
    /// # Errors
    /// `InvalidInput` if the map has another number of channels than those analysed, or features that are not finite.
    pub fn project(&self, map: &FeatureMap) -> Result<FeatureMap> {
        self.project_columns(&Columns::normalised(map)?)
    }

    pub(super) fn fit_columns(a: &Columns, b: &Columns, components: usize) -> Result<JointPca> {
        check_channels(a.matrix.nrows(), b.matrix.nrows())?;
        if components == 0 {
            return Err(Error::invalid("at least one component must be kept, not 0"));
        }
        let mean = mean(a, b);
        let centred = centred(&[a, b], &mean);
        let (channels, count) = (centred.nrows(), centred.ncols());
        let (eigenvalues, vectors) = if channels > count {
            from_gram(centred.as_ref(), components)?
        } else {
            eigen(centred.as_ref(), centred.transpose(), count, components)?
        };
        let mut components = vectors;
        components.chunks_exact_mut(channels).for_each(fix_sign);
        Ok(JointPca { mean, eigenvalues, components })
    }

    pub(super) fn project_columns(&self, columns: &Columns) -> Result<FeatureMap> {
        check_channels(self.mean.len(), columns.matrix.nrows())?;
        let centred = centred(&[columns], &self.mean);
        let kept = self.components.len() / self.mean.len();
        let components = MatRef::from_row_major_slice(&self.components, kept, self.mean.len());
        let mut projected = Mat::zeros(kept, centred.ncols());
        matmul(&mut projected, Accum::Replace, components, &centred, 1.0, Par::Seq);
        columns.scatter(projected.as_ref())
    }
}

fn check_channels(a: usize, b: usize) -> Result<()> {
    if a == b {
        return Ok(());
    }
    Err(Error::invalid(format!(
        "a layer has {a} and {b} channels in the two maps: both must have the same"
    )))
}

/// The mean of all columns; 0 if there is none.
fn mean(a: &Columns, b: &Columns) -> Vec<f64> {
    let count = (a.pixels.len() + b.pixels.len()).max(1) as f64;
    let mut mean = vec![0.0; a.matrix.nrows()];
    for column in a.matrix.col_iter().chain(b.matrix.col_iter()) {
        for (mean, value) in mean.iter_mut().zip(column.iter()) {
            *mean += value;
        }
    }
    mean.iter_mut().for_each(|mean| *mean /= count);
    mean
}

/// All columns side by side, less the mean.
fn centred(columns: &[&Columns], mean: &[f64]) -> Mat<f64> {
    let count = columns.iter().map(|columns| columns.pixels.len()).sum();
    let mut centred = Mat::zeros(mean.len(), count);
    let all = columns.iter().flat_map(|columns| columns.matrix.col_iter());
    for (out, column) in centred.col_iter_mut().zip(all) {
        for ((out, value), mean) in out.iter_mut().zip(column.iter()).zip(mean) {
            *out = value - mean;
        }
    }
    centred
}

/// Eigenvalues (all, descending) and the leading `components` eigenvectors (one after the other) of
/// `left * right / count`, a symmetric matrix.
fn eigen(
    left: MatRef<'_, f64>,
    right: MatRef<'_, f64>,
    count: usize,
    components: usize,
) -> Result<(Vec<f64>, Vec<f64>)> {
    let side = left.nrows();
    let mut product = Mat::zeros(side, side);
    triangular::matmul(
        &mut product,
        BlockStructure::TriangularLower,
        Accum::Replace,
        left,
        BlockStructure::Rectangular,
        right,
        BlockStructure::Rectangular,
        1.0 / count.max(1) as f64,
        Par::Seq,
    );
    let decomposition = product.self_adjoint_eigen(Side::Lower).map_err(|_| {
        Error::Internal(format!("the eigenvalues of a {side} x {side} covariance do not converge"))
    })?;
    let eigenvalues = decomposition.S().column_vector().iter().rev().map(|value| value.max(0.0));
    let vectors = decomposition.U().col_iter().rev().take(components);
    Ok((eigenvalues.collect(), vectors.flat_map(|vector| vector.iter().copied()).collect()))
}

/// The same for the covariance `X X^T / N` of a matrix with more rows than columns, from the smaller `X^T X / N`: both
/// have the same eigenvalues, and an eigenvector `v` of the smaller one gives `X v / |X v|`.
fn from_gram(centred: MatRef<'_, f64>, components: usize) -> Result<(Vec<f64>, Vec<f64>)> {
    let count = centred.ncols();
    let (eigenvalues, vectors) = eigen(centred.transpose(), centred, count, components)?;
    let vectors = MatRef::from_column_major_slice(&vectors, count, components.min(count));
    // What goes beyond the number of columns stays 0, so that a map has as many channels as were asked for.
    let mut components = Mat::zeros(centred.nrows(), components.min(centred.nrows()));
    let varying = components.as_mut().subcols_mut(0, vectors.ncols());
    matmul(varying, Accum::Replace, centred, vectors, 1.0, Par::Seq);
    let largest = eigenvalues.first().copied().unwrap_or(0.0);
    for (component, &eigenvalue) in components.col_iter_mut().zip(&eigenvalues) {
        // Where nothing varies any more the length is rounding: such a component says nothing and is set to 0.
        let known = eigenvalue > NEGLIGIBLE * largest;
        let scale = if known { 1.0 / (count as f64 * eigenvalue).sqrt() } else { 0.0 };
        component.iter_mut().for_each(|value| *value *= scale);
    }
    let components = components.col_iter().flat_map(|component| component.iter().copied());
    Ok((eigenvalues, components.collect()))
}

/// Turns a component so that its value of largest magnitude (the first of them) is positive.
fn fix_sign(component: &mut [f64]) {
    let largest = component
        .iter()
        .fold(0.0_f64, |largest, &value| if value.abs() > largest.abs() { value } else { largest });
    if largest < 0.0 {
        component.iter_mut().for_each(|value| *value = -*value);
    }
}
