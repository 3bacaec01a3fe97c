//! The image that the filters work on.

use crate::error::{Error, Result};

/// One channel of `f32`, row-major.
#[derive(Debug, Clone, PartialEq)]
pub struct Image {
    width: usize,
    values: Vec<f32>,
}

impl Image {
    /// Takes `height x width` values in row-major order.
    ///
    /// # Errors
    /// `InvalidInput` if the number of values is not the number of pixels.
    pub fn new(width: usize, height: usize, values: Vec<f32>) -> Result<Image> {
        if width.checked_mul(height) != Some(values.len()) {
            return Err(Error::invalid(format!(
                "an image of {width} x {height} pixels has {} values",
                values.len()
            )));
        }
        Ok(Image { width, values })
    }

    /// Takes whole rows of `width` values each.
    pub(super) fn from_rows(width: usize, values: Vec<f32>) -> Image {
        Image { width, values }
    }

    /// Columns.
    #[must_use]
    pub fn width(&self) -> usize {
        self.width
    }

    /// Rows.
    #[must_use]
    pub fn height(&self) -> usize {
        self.values.len().checked_div(self.width).unwrap_or(0)
    }

    /// All values, row by row.
    #[must_use]
    pub fn values(&self) -> &[f32] {
        &self.values
    }

    /// All values, to be changed in place.
    pub fn values_mut(&mut self) -> &mut [f32] {
        &mut self.values
    }

    /// Gives the values away.
    #[must_use]
    pub fn into_values(self) -> Vec<f32> {
        self.values
    }

    pub(super) fn row(&self, y: usize) -> &[f32] {
        &self.values[y * self.width..(y + 1) * self.width]
    }

    /// Each value by itself.
    #[must_use]
    pub(super) fn map(mut self, change: impl Fn(f32) -> f32) -> Image {
        self.values.iter_mut().for_each(|value| *value = change(*value));
        self
    }

    /// Each value together with that of the same pixel of `other`, an image of the same size.
    #[must_use]
    pub(super) fn zip_map(mut self, other: &Image, change: impl Fn(f32, f32) -> f32) -> Image {
        for (value, &other) in self.values.iter_mut().zip(&other.values) {
            *value = change(*value, other);
        }
        self
    }

    /// Builds an image of the same size row by row: `fill(y, row)` writes row `y`.
    #[must_use]
    pub(super) fn build_rows(&self, mut fill: impl FnMut(usize, &mut [f32])) -> Image {
        let mut values = vec![0.0; self.values.len()];
        if self.width > 0 {
            values.chunks_exact_mut(self.width).enumerate().for_each(|(y, row)| fill(y, row));
        }
        Image { width: self.width, values }
    }

    /// A larger image with `margin` more pixels on each side, taken from where `source` says: it maps an index that
    /// may lie outside (first number) of a side of so many pixels (second) to one inside.
    #[must_use]
    pub(super) fn padded(&self, margin: usize, source: impl Fn(isize, usize) -> usize) -> Image {
        let (width, height) = (self.width, self.height());
        let mut values = Vec::with_capacity((width + 2 * margin) * (height + 2 * margin));
        let outside = |index: usize, side| source(index as isize - margin as isize, side);
        if !self.values.is_empty() {
            for y in 0..height + 2 * margin {
                let row = self.row(outside(y, height));
                values.extend((0..margin).map(|x| row[outside(x, width)]));
                values.extend_from_slice(row);
                values.extend((0..margin).map(|x| row[outside(margin + width + x, width)]));
            }
        }
        Image { width: width + 2 * margin, values }
    }
}
