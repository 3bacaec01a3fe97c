//! Against the definition in double precision, on every processor.

use std::borrow::Cow;
use std::ops::Range;
use std::sync::Arc;

use super::super::arena::Arena;
use super::rows::KEYS;
use super::*;

fn aligned(source: Columns<'_>, columns: usize) -> AlignedRows {
    AlignedRows::copy(&Arc::new(Arena::default()), source, columns).unwrap()
}

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
    let wide = |row: &[f32]| row.iter().map(|&value| f64::from(value)).collect::<Vec<f64>>();
    let channels = head.keys.columns();
    let asked = wide(&head.queries.matrix.row(query)[head.queries.first..][..channels]);
    let score = |key: usize| {
        let product: f64 = asked.iter().zip(wide(head.keys.row(key))).map(|(a, b)| a * b).sum();
        f64::from(given.factors[query * given.keys + key]) * product / (channels as f64).sqrt()
    };
    let scores: Vec<f64> = (0..given.keys).map(score).collect();
    let largest = scores.iter().copied().fold(f64::MIN, f64::max);
    let weights: Vec<f64> = scores.iter().map(|score| (score - largest).exp()).collect();
    let sum: f64 = weights.iter().sum();
    let mut mean = vec![0.0; channels];
    for (key, weight) in weights.iter().enumerate() {
        let values = wide(head.values.row(key));
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
        keys: &aligned(Columns::all(&other), channels),
        values: &aligned(Columns { matrix: &other, first: channels }, channels),
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
    let columns = |first| aligned(Columns { matrix: &head_of, first }, 16);
    let asked = head_of.part(0, 1);
    let head = Head { queries: Columns::all(&asked), keys: &columns(16), values: &columns(32) };
    for processor in Processor::available() {
        let found = attend(processor, &head, &given).unwrap();
        for (found, expected) in found.values().iter().zip(expected(&head, &given, 0)) {
            // Scores of -1600 are known to 1e-4.
            assert!((f64::from(*found) - expected).abs() < 3e-4, "{found} {expected}");
        }
    }
}

#[test]
fn products_are_those_of_the_listed_rows() {
    let given = Given::new(7, 50, 0.3, false);
    let (queries, keys) = (numbers(7, 40, 1.0, 1), numbers(50, 32, 1.0, 2));
    let queries = Columns { matrix: &queries, first: 8 };
    let rows = given.rows(0..7);
    for processor in Processor::available() {
        let keys = aligned(Columns::all(&keys), 32);
        let products = products(processor, queries, &keys, &rows).unwrap();
        assert_eq!(products.len(), rows.listed());
        for query in 0..7 {
            let found = &products[rows.range(query)];
            for (&key, &found) in rows.row(query).0.iter().zip(found) {
                let asked = &queries.matrix.row(query)[8..];
                let expected: f32 =
                    asked.iter().zip(keys.row(key as usize)).map(|(a, b)| a * b).sum();
                assert!((found - expected).abs() < 1e-5, "{found} {expected}");
            }
        }
    }
}

#[test]
fn what_does_not_fit_is_refused() {
    let matrix = numbers(5, 48, 1.0, 1);
    let processor = Processor::detect().unwrap();
    let attended = |first, channels, given: &Given| {
        let columns = Columns { matrix: &matrix, first };
        let Ok(rows) = AlignedRows::copy(&Arc::default(), columns, channels) else { return false };
        let head = Head { queries: columns, keys: &rows, values: &rows };
        let products = products(processor, columns, &rows, &given.rows(0..5));
        let attended = attend(processor, &head, given);
        assert_eq!(products.is_ok(), attended.is_ok());
        attended.is_ok()
    };
    let given = Given::new(5, 5, 0.5, false);
    assert!(attended(32, 16, &given));
    assert!(!attended(33, 16, &given));
    assert!(!attended(0, 48, &given));
    assert!(!attended(0, 17, &given));
    assert!(!attended(0, 0, &given));
    assert!(!attended(0, 16, &Given::new(5, 6, 1.0, false)));
}
