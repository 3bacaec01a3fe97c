//! Feature vectors of points: a row for each point.

use rare::{Error, Result};

/// `rows x columns` numbers, row by row.
#[derive(Debug, Clone, PartialEq)]
pub struct Matrix {
    rows: usize,
    columns: usize,
    values: Vec<f32>,
}

impl Matrix {
    /// Takes the numbers row by row.
    ///
    /// # Errors
    /// `InvalidInput` if there are not `rows * columns` of them.
    pub fn new(rows: usize, columns: usize, values: Vec<f32>) -> Result<Matrix> {
        if rows.checked_mul(columns) != Some(values.len()) {
            return Err(Error::invalid(format!(
                "{} numbers are no {rows} rows of {columns}",
                values.len()
            )));
        }
        Ok(Matrix { rows, columns, values })
    }

    /// The same number everywhere.
    #[must_use]
    pub fn filled(rows: usize, columns: usize, value: f32) -> Matrix {
        Matrix { rows, columns, values: vec![value; rows * columns] }
    }

    /// Number of rows.
    #[must_use]
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// Length of a row.
    #[must_use]
    pub fn columns(&self) -> usize {
        self.columns
    }

    /// All numbers, row by row.
    #[must_use]
    pub fn values(&self) -> &[f32] {
        &self.values
    }

    /// All numbers, row by row.
    pub fn values_mut(&mut self) -> &mut [f32] {
        &mut self.values
    }

    /// All numbers, row by row.
    #[must_use]
    pub fn into_values(self) -> Vec<f32> {
        self.values
    }

    /// A row.
    ///
    /// The caller knows that there is one, as with a slice.
    #[must_use]
    pub fn row(&self, index: usize) -> &[f32] {
        &self.values[index * self.columns..(index + 1) * self.columns]
    }

    /// So many rows from `first` on.
    pub(crate) fn part(&self, first: usize, rows: usize) -> Matrix {
        let values = self.values[first * self.columns..(first + rows) * self.columns].to_vec();
        Matrix { rows, columns: self.columns, values }
    }

    /// The rows at `indices`, in that order; an index beyond the last row, which stands for no point, gives zeros.
    pub(crate) fn gather(&self, indices: impl ExactSizeIterator<Item = usize>) -> Matrix {
        let rows = indices.len();
        let mut values = Vec::with_capacity(rows * self.columns);
        for index in indices {
            if index < self.rows {
                values.extend_from_slice(self.row(index));
            } else {
                values.resize(values.len() + self.columns, 0.0);
            }
        }
        Matrix { rows, columns: self.columns, values }
    }

    /// The rows of this matrix, then those of `below`.
    ///
    /// # Errors
    /// `Internal` if the rows differ in length.
    pub(crate) fn stacked(mut self, below: &Matrix) -> Result<Matrix> {
        if self.columns != below.columns {
            let (above, below) = (self.columns, below.columns);
            return Err(Error::Internal(format!("rows of {above} and {below} cannot be stacked")));
        }
        self.rows += below.rows;
        self.values.extend_from_slice(&below.values);
        Ok(self)
    }

    /// Each row of this matrix followed by that of `right`.
    ///
    /// # Errors
    /// `Internal` if there are not as many rows.
    pub(crate) fn beside(&self, right: &Matrix) -> Result<Matrix> {
        if self.rows != right.rows {
            let (left, right) = (self.rows, right.rows);
            return Err(Error::Internal(format!("{left} and {right} rows cannot be joined")));
        }
        let columns = self.columns + right.columns;
        let mut values = Vec::with_capacity(self.rows * columns);
        for index in 0..self.rows {
            values.extend_from_slice(self.row(index));
            values.extend_from_slice(right.row(index));
        }
        Ok(Matrix { rows: self.rows, columns, values })
    }

    /// Rows become columns.
    pub(crate) fn transposed(&self) -> Matrix {
        let mut values = Vec::with_capacity(self.values.len());
        for column in 0..self.columns {
            values.extend((0..self.rows).map(|row| self.values[row * self.columns + column]));
        }
        Matrix { rows: self.columns, columns: self.rows, values }
    }

    /// Takes rows of `columns` numbers; what does not fill a row is left out.
    pub(crate) fn from_rows(columns: usize, mut values: Vec<f32>) -> Matrix {
        let rows = values.len().checked_div(columns).unwrap_or(0);
        values.truncate(rows * columns);
        Matrix { rows, columns, values }
    }

    /// So many columns from `first` on.
    pub(crate) fn columns_from(&self, first: usize, columns: usize) -> Matrix {
        let rows = self.values.chunks_exact(self.columns.max(1));
        let values = rows.flat_map(|row| &row[first..first + columns]).copied().collect();
        Matrix { rows: self.rows, columns, values }
    }

    /// Adds another matrix, number by number.
    ///
    /// # Errors
    /// `Internal` if the sizes differ.
    pub(crate) fn add(&mut self, other: &Matrix) -> Result<()> {
        if (self.rows, self.columns) != (other.rows, other.columns) {
            return Err(Error::Internal(format!(
                "{} x {} and {} x {} numbers cannot be added",
                self.rows, self.columns, other.rows, other.columns
            )));
        }
        self.values.iter_mut().zip(&other.values).for_each(|(value, other)| *value += other);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn counting(rows: usize, columns: usize) -> Matrix {
        Matrix::new(rows, columns, (0..rows * columns).map(|value| value as f32).collect()).unwrap()
    }

    #[test]
    fn rows_are_taken_and_put_together() {
        let matrix = counting(3, 2);
        assert_eq!(matrix.part(1, 2).values(), [2.0, 3.0, 4.0, 5.0]);
        assert_eq!(matrix.gather([2, 3, 0].into_iter()).values(), [4.0, 5.0, 0.0, 0.0, 0.0, 1.0]);
        let stacked = matrix.part(2, 1).stacked(&matrix.part(0, 1)).unwrap();
        assert_eq!((stacked.rows(), stacked.values()), (2, [4.0, 5.0, 0.0, 1.0].as_slice()));
        let beside = matrix.beside(&counting(3, 1)).unwrap();
        assert_eq!(beside.values(), [0.0, 1.0, 0.0, 2.0, 3.0, 1.0, 4.0, 5.0, 2.0]);
        assert_eq!(matrix.transposed().values(), [0.0, 2.0, 4.0, 1.0, 3.0, 5.0]);
        assert_eq!(matrix.columns_from(1, 1).values(), [1.0, 3.0, 5.0]);
        assert_eq!(Matrix::from_rows(2, vec![1.0; 5]).values(), [1.0; 4]);
    }

    #[test]
    fn sizes_that_do_not_fit_are_refused() {
        assert!(Matrix::new(2, 2, vec![0.0; 3]).is_err());
        assert!(Matrix::new(usize::MAX, 2, Vec::new()).is_err());
        assert!(counting(2, 2).stacked(&counting(2, 3)).is_err());
        assert!(counting(2, 2).beside(&counting(3, 2)).is_err());
        assert!(counting(2, 2).add(&counting(2, 3)).is_err());
    }
}
