//! Times of the steps between feature maps and correspondences, on random features of the sizes that occur.

use divan::Bencher;
use divan::counter::ItemsCount;
use nalgebra::Point3;
use rare::data::DepthRange;
use rare::matching::{self, Locality};
use rare::random::Random;
use rare::transfer::{self, Sampling};
use rare::{DepthMap, FeatureMap, Intrinsics, PointFeatures};

fn main() {
    // One thread: what is reported is CPU time.
    if rayon::ThreadPoolBuilder::new().num_threads(1).build_global().is_ok() {
        divan::main();
    }
}

/// Random features, whose points lie row by row on a surface of 4 m x 3 m, as grid keypoints do.
fn random_features(count: usize, dimension: usize, seed: u64) -> PointFeatures {
    let mut random = Random::new(seed, 0);
    let columns = (count as f64).sqrt().ceil() as usize;
    let place = |index: usize| {
        let (u, v) = (index % columns, index / columns);
        Point3::new(4.0 * u as f64 / columns as f64, 3.0 * v as f64 / columns as f64, 2.0)
    };
    let values = (0..count * dimension).map(|_| random.normal() as f32).collect();
    PointFeatures::new((0..count).map(place).collect(), dimension, values)
        .unwrap_or_else(|_| PointFeatures::empty(dimension))
}

/// Items are multiply-adds, so that 1 Gitem/s is 2 GFLOP/s.
#[divan::bench(args = [(3000, 400), (1400, 384), (5000, 33), (20_000, 33)])]
fn mutual_nearest(bencher: Bencher<'_, '_>, (count, dimension): (usize, usize)) {
    let features = [1, 2].map(|seed| random_features(count, dimension, seed));
    bencher
        .counter(ItemsCount::new(count * count * dimension))
        .bench(|| matching::mutual_nearest(&features[0], &features[1], None));
}

#[divan::bench]
fn mutual_nearest_within_60_cm(bencher: Bencher<'_, '_>) {
    let [source, target] = [1, 2].map(|seed| random_features(3000, 400, seed));
    let prior = Locality {
        source_points: source.points(),
        target_points: target.points(),
        max_distance: 0.6,
    };
    bencher.bench(|| matching::mutual_nearest(&source, &target, Some(&prior)));
}

/// A map of 400 channels on every tenth pixel.
#[divan::bench]
fn lift(bencher: Bencher<'_, '_>) {
    let features = random_features(64 * 48, 400, 1);
    let map = FeatureMap::new(400, 48, 64, features.values().to_vec());
    let depth = DepthMap::new(Intrinsics::indoor(), vec![2.0; 640 * 480]);
    if let (Ok(map), Ok(depth)) = (map, depth) {
        bencher
            .bench(|| transfer::lift(&map, &depth, DepthRange::indoor(), Sampling::AlignedCorners));
    }
}

#[divan::bench]
fn common_points(bencher: Bencher<'_, '_>) {
    let [keypoints, lifted] = [(5000, 1), (3000, 2)].map(|(n, seed)| random_features(n, 1, seed));
    bencher.bench(|| transfer::common_points(keypoints.points(), lifted.points(), 0.05));
}
