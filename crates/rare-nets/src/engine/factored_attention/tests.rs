//! Against the definition in double precision, on every processor.

use super::*;

/// Factors as a whole matrix; rows with `all` list every key.
struct Given {
    keys: usize,
    factors: Vec<f32>,
    all: bool,
}

impl Given {
    /// A share of the factors is not 0.
    fn new(queries: usize, keys: usize, share: f64, all: bool) -> Given {
        let mut random = rare::random::Random::new(3, keys as u64);
        let mut factor =
            || if random.uniform() < share { 1.0 - random.uniform() as f32 } else { 0.0 };
        Given { keys, factors: (0..queries * keys).map(|_| factor()).collect(), all }
    }
}

impl ScoreFactors for Given {
    fn rows(&self, queries: Range<usize>) -> Cow<'_, FactorRows> {
        let mut rows = FactorRows::default();
        for query in queries {
            let factors = &self.factors[query * self.keys..(query + 1) * self.keys];
            let listed = (0..).zip(factors.iter().copied());
            rows.push(listed.filter(|&(_, factor)| self.all || factor != 0.0));
        }
        Cow::Owned(rows)
    }
}

fn numbers(rows: usize, columns: usize, scale: f32, seed: u64) -> Matrix {
    let mut random = rare::random::Random::new(seed, 0);
    let values = (0..rows * columns).map(|_| scale * random.normal() as f32);
    Matrix::new(rows, columns, values.collect()).unwrap()
}

fn expected(head: &Head<'_>, given: &Given, query: usize) -> Vec<f64> {
    let row = |columns: Columns<'_>, row: usize| {
        let row = &columns.matrix.row(row)[columns.first..columns.first + head.channels];
        row.iter().map(|&value| f64::from(value)).collect::<Vec<f64>>()
    };
    let asked = row(head.queries, query);
    let score = |key: usize| {
        let product: f64 = asked.iter().zip(row(head.keys, key)).map(|(a, b)| a * b).sum();
        f64::from(given.factors[query * given.keys + key]) * product / (head.channels as f64).sqrt()
    };
    let scores: Vec<f64> = (0..given.keys).map(score).collect();
    let largest = scores.iter().copied().fold(f64::MIN, f64::max);
    let weights: Vec<f64> = scores.iter().map(|score| (score - largest).exp()).collect();
    let sum: f64 = weights.iter().sum();
    let mut mean = vec![0.0; head.channels];
    for (key, weight) in weights.iter().enumerate() {
        let values = row(head.values, key);
        mean.iter_mut().zip(values).for_each(|(mean, value)| *mean += weight / sum * value);
    }
    mean
}

/// The largest error on any processor.
fn error(channels: usize, given: &Given, scale: f32) -> f64 {
    let queries = given.factors.len() / given.keys;
    let together = numbers(queries, 2 * channels, scale, 1);
    let other = numbers(given.keys, 2 * channels, scale, 2);
    let head = Head {
        queries: Columns { matrix: &together, first: channels },
        keys: Columns { matrix: &other, first: 0 },
        values: Columns { matrix: &other, first: channels },
        channels,
    };
    let mut largest: f64 = 0.0;
    for processor in Processor::available() {
        let found = attend(processor, &head, given).unwrap();
        assert_eq!((found.rows(), found.columns()), (queries, channels));
        for query in 0..queries {
            for (found, expected) in found.row(query).iter().zip(expected(&head, given, query)) {
                largest = largest.max((f64::from(*found) - expected).abs() / f64::from(scale));
            }
        }
    }
    largest
}

#[test]
fn listed_keys_alone_give_what_all_keys_would() {
    let keys = if cfg!(miri) { 40 } else { KEYS + 37 };
    for channels in [16, 32, 64, 128] {
        for (share, all) in [(0.0, false), (0.05, false), (0.7, false), (0.7, true), (1.0, true)] {
            let given = Given::new(QUERIES + 3, keys, share, all);
            for scale in [0.3, 3.0] {
                let error = error(channels, &given, scale);
                // Measured 3.4e-6: scores of up to 60 are known to 4e-6.
                assert!(error < 1e-5, "{channels} {share} {all} {scale}: {error:e}");
            }
        }
    }
}

#[test]
fn scores_far_below_zero_lose_nothing_where_all_keys_are_listed() {
    let given = Given { keys: 21, factors: vec![1.0; 21], all: true };
    let mut head_of = numbers(21, 48, 1.0, 5);
    for row in head_of.values_mut().chunks_exact_mut(48) {
        row[..16].fill(-20.0);
        row[16..32].iter_mut().for_each(|value| *value = 20.0 + 0.01 * *value);
    }
    let columns = |first| Columns { matrix: &head_of, first };
    let asked = head_of.part(0, 1);
    let head = Head {
        queries: Columns { matrix: &asked, first: 0 },
        keys: columns(16),
        values: columns(32),
        channels: 16,
    };
    for processor in Processor::available() {
        let found = attend(processor, &head, &given).unwrap();
        for (found, expected) in found.values().iter().zip(expected(&head, &given, 0)) {
            // Scores of -1600 are known to 1e-4.
            assert!((f64::from(*found) - expected).abs() < 3e-4, "{found} {expected}");
        }
    }
}

#[test]
fn what_does_not_fit_is_refused() {
    let matrix = numbers(5, 48, 1.0, 1);
    let processor = Processor::detect().unwrap();
    let attended = |first, channels, given: &Given| {
        let columns = Columns { matrix: &matrix, first };
        let head = Head { queries: columns, keys: columns, values: columns, channels };
        attend(processor, &head, given).is_ok()
    };
    let given = Given::new(5, 5, 0.5, false);
    assert!(attended(32, 16, &given));
    assert!(!attended(33, 16, &given));
    assert!(!attended(0, 48, &given));
    assert!(!attended(0, 17, &given));
    assert!(!attended(0, 0, &given));
    assert!(!attended(0, 16, &Given::new(5, 6, 1.0, false)));
}
