//! Leading eigenvectors of compatibility matrices (Leordeanu and Hebert 2005: the largest consistent cluster).

/// The power iteration of the SC2-PCR family on a non-negative symmetric matrix, from a vector of ones: at most
/// `rounds` products, ended early when no element changes by more than `1e-8 + 1e-5` of itself.
///
/// `multiply(vector, product)` forms the product. The result is non-negative and has (nearly) unit length.
#[must_use]
pub fn leading_eigenvector(
    size: usize,
    rounds: usize,
    mut multiply: impl FnMut(&[f64], &mut [f64]),
) -> Vec<f64> {
    let mut vector = vec![1.0; size];
    let mut next = vec![0.0; size];
    for _ in 0..rounds {
        multiply(&vector, &mut next);
        let length = next.iter().map(|value| value * value).sum::<f64>().sqrt() + 1e-6;
        next.iter_mut().for_each(|value| *value /= length);
        let settled = (next.iter().zip(&vector))
            .all(|(new, old)| (new - old).abs() <= 1e-8 + 1e-5 * old.abs());
        std::mem::swap(&mut vector, &mut next);
        if settled {
            break;
        }
    }
    vector
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_small_matrix_gives_its_eigenvector() {
        // Eigenvalue 3 belongs to (1, 1), eigenvalue 1 to (1, -1).
        let vector = leading_eigenvector(2, 50, |v, product| {
            product.copy_from_slice(&[2.0 * v[0] + v[1], v[0] + 2.0 * v[1]]);
        });
        assert!(vector.iter().all(|value| (value - 0.5_f64.sqrt()).abs() < 1e-5), "{vector:?}");
    }
}
