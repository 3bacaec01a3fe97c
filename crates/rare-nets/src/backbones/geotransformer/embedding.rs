//! What superpoints know of their arrangement: the geometric structure embedding (Qin et al., CVPR 2022, section 3.2).

use rare::{Error, Result};
use rayon::prelude::*;

use super::TransformerConfig;
use super::partition::squared_distance;
use crate::Matrix;
use crate::backbones::kpconv::Point;
use crate::engine::{CpuBackend, Curve, MOST_ANGLES, PairEmbedding};
use crate::layers::{Linear, Weights};

/// The largest distance that is embedded, in `sigma_distance`: a table of it has so many rows that it takes megabytes.
const FARTHEST: f32 = 4096.0;

/// The embedding of pairs of superpoints of a cloud: sinusoids of their distance and of the angles at the first one between
/// the second and its own neighbours, each through a linear layer (equations 1 to 3).
///
/// Both layers together with their sinusoids are functions of one number, so they are tabulated.
pub(super) struct GeometricEmbedding {
    wave_numbers: Vec<f32>,
    distance: Linear,
    angle: Curve,
    sigma_distance: f32,
    angle_factor: f32,
    neighbours: usize,
}

/// What the embedding is a function of, for all pairs of superpoints of a cloud.
pub(super) struct Arrangement {
    count: usize,
    distances: Vec<f32>,
    angles: Vec<f32>,
}

impl GeometricEmbedding {
    pub(super) fn load(
        cpu: &CpuBackend,
        weights: &Weights<'_>,
        config: &TransformerConfig,
    ) -> Result<GeometricEmbedding> {
        if !(1..=MOST_ANGLES).contains(&config.angle_neighbours) {
            let count = config.angle_neighbours;
            return Err(Error::invalid(format!(
                "angles to {count} neighbours, 1 to {MOST_ANGLES} are possible"
            )));
        }
        let name = "transformer.embedding";
        let wave_numbers = weights.values(&format!("{name}.embedding.div_term"))?;
        let angle = weights.linear(cpu, &format!("{name}.proj_a"))?;
        let largest = (180.0 / config.sigma_angle) as f32;
        Ok(GeometricEmbedding {
            angle: tabulated(cpu, &angle, &wave_numbers, largest)?,
            distance: weights.linear(cpu, &format!("{name}.proj_d"))?,
            wave_numbers,
            sigma_distance: config.sigma_distance as f32,
            angle_factor: (180.0 / (config.sigma_angle * std::f64::consts::PI)) as f32,
            neighbours: config.angle_neighbours,
        })
    }

    /// Distances and angles of all pairs.
    ///
    /// # Errors
    /// `InvalidInput` if there are no more superpoints than neighbours to which angles are measured.
    pub(super) fn arrangement(&self, points: &[Point]) -> Result<Arrangement> {
        if points.len() <= self.neighbours {
            return Err(Error::invalid(format!(
                "a cloud has {} superpoints, the network needs {}: give a larger cloud, or one in the unit it was \
                 trained on (metres)",
                points.len(),
                self.neighbours + 1
            )));
        }
        let rows: Vec<_> =
            points.par_iter().enumerate().map(|(from, _)| self.row(points, from)).collect();
        let (mut distances, mut angles) = (Vec::new(), Vec::new());
        for (row_distances, row_angles) in rows {
            distances.extend(row_distances);
            angles.extend(row_angles);
        }
        Ok(Arrangement { count: points.len(), distances, angles })
    }

    /// The distances of a superpoint to all others, and for each of them the angles to its own neighbours.
    fn row(&self, points: &[Point], from: usize) -> (Vec<f32>, Vec<f32>) {
        let here = points[from];
        let distances: Vec<f32> =
            points.iter().map(|point| squared_distance(&here, point).sqrt()).collect();
        let mut order: Vec<usize> = (0..points.len()).filter(|&index| index != from).collect();
        let by_distance =
            |a: &usize, b: &usize| distances[*a].total_cmp(&distances[*b]).then(a.cmp(b));
        order.select_nth_unstable_by(self.neighbours - 1, by_distance);
        order.truncate(self.neighbours);
        order.sort_by(by_distance);
        let to = |point: &Point| [0, 1, 2].map(|axis| point[axis] - here[axis]);
        let neighbours: Vec<Point> = order.iter().map(|&index| to(&points[index])).collect();
        let angles = points.iter().flat_map(|point| {
            let there = to(point);
            neighbours
                .iter()
                .map(move |near| angle(near, &there) * self.angle_factor)
                .collect::<Vec<_>>()
        });
        let angles = angles.collect();
        (distances.into_iter().map(|distance| distance / self.sigma_distance).collect(), angles)
    }

    /// The function of the distance, for these clouds.
    ///
    /// # Errors
    /// `InvalidInput` if a cloud spans more than any that the network could have been trained on.
    pub(super) fn distances(&self, cpu: &CpuBackend, clouds: &[Arrangement; 2]) -> Result<Curve> {
        let all = clouds.iter().flat_map(|cloud| &cloud.distances);
        let largest = all.copied().fold(0.0, f32::max);
        if largest > FARTHEST {
            return Err(Error::invalid(format!(
                "superpoints are {} m apart, the network can take {} m: cut the clouds, or give them in metres",
                largest * self.sigma_distance,
                FARTHEST * self.sigma_distance
            )));
        }
        tabulated(cpu, &self.distance, &self.wave_numbers, largest)
    }

    /// The embedding of all pairs of a cloud, `count^2` rows.
    pub(super) fn of_cloud(&self, cpu: &CpuBackend, points: &[Point]) -> Result<Matrix> {
        let arrangement = self.arrangement(points)?;
        let channels = 2 * self.wave_numbers.len();
        let clouds = [arrangement, self.arrangement(points)?];
        let curve = self.distances(cpu, &clouds)?;
        let mut values = Vec::new();
        for from in 0..points.len() {
            let (distances, angles) = clouds[0].row(from);
            for (&distance, angles) in distances.iter().zip(angles.chunks_exact(self.neighbours)) {
                values.extend(self.of_pairs(&curve).of(
                    cpu.processor(),
                    distance,
                    angles,
                    channels,
                ));
            }
        }
        Ok(Matrix::from_rows(channels, values))
    }

    /// The embedding as a function of distance and angles.
    pub(super) fn of_pairs<'a>(&'a self, distance: &'a Curve) -> PairEmbedding<'a> {
        PairEmbedding { distance, angle: &self.angle }
    }
}

impl Arrangement {
    /// Number of superpoints.
    pub(super) fn count(&self) -> usize {
        self.count
    }

    /// Distances and angles of a superpoint and all others.
    pub(super) fn row(&self, from: usize) -> (&[f32], &[f32]) {
        let of = |values: &'_ [f32]| values.len() / self.count;
        let (distances, angles) = (of(&self.distances), of(&self.angles));
        (
            &self.distances[from * distances..(from + 1) * distances],
            &self.angles[from * angles..(from + 1) * angles],
        )
    }
}

/// The angle between two directions, 0 to pi; 0 if one has no length.
fn angle(a: &Point, b: &Point) -> f32 {
    let [ax, ay, az] = *a;
    let [bx, by, bz] = *b;
    let cross = [ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx];
    let sine = cross.iter().map(|value| value * value).sum::<f32>().sqrt();
    // From zero, because the angle to a negative zero is not 0 but pi.
    sine.atan2(0.0 + ax * bx + ay * by + az * bz)
}

/// A linear layer of sinusoids of a number from 0 to `largest`: sine and cosine alternate (Vaswani et al., 2017).
fn tabulated(
    cpu: &CpuBackend,
    layer: &Linear,
    wave_numbers: &[f32],
    largest: f32,
) -> Result<Curve> {
    let sinusoids = sinusoids(Curve::arguments(largest), wave_numbers);
    let values = layer.apply(cpu, &sinusoids)?;
    Ok(Curve::new(values.values(), values.columns()))
}

fn sinusoids(arguments: impl Iterator<Item = f64>, wave_numbers: &[f32]) -> Matrix {
    let mut values = Vec::new();
    for argument in arguments {
        for &wave_number in wave_numbers {
            let (sine, cosine) = (argument * f64::from(wave_number)).sin_cos();
            values.extend([sine as f32, cosine as f32]);
        }
    }
    Matrix::from_rows(2 * wave_numbers.len(), values)
}

#[cfg(test)]
mod tests {
    use rare::random::Random;

    use super::*;
    use crate::engine::Precision;

    #[test]
    fn tables_give_what_the_layers_give() {
        let cpu = CpuBackend::new(Precision::F32).unwrap();
        let channels = 64;
        let mut random = Random::new(7, 0);
        let mut numbers = |count: usize, scale: f64| -> Vec<f32> {
            (0..count).map(|_| (scale * (2.0 * random.uniform() - 1.0)) as f32).collect()
        };
        let wave_numbers: Vec<f32> = (0..channels / 2)
            .map(|c| (-2.0 * c as f64 * 10_000_f64.ln() / channels as f64).exp() as f32)
            .collect();
        let mut layer = || {
            let weight = numbers(channels * channels, (3.0 / channels as f64).sqrt());
            let bias = numbers(channels, 0.1);
            Linear::new(&cpu, Matrix::new(channels, channels, weight).unwrap(), Some(&bias))
                .unwrap()
        };
        let (distance, angle) = (layer(), layer());
        let curves = [(&distance, 30.0), (&angle, 12.0)]
            .map(|(layer, largest)| tabulated(&cpu, layer, &wave_numbers, largest).unwrap());
        let pairs = PairEmbedding { distance: &curves[0], angle: &curves[1] };
        let (mut worst, mut largest) = (0.0_f32, 0.0_f32);
        for _ in 0..200 {
            let [x, a, b, c] =
                [30.0, 12.0, 12.0, 12.0].map(|most| (most * random_unit(&mut numbers)) as f32);
            let direct = |layer: &Linear, x: f32| {
                layer.apply(&cpu, &sinusoids([f64::from(x)].into_iter(), &wave_numbers)).unwrap()
            };
            let [x_values, a_values, b_values, c_values] =
                [(&distance, x), (&angle, a), (&angle, b), (&angle, c)]
                    .map(|(layer, x)| direct(layer, x));
            let found = pairs.of(cpu.processor(), x, &[a, b, c], channels);
            for (channel, found) in found.iter().enumerate() {
                let of = |values: &Matrix| values.values()[channel];
                let expected = of(&x_values) + of(&a_values).max(of(&b_values)).max(of(&c_values));
                worst = worst.max((found - expected).abs());
                largest = largest.max(expected.abs());
            }
        }
        assert!(worst / largest < 1e-6, "{worst} of {largest}");
    }

    fn random_unit(numbers: &mut impl FnMut(usize, f64) -> Vec<f32>) -> f64 {
        f64::from(numbers(1, 1.0)[0].abs())
    }

    #[test]
    fn angles_are_those_between_directions() {
        assert!(
            (angle(&[1.0, 0.0, 0.0], &[0.0, 3.0, 0.0]) - std::f32::consts::FRAC_PI_2).abs() < 1e-6
        );
        assert!((angle(&[1.0, 0.0, 0.0], &[-2.0, 0.0, 0.0]) - std::f32::consts::PI).abs() < 1e-6);
        assert_eq!(angle(&[1.0, 0.0, 0.0], &[0.0; 3]), 0.0);
        assert_eq!(angle(&[-1.0, -2.0, -3.0], &[0.0; 3]), 0.0);
    }
}
