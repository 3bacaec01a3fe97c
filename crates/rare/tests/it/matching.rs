//! Step 7 against the golden matches, against brute force, and over numbers of threads.

use nalgebra::Point3;
use proptest::prelude::*;
use rare::PointFeatures;
use rare::matching::{self, Locality, Match};
use rare::random::Random;

use crate::shared::{Array, Golden};

fn features(array: &Array) -> PointFeatures {
    let points = vec![Point3::origin(); array.shape[0]];
    PointFeatures::new(points, array.shape[1], array.f32()).unwrap()
}

/// Random features at random points of a box of 4 m, some rows twice.
fn random_features(count: usize, dimension: usize, seed: u64) -> PointFeatures {
    let mut random = Random::new(seed, 0);
    let coordinates = (0..count).map(|_| [0; 3].map(|_| 4.0 * random.uniform()));
    let points = coordinates.map(Point3::from).collect();
    let mut values: Vec<f32> = (0..count * dimension).map(|_| random.normal() as f32).collect();
    for copy in (7..count).step_by(7) {
        values.copy_within((copy - 7) * dimension..(copy - 6) * dimension, copy * dimension);
    }
    PointFeatures::new(points, dimension, values).unwrap()
}

fn squared_distance(a: &[f32], b: &[f32]) -> f64 {
    a.iter().zip(b).map(|(a, b)| f64::from(a - b).powi(2)).sum()
}

fn targets(matches: &[Match]) -> Vec<usize> {
    matches.iter().map(|pair| pair.target_index).collect()
}

/// The nearest row of `b` for every row of `a` by definition, lowest index first.
fn brute_force(
    a: &PointFeatures,
    b: &PointFeatures,
    allowed: impl Fn(usize, usize) -> bool,
) -> Vec<Option<usize>> {
    let nearest = |i: usize| {
        let candidates = (0..b.len()).filter(|&j| allowed(i, j));
        candidates
            .map(|j| (squared_distance(a.feature(i), b.feature(j)), j))
            .min_by(|x, y| x.0.total_cmp(&y.0).then(x.1.cmp(&y.1)))
            .map(|(_, j)| j)
    };
    (0..a.len()).map(nearest).collect()
}

fn brute_force_mutual(
    a: &PointFeatures,
    b: &PointFeatures,
    allowed: impl Fn(usize, usize) -> bool,
) -> Vec<(usize, usize)> {
    let forward = brute_force(a, b, &allowed);
    let backward = brute_force(b, a, |j, i| allowed(i, j));
    let pairs = forward.into_iter().enumerate().filter_map(|(i, j)| Some((i, j?)));
    pairs.filter(|&(i, j)| backward[j] == Some(i)).collect()
}

fn index_pairs(matches: &[Match]) -> Vec<(usize, usize)> {
    matches.iter().map(|pair| (pair.source_index, pair.target_index)).collect()
}

#[test]
fn golden_neighbours_and_mutual_pairs() {
    let Some(mut golden) = Golden::open("rare/s8_matching.npz") else { return };
    let (a, b) = (features(&golden.array("feat_a")), features(&golden.array("feat_b")));
    let forward = matching::nearest(&a, &b, None).unwrap();
    let backward = matching::nearest(&b, &a, None).unwrap();
    assert_eq!(targets(&forward), golden.array("nn_a_to_b").usize());
    assert_eq!(targets(&backward), golden.array("nn_b_to_a").usize());
    let mutual = matching::mutual_nearest(&a, &b, None).unwrap();
    let expected =
        golden.array("mutual_a").usize().into_iter().zip(golden.array("mutual_b").usize());
    assert_eq!(index_pairs(&mutual), expected.collect::<Vec<_>>());
    for (pair, expected) in mutual.iter().zip(golden.array("sqdist_mutual").values) {
        assert!((pair.squared_distance - expected).abs() < 1e-6, "{pair:?} {expected}");
    }
}

#[test]
fn sets_of_several_tiles_match_as_by_brute_force() {
    let (a, b) = (random_features(700, 33, 1), random_features(1300, 33, 2));
    let mutual = matching::mutual_nearest(&a, &b, None).unwrap();
    assert_eq!(index_pairs(&mutual), brute_force_mutual(&a, &b, |_, _| true));
    let nearest = matching::nearest(&b, &a, None).unwrap();
    let expected: Vec<_> = brute_force(&b, &a, |_, _| true).into_iter().flatten().collect();
    assert_eq!(targets(&nearest), expected);
}

#[test]
fn histograms_that_are_not_of_unit_length_match_by_distance() {
    // The sizes of fast point feature histograms: 33 bins of 0 to 100.
    let histograms = |seed| {
        let plain = random_features(600, 33, seed);
        let values = plain.values().iter().map(|x| (20.0 * x.abs()).min(100.0)).collect();
        PointFeatures::new(plain.points().to_vec(), 33, values).unwrap()
    };
    let (a, b) = (histograms(3), histograms(4));
    let mutual = matching::mutual_nearest(&a, &b, None).unwrap();
    assert_eq!(index_pairs(&mutual), brute_force_mutual(&a, &b, |_, _| true));
}

#[test]
fn a_locality_prior_leaves_out_what_is_too_far() {
    // Sorted along x, so that whole tiles lie outside of the window.
    let sorted = |seed| {
        let plain = random_features(1100, 16, seed);
        let mut order: Vec<usize> = (0..plain.len()).collect();
        order.sort_by(|&i, &j| plain.points()[i].x.total_cmp(&plain.points()[j].x));
        plain.select(&order)
    };
    let (a, b) = (sorted(5), sorted(6));
    let prior =
        Locality { source_points: a.points(), target_points: b.points(), max_distance: 0.5 };
    let near = |i: usize, j: usize| (a.points()[i] - b.points()[j]).norm() < 0.5;
    let mutual = matching::mutual_nearest(&a, &b, Some(&prior)).unwrap();
    assert_eq!(index_pairs(&mutual), brute_force_mutual(&a, &b, near));
    assert_ne!(mutual, matching::mutual_nearest(&a, &b, None).unwrap());
    let nearest = matching::nearest(&a, &b, Some(&prior)).unwrap();
    let expected: Vec<_> = brute_force(&a, &b, near).into_iter().flatten().collect();
    assert_eq!(targets(&nearest), expected);
    assert!(nearest.len() < a.len() || expected.len() == a.len());
}

#[test]
fn the_locality_prior_reaches_to_its_distance() {
    // Two walls 0.5 m apart: no tile may be passed over whose nearest points are just near enough.
    let wall = |x: f64, seed| {
        let plain = random_features(600, 8, seed);
        let points = plain.points().iter().map(|point| Point3::new(x, point.y, point.z)).collect();
        PointFeatures::new(points, 8, plain.values().to_vec()).unwrap()
    };
    let (a, b) = (wall(0.0, 9), wall(0.5, 10));
    let found = |max_distance: f64| {
        let (source_points, target_points) = (a.points(), b.points());
        let prior = Locality { source_points, target_points, max_distance };
        index_pairs(&matching::mutual_nearest(&a, &b, Some(&prior)).unwrap())
    };
    let near = |i: usize, j: usize| (a.points()[i] - b.points()[j]).norm() < 0.6;
    assert_eq!(found(0.6), brute_force_mutual(&a, &b, near));
    assert!(!found(0.6).is_empty() && found(0.5).is_empty());
}

#[test]
fn the_number_of_threads_changes_nothing() {
    let (a, b) = (random_features(1500, 48, 7), random_features(900, 48, 8));
    let on = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| matching::mutual_nearest(&a, &b, None).unwrap())
    };
    assert_eq!(on(1), on(2));
    assert_eq!(on(1), on(5));
}

#[test]
fn features_that_are_not_finite_do_not_match() {
    let with = |bad: f32| {
        let values = vec![1.0, 0.0, bad, 0.0, 0.0, 1.0];
        PointFeatures::new(vec![Point3::origin(); 3], 2, values).unwrap()
    };
    let mutual = matching::mutual_nearest(&with(f32::NAN), &with(f32::INFINITY), None).unwrap();
    assert_eq!(index_pairs(&mutual), [(0, 0), (2, 2)]);
}

#[test]
fn empty_sets_have_no_match_and_unlike_sets_are_refused() {
    let (none, some) = (PointFeatures::empty(0), random_features(3, 4, 1));
    assert!(matching::mutual_nearest(&none, &some, None).unwrap().is_empty());
    assert!(matching::nearest(&some, &none, None).unwrap().is_empty());
    let refused = |source: &PointFeatures, target: &PointFeatures, prior: Option<&Locality<'_>>| {
        matching::mutual_nearest(source, target, prior).unwrap_err().to_string()
    };
    assert!(refused(&some, &random_features(3, 5, 1), None).contains("4 dimensions"));
    let zero = PointFeatures::new(vec![Point3::origin()], 0, Vec::new()).unwrap();
    assert!(refused(&zero, &zero, None).contains("at least 1"));
    let short = Locality { source_points: &[], target_points: some.points(), max_distance: 1.0 };
    assert!(refused(&some, &some, Some(&short)).contains("0 and 3 points"));
    for max_distance in [0.0, -1.0, f64::NAN] {
        let (source_points, target_points) = (some.points(), some.points());
        let prior = Locality { source_points, target_points, max_distance };
        assert!(refused(&some, &some, Some(&prior)).contains("greater than 0"));
    }
}

#[test]
fn scores_are_cosine_similarities() {
    let at = |squared_distance| Match { source_index: 0, target_index: 0, squared_distance };
    assert_eq!(at(0.0).similarity(1), 1.0);
    assert_eq!(at(1.0).similarity(1), 0.5);
    assert_eq!(at(1.0).similarity(2), 0.75);
    assert_eq!(at(3.0).similarity(1), 0.0);
    let one = random_features(1, 4, 1);
    let out_of_range = Match { target_index: 1, ..at(0.0) };
    assert_eq!(matching::correspondences(&one, &one, &[out_of_range], 1), []);
}

proptest! {
    #[test]
    fn mutual_pairs_are_symmetric(rows in 1_usize..40, columns in 1_usize..40, seed in 0_u64..1000) {
        let (a, b) = (random_features(rows, 5, seed), random_features(columns, 5, seed + 1000));
        let forward = index_pairs(&matching::mutual_nearest(&a, &b, None).unwrap());
        let mut backward: Vec<_> = index_pairs(&matching::mutual_nearest(&b, &a, None).unwrap())
            .into_iter().map(|(j, i)| (i, j)).collect();
        backward.sort_unstable();
        prop_assert_eq!(&forward, &backward);
        prop_assert_eq!(forward, brute_force_mutual(&a, &b, |_, _| true));
    }
}
