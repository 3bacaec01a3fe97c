//! Surface normals: the direction in which a point's neighbourhood varies least.

use nalgebra::{Matrix3, Point3, Vector2, Vector3};
use rayon::prelude::*;

use crate::data::{KdTree, Neighbour};

/// Points per unit of parallel work; independent of the number of threads.
const CHUNK: usize = 512;

/// The unit normals at `points`, each from at most `max_neighbours` points closer than `radius` (metres), the point
/// itself included. `tree` indexes the same `points`.
///
/// The normal is the eigenvector to the smallest eigenvalue of the neighbours' covariance; its sign is arbitrary, see
/// [`orient_towards`]. Where fewer than three neighbours are found, or all of them coincide, it is the zero vector: no
/// surface is known there, and every product with it is 0.
#[must_use]
pub fn estimate_normals(
    points: &[Point3<f64>],
    tree: &KdTree,
    radius: f64,
    max_neighbours: usize,
) -> Vec<Vector3<f64>> {
    let mut normals = vec![Vector3::zeros(); points.len()];
    normals.par_chunks_mut(CHUNK).zip(points.par_chunks(CHUNK)).for_each(|(normals, centres)| {
        let mut found = Vec::new();
        for (normal, centre) in normals.iter_mut().zip(centres) {
            tree.k_nearest_unordered(centre, max_neighbours, radius, &mut found);
            if found.len() >= 3 {
                *normal = smallest_eigenvector(&scatter(points, centre, &found));
            }
        }
    });
    normals
}

/// Turns every normal to the side of `viewpoint` (in the frame of `points`, metres): where the sensor stood.
pub fn orient_towards(
    normals: &mut [Vector3<f64>],
    points: &[Point3<f64>],
    viewpoint: &Point3<f64>,
) {
    for (normal, point) in normals.iter_mut().zip(points) {
        if normal.dot(&(viewpoint - point)) < 0.0 {
            *normal = -*normal;
        }
    }
}

/// The scatter matrix of the neighbours (their covariance times their number). Taken about `centre`, so that points
/// far from the origin keep their digits.
fn scatter(points: &[Point3<f64>], centre: &Point3<f64>, found: &[Neighbour]) -> Matrix3<f64> {
    let mut sum = Vector3::zeros();
    let (mut xx, mut xy, mut xz) = (0.0, 0.0, 0.0);
    let (mut yy, mut yz, mut zz) = (0.0, 0.0, 0.0);
    for offset in found.iter().filter_map(|n| points.get(n.index)).map(|point| point - centre) {
        sum += offset;
        xx += offset.x * offset.x;
        xy += offset.x * offset.y;
        xz += offset.x * offset.z;
        yy += offset.y * offset.y;
        yz += offset.y * offset.z;
        zz += offset.z * offset.z;
    }
    let moments = Matrix3::new(xx, xy, xz, xy, yy, yz, xz, yz, zz);
    moments - sum * sum.transpose() / found.len() as f64
}

/// A unit eigenvector to the smallest eigenvalue of a symmetric positive semi-definite matrix; zero if the matrix is.
///
/// Closed form after Eberly, A robust eigensolver for 3 x 3 symmetric matrices (2014): the eigenvector that is separated
/// best comes first, the others are sought in its orthogonal complement.
pub(crate) fn smallest_eigenvector(matrix: &Matrix3<f64>) -> Vector3<f64> {
    let scale = matrix.amax();
    if scale == 0.0 || matrix.iter().any(|value| !value.is_finite()) {
        return Vector3::zeros();
    }
    let matrix = matrix / scale;
    // The eigenvalues are mean + 2 radius cos(angle + 2 pi k / 3).
    let mean = matrix.trace() / 3.0;
    let deviator = matrix - Matrix3::from_diagonal_element(mean);
    let radius = (deviator.norm_squared() / 6.0).sqrt();
    let half_determinant = (deviator / radius).determinant() / 2.0;
    let half_determinant = if half_determinant.is_finite() { half_determinant } else { 0.0 };
    let angle = half_determinant.clamp(-1.0, 1.0).acos() / 3.0;
    if half_determinant < 0.0 {
        // The smallest eigenvalue stands apart.
        let smallest = 2.0 * radius * (angle + std::f64::consts::TAU / 3.0).cos();
        return null_direction(&shifted(&deviator, smallest));
    }
    let largest = null_direction(&shifted(&deviator, 2.0 * radius * angle.cos()));
    least_across(&matrix, &largest)
}

fn shifted(matrix: &Matrix3<f64>, eigenvalue: f64) -> Matrix3<f64> {
    matrix - Matrix3::from_diagonal_element(eigenvalue)
}

/// The direction orthogonal to the rows of a symmetric matrix of rank 2: the longest of their cross products.
fn null_direction(matrix: &Matrix3<f64>) -> Vector3<f64> {
    let [a, b, c] = [0, 1, 2].map(|i| matrix.column(i).into_owned());
    let longest = [a.cross(&b), a.cross(&c), b.cross(&c)]
        .into_iter()
        .reduce(|a, b| if b.norm_squared() > a.norm_squared() { b } else { a })
        .unwrap_or_default();
    longest.try_normalize(0.0).unwrap_or_else(Vector3::z)
}

/// The unit vector orthogonal to `axis` along which the quadratic form of `matrix` is least.
fn least_across(matrix: &Matrix3<f64>, axis: &Vector3<f64>) -> Vector3<f64> {
    // An orthonormal basis of the plane across the axis.
    let helper = if axis.x.abs() < 0.6 { Vector3::x() } else { Vector3::y() };
    let u = axis.cross(&helper).normalize();
    let v = axis.cross(&u);
    let (mu, mv) = (matrix * u, matrix * v);
    // The 2 x 2 form varies with twice the angle from u; a quarter turn from its maximum it is least.
    let double = Vector2::new(u.dot(&mu) - v.dot(&mv), 2.0 * u.dot(&mv));
    let angle = 0.5 * double.y.atan2(double.x) + std::f64::consts::FRAC_PI_2;
    (u * angle.cos() + v * angle.sin()).normalize()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn the_eigenvector_is_that_of_the_smallest_eigenvalue(
            factors in prop::array::uniform9(-1.0..1.0_f64),
            flatness in prop::array::uniform3(prop::sample::select(vec![0.0, 1e-9, 1e-4, 1.0])),
            scale in prop::sample::select(vec![1e-12, 1.0, 1e12]),
        ) {
            let basis = Matrix3::from_iterator(factors).qr().q();
            let values = Vector3::from(flatness);
            let matrix = basis * Matrix3::from_diagonal(&values) * basis.transpose() * scale;
            let normal = smallest_eigenvector(&matrix);
            if values.amax() == 0.0 {
                return Ok(());
            }
            let excess = normal.dot(&(matrix * normal)) / scale - values.min();
            prop_assert!((normal.norm() - 1.0).abs() < 1e-12, "{normal}");
            prop_assert!(excess.abs() < 1e-14 * values.amax(), "{excess}");
        }
    }

    #[test]
    fn a_tilted_plane_has_its_normal_and_sparse_places_have_none() {
        let plane = Vector3::new(1.0, 2.0, -2.0) / 3.0;
        let u = plane.cross(&Vector3::x()).normalize();
        let v = plane.cross(&u);
        let mut points: Vec<Point3<f64>> = (0..400)
            .map(|i| Point3::from(u * f64::from(i % 20) * 0.1 + v * f64::from(i / 20) * 0.1))
            .map(|point| point + Vector3::new(900.0, -300.0, 5.0))
            .collect();
        points.push(Point3::origin());
        let tree = KdTree::new(&points);
        let mut normals = estimate_normals(&points, &tree, 0.25, 30);
        let viewpoint = points[0] + plane * 7.0;
        orient_towards(&mut normals, &points, &viewpoint);
        for normal in &normals[..400] {
            assert!((normal - plane).norm() < 1e-9, "{normal}");
        }
        assert_eq!(normals[400], Vector3::zeros());
        let same = vec![Point3::new(1.0, 1.0, 1.0); 10];
        assert!(
            estimate_normals(&same, &KdTree::new(&same), 1.0, 30).iter().all(|n| n.norm() == 0.0)
        );
    }

    #[test]
    fn a_point_off_its_surface_takes_the_normal_of_the_surface() {
        let mut points: Vec<Point3<f64>> = (0..441)
            .map(|i| Point3::new(f64::from(i % 21 - 10), f64::from(i / 21 - 10), 0.0) * 0.02)
            .collect();
        points.push(Point3::new(0.0, 0.0, 0.15));
        let normals = estimate_normals(&points, &KdTree::new(&points), 0.25, 1000);
        assert!(normals[441].z.abs() > 0.999, "{}", normals[441]);
    }
}
