//! Functions of one number with many values, tabulated and interpolated.
//!
//! A linear layer applied to the sinusoids of a number is such a function. Where the layer would be applied to each pair
//! of points, a table of it saves nearly all of the work: four rows are combined instead of a matrix multiplied.

use super::simd::{LANES, Processor, Simd, Vectorized};

/// Heads that are computed together.
const HEADS: usize = 4;

/// Rows of a table per unit of the argument. Cubic interpolation of a sinusoid of wave number 1 errs by less than
/// `3/128 / 32^4 = 2.3e-8` of its amplitude; a power of two, so that no place is rounded.
const PER_UNIT: f32 = 32.0;

/// A tabulated function of a number that is not negative.
#[derive(Debug, Clone)]
pub(crate) struct Curve {
    /// Rows of whole vectors.
    values: Vec<[f32; LANES]>,
    vectors: usize,
    rows: usize,
}

/// Where an argument is in a table: the first of four rows, and how much each counts.
#[derive(Clone, Copy, Default)]
struct Place {
    row: usize,
    weights: [f32; 4],
}

impl Curve {
    /// The arguments for whose values [`Curve::new`] asks, if the function is wanted from 0 to `largest`.
    pub(crate) fn arguments(largest: f32) -> impl ExactSizeIterator<Item = f64> {
        let rows = Curve::rows(largest);
        (0..rows as u32).map(|row| (f64::from(row) - 1.0) / f64::from(PER_UNIT))
    }

    /// How many arguments those are.
    pub(crate) fn rows(largest: f32) -> usize {
        (largest.max(0.0) * PER_UNIT).ceil() as usize + 4
    }

    /// Takes the values at these arguments, `channels` for each.
    pub(crate) fn new(values: &[f32], channels: usize) -> Curve {
        let vectors = channels.div_ceil(LANES);
        let mut table = Vec::new();
        for row in values.chunks_exact(channels.max(1)) {
            for part in row.chunks(LANES) {
                let mut vector = [0.0; LANES];
                vector[..part.len()].copy_from_slice(part);
                table.push(vector);
            }
        }
        let rows = table.len().checked_div(vectors).unwrap_or(0);
        Curve { values: table, vectors, rows }
    }

    /// The place of an argument; beyond the table, that of its end.
    fn place(&self, argument: f32) -> Place {
        let steps = (argument * PER_UNIT).max(0.0);
        let row = (steps as usize).min(self.rows.saturating_sub(4));
        let t = (steps - row as f32).min(1.0);
        // Lagrange's polynomials through -1, 0, 1 and 2.
        let (before, after, beyond) = (t + 1.0, t - 1.0, t - 2.0);
        let weights = [
            -t * after * beyond / 6.0,
            before * after * beyond / 2.0,
            -before * t * beyond / 2.0,
            before * t * after / 6.0,
        ];
        Place { row, weights }
    }

    /// The four rows at a place.
    #[inline(always)]
    fn taps(&self, place: &Place) -> [&[[f32; LANES]]; 4] {
        [0, 1, 2, 3].map(|tap| {
            let start = (place.row + tap) * self.vectors;
            self.values.get(start..start + self.vectors).unwrap_or_default()
        })
    }
}

/// One vector of the function at a place.
#[inline(always)]
fn interpolate<S: Simd>(
    simd: S,
    taps: &[&[[f32; LANES]]; 4],
    at: usize,
    place: &Place,
) -> S::Floats {
    let mut sum = simd.mul(simd.load(&taps[0][at]), simd.splat(place.weights[0]));
    for (tap, &weight) in taps.iter().zip(&place.weights).skip(1) {
        sum = simd.mul_add(simd.load(&tap[at]), simd.splat(weight), sum);
    }
    sum
}

/// The embedding of pairs of points: a function of their distance, plus the largest of a function of several angles.
#[derive(Debug, Clone, Copy)]
pub(crate) struct PairEmbedding<'a> {
    /// The function of the distance.
    pub(crate) distance: &'a Curve,
    /// That of an angle.
    pub(crate) angle: &'a Curve,
}

impl PairEmbedding<'_> {
    /// Inner products of the embeddings of one point and all others with `queries`, one for each head: head by head, a
    /// number for each pair. Each pair has a distance and `angles.len() / distances.len()` angles, one at least.
    pub(crate) fn products(
        self,
        processor: Processor,
        distances: &[f32],
        angles: &[f32],
        queries: &[&[f32]],
    ) -> Vec<f32> {
        processor.run(Products { embedding: self, distances, angles, queries })
    }

    /// The embedding of a pair, `channels` numbers.
    pub(crate) fn of(
        self,
        processor: Processor,
        distance: f32,
        angles: &[f32],
        channels: usize,
    ) -> Vec<f32> {
        let unit = |channel: usize| {
            let mut unit = vec![0.0; channels];
            unit[channel] = 1.0;
            self.products(processor, &[distance], angles, &[&unit])
        };
        (0..channels).flat_map(unit).collect()
    }
}

struct Products<'a> {
    embedding: PairEmbedding<'a>,
    distances: &'a [f32],
    angles: &'a [f32],
    queries: &'a [&'a [f32]],
}

impl Vectorized for Products<'_> {
    type Output = Vec<f32>;

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> Vec<f32> {
        let pairs = self.distances.len();
        let mut products = vec![0.0; self.queries.len() * pairs];
        for (queries, products) in
            self.queries.chunks(HEADS).zip(products.chunks_mut((HEADS * pairs).max(1)))
        {
            let queries = self.vectors(queries);
            for pair in 0..pairs {
                let sums = self.pair(simd, pair, &queries);
                for (head, sum) in products.chunks_exact_mut(pairs).zip(sums) {
                    head[pair] = sum;
                }
            }
        }
        products
    }
}

impl Products<'_> {
    /// The queries of some heads, vector by vector.
    #[inline(always)]
    fn vectors(&self, queries: &[&[f32]]) -> Vec<[[f32; LANES]; HEADS]> {
        let mut vectors = vec![[[0.0; LANES]; HEADS]; self.embedding.distance.vectors];
        for (head, query) in queries.iter().enumerate() {
            for (vector, part) in vectors.iter_mut().zip(query.chunks(LANES)) {
                vector[head][..part.len()].copy_from_slice(part);
            }
        }
        vectors
    }

    #[inline(always)]
    fn pair<S: Simd>(
        &self,
        simd: S,
        pair: usize,
        queries: &[[[f32; LANES]; HEADS]],
    ) -> [f32; HEADS] {
        let PairEmbedding { distance, angle } = self.embedding;
        let here = distance.place(self.distances[pair]);
        let taps = distance.taps(&here);
        let count = self.angles.len() / self.distances.len().max(1);
        let mut sums = [simd.splat(0.0); HEADS];
        let angles = &self.angles[pair * count..(pair + 1) * count];
        // The first angle, and the others that may exceed it.
        let mut turned: [Place; MOST_ANGLES] = [Place::default(); MOST_ANGLES];
        let count = count.min(MOST_ANGLES);
        for (place, &argument) in turned.iter_mut().zip(angles) {
            *place = angle.place(argument);
        }
        let angle_taps: [_; MOST_ANGLES] = turned.map(|place| angle.taps(&place));
        for (at, queries) in queries.iter().enumerate() {
            let mut largest = interpolate(simd, &angle_taps[0], at, &turned[0]);
            for (taps, place) in angle_taps.iter().zip(&turned).take(count).skip(1) {
                largest = simd.max(largest, interpolate(simd, taps, at, place));
            }
            let value = simd.add(interpolate(simd, &taps, at, &here), largest);
            for (sum, query) in sums.iter_mut().zip(queries) {
                *sum = simd.mul_add(value, simd.load(query), *sum);
            }
        }
        sums.map(|sum| simd.sum(sum))
    }
}

/// Angles of a pair at most.
pub(crate) const MOST_ANGLES: usize = 3;

#[cfg(test)]
mod tests {
    use super::*;

    /// Sinusoids of wave numbers down from 1, as the networks embed.
    fn sinusoids(x: f64, channels: usize) -> Vec<f32> {
        (0..channels).map(|c| (x / 10_f64.powf(c as f64 / 20.0) + c as f64).sin() as f32).collect()
    }

    #[test]
    fn products_are_those_of_the_function_itself() {
        let channels = 40;
        let table = |largest: f32| {
            let values = Curve::arguments(largest).flat_map(|x| sinusoids(x, channels));
            Curve::new(&values.collect::<Vec<f32>>(), channels)
        };
        let (distance, angle) = (table(20.0), table(12.0));
        let embedding = PairEmbedding { distance: &distance, angle: &angle };
        let distances: Vec<f32> = (0..60).map(|index| index as f32 / 3.0).collect();
        let angles: Vec<f32> = (0..180).map(|index| (index * 37 % 181) as f32 / 15.1).collect();
        let queries: Vec<Vec<f32>> =
            (0..5).map(|head| sinusoids(f64::from(head) + 30.0, channels)).collect();
        let queries: Vec<&[f32]> = queries.iter().map(Vec::as_slice).collect();
        for processor in Processor::available() {
            let products = embedding.products(processor, &distances, &angles, &queries);
            for (head, query) in queries.iter().enumerate() {
                for pair in 0..distances.len() {
                    let direct: f64 = (0..channels)
                        .map(|c| {
                            let of = |x: f32| f64::from(sinusoids(f64::from(x), channels)[c]);
                            let turned = angles[3 * pair..3 * pair + 3].iter().map(|&x| of(x));
                            (of(distances[pair]) + turned.fold(f64::NEG_INFINITY, f64::max))
                                * f64::from(query[c])
                        })
                        .sum();
                    let found = f64::from(products[head * distances.len() + pair]);
                    assert!((found - direct).abs() < 1e-5, "{head} {pair}: {found} {direct}");
                }
            }
        }
    }
}
