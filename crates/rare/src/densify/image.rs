//! The image that the filters work on.

use crate::error::{Error, Result};

/// One channel of `f32`, row-major.
///
/// A filter cannot work in place. An image therefore keeps the memory that its last filter read from for the next one
/// to write to: fresh memory would cost more than most filters do.
#[derive(Debug)]
pub struct Image {
    width: usize,
    values: Vec<f32>,
    spare: Vec<f32>,
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
        Ok(Image::from_rows(width, values))
    }

    /// Takes whole rows of `width` values each.
    pub(super) fn from_rows(width: usize, values: Vec<f32>) -> Image {
        Image { width, values, spare: Vec::new() }
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

    pub(super) fn row(&self, y: usize) -> &[f32] {
        &self.values[y * self.width..(y + 1) * self.width]
    }

    /// Takes the values of an image of the same size.
    pub(super) fn copy_from(&mut self, other: &Image) {
        self.values.copy_from_slice(&other.values);
    }

    /// Changes each value by itself.
    pub(super) fn map(&mut self, change: impl Fn(f32) -> f32) {
        self.values.iter_mut().for_each(|value| *value = change(*value));
    }

    /// Changes each value by itself and that of the same pixel of `other`, an image of the same size.
    pub(super) fn zip_map(&mut self, other: &Image, change: impl Fn(f32, f32) -> f32) {
        for (value, &other) in self.values.iter_mut().zip(&other.values) {
            *value = change(*value, other);
        }
    }

    /// Replaces the image row by row: `rewrite(image, y, row)` writes row `y` from the image as it was.
    pub(super) fn rewrite_rows(&mut self, mut rewrite: impl FnMut(&Image, usize, &mut [f32])) {
        let mut rows = std::mem::take(&mut self.spare);
        rows.resize(self.values.len(), 0.0);
        if self.width > 0 {
            for (y, row) in rows.chunks_exact_mut(self.width).enumerate() {
                rewrite(self, y, row);
            }
        }
        self.spare = std::mem::replace(&mut self.values, rows);
    }
}

impl Clone for Image {
    fn clone(&self) -> Image {
        Image::from_rows(self.width, self.values.clone())
    }
}
