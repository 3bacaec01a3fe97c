//! Times of the geometric stages, one benchmark per stage.
//!
//! `RARE_BENCH_PAIR` names an `.npz` file with the arrays `src` and `ref` (`N x 3`, `f32`) to measure on, and
//! `RARE_BENCH_VOXEL` the sampling distance in metres (0.05 if unset); without a pair the points are synthetic.
//! `RARE_BENCH_MATCHES` names one whose arrays are matched row by row; without it a tenth of 1000 matches is right.
use std::sync::LazyLock;

use divan::Bencher;
use nalgebra::{Point3, Rotation3, Vector3};
use rare::data::{KdTree, resolution, voxel_downsample};
use rare::features::{estimate_normals, fpfh, orient_towards};
use rare::pose::{
    FastMac, FeatureCandidates, Icp, IcpTarget, LocalToGlobal, Mac, PoseEstimator, Ransac, Sc2Pcr,
    Sc2PcrPlusPlus, fit_weighted,
};
use rare::random::Random;
use rare::{Correspondence, PointCloud, RigidTransform};

fn main() {
    // One thread: what is reported is CPU time.
    if rayon::ThreadPoolBuilder::new().num_threads(1).build_global().is_ok() {
        divan::main();
    }
}

struct Cloud {
    raw: Vec<Point3<f64>>,
    points: Vec<Point3<f64>>,
    tree: KdTree,
    normals: Vec<Vector3<f64>>,
}

static VOXEL: LazyLock<f64> = LazyLock::new(|| {
    std::env::var("RARE_BENCH_VOXEL").ok().and_then(|text| text.parse().ok()).unwrap_or(0.05)
});

static CLOUDS: LazyLock<[Cloud; 2]> = LazyLock::new(|| ["src", "ref"].map(load));

fn load(name: &str) -> Cloud {
    let raw = match std::env::var_os("RARE_BENCH_PAIR") {
        Some(path) => read(&path, name).unwrap_or_default(),
        None => synthetic_room(60_000),
    };
    let points = voxel_downsample(&raw, *VOXEL).unwrap_or_default();
    let tree = KdTree::new(&points);
    let mut normals = estimate_normals(&points, &tree, 2.0 * *VOXEL, 30);
    orient_towards(&mut normals, &points, &Point3::origin());
    Cloud { raw, points, tree, normals }
}

fn read(path: &std::ffi::OsStr, name: &str) -> Option<Vec<Point3<f64>>> {
    let mut archive = npyz::npz::NpzArchive::open(path).ok()?;
    let values = archive.by_name(name).ok()??.into_vec::<f32>().ok()?;
    let point = |row: &[f32]| Point3::new(row[0], row[1], row[2]).cast::<f64>();
    Some(values.chunks_exact(3).map(point).collect())
}

/// A floor and two walls with a wavy surface.
fn synthetic_room(count: usize) -> Vec<Point3<f64>> {
    let mut random = Random::new(1, 0);
    let mut point = |i: usize| {
        let (a, b) = (4.0 * random.uniform(), 3.0 * random.uniform());
        let c = 0.1 * (5.0 * a).sin() * (4.0 * b).cos();
        match i % 3 {
            0 => Point3::new(a, b, c),
            1 => Point3::new(a, c, b),
            _ => Point3::new(c, b, a),
        }
    };
    (0..count).map(&mut point).collect()
}

/// A tenth of the pairs follow one motion.
fn correspondences(count: usize) -> Vec<Correspondence> {
    let mut random = Random::new(2, 0);
    let truth = motion();
    let mut pair = |i: usize| {
        let mut somewhere =
            || Point3::new(4.0 * random.uniform(), 3.0 * random.uniform(), 2.5 * random.uniform());
        let (source, elsewhere) = (somewhere(), somewhere());
        let target = truth.apply(if i.is_multiple_of(10) { &source } else { &elsewhere });
        Correspondence { source, target, score: 1.0 }
    };
    (0..count).map(&mut pair).collect()
}

fn matches() -> Vec<Correspondence> {
    let Some(path) = std::env::var_os("RARE_BENCH_MATCHES") else { return correspondences(1000) };
    let points = |name| read(&path, name).unwrap_or_default();
    (points("src").into_iter().zip(points("ref")))
        .map(|(source, target)| Correspondence { source, target, score: 1.0 })
        .collect()
}

fn motion() -> RigidTransform {
    RigidTransform::new(
        Rotation3::new(Vector3::new(0.03, -0.02, 0.05)),
        Vector3::new(0.05, -0.03, 0.04),
    )
}

#[divan::bench]
fn voxel_grid(bencher: Bencher) {
    bencher.bench(|| CLOUDS.each_ref().map(|cloud| voxel_downsample(&cloud.raw, *VOXEL)));
}

#[divan::bench]
fn resolution_of_raw(bencher: Bencher) {
    bencher.bench(|| CLOUDS.each_ref().map(|cloud| resolution(&cloud.raw)));
}

#[divan::bench]
fn kd_tree_of_raw(bencher: Bencher) {
    bencher.bench(|| CLOUDS.each_ref().map(|cloud| KdTree::new(&cloud.raw)));
}

#[divan::bench]
fn normals(bencher: Bencher) {
    bencher.bench(|| {
        CLOUDS
            .each_ref()
            .map(|cloud| estimate_normals(&cloud.points, &cloud.tree, 2.0 * *VOXEL, 30))
    });
}

#[divan::bench]
fn neighbours_of_fpfh(bencher: Bencher) {
    bencher.bench(|| {
        let mut found = Vec::new();
        let mut total = 0;
        for cloud in CLOUDS.iter() {
            for point in &cloud.points {
                cloud.tree.k_nearest_unordered(point, 100, 5.0 * *VOXEL, &mut found);
                total += found.len();
            }
        }
        total
    });
}

#[divan::bench]
fn fpfh_with_tree(bencher: Bencher) {
    bencher.bench(|| {
        CLOUDS.each_ref().map(|cloud| {
            let tree = KdTree::new(&cloud.points);
            fpfh(&cloud.points, &cloud.normals, &tree, 5.0 * *VOXEL, 100)
        })
    });
}

#[divan::bench]
fn icp(bencher: Bencher) {
    let [source, target] = &*CLOUDS;
    let target = IcpTarget::new(target.points.clone(), target.normals.clone());
    bencher.bench(|| {
        target.as_ref().map(|target| {
            Icp::for_voxel(*VOXEL).align(&source.points, target, &RigidTransform::identity())
        })
    });
}

#[divan::bench]
fn rigid_fit_of_20(bencher: Bencher) {
    let pairs = correspondences(20);
    bencher.bench(|| fit_weighted(pairs.iter().map(|pair| (pair.source, pair.target, pair.score))));
}

#[divan::bench(args = [250, 1000, 2500, 5000])]
fn sc2_pcr(bencher: Bencher, count: usize) {
    let pairs = correspondences(count);
    bencher.bench(|| Sc2Pcr::three_d_match().hypotheses(&pairs, 5));
}

/// A hundred candidates for each keypoint, all but its match at random.
#[divan::bench(args = [1000, 5000])]
fn sc2_pcr_plus_plus(bencher: Bencher, count: usize) {
    let pairs = correspondences(count);
    let mut candidates = FeatureCandidates::of_pairs(&pairs);
    for (i, targets) in candidates.targets.iter_mut().enumerate() {
        targets.extend(pairs.iter().cycle().skip(i + 1).take(99).map(|pair| pair.target));
    }
    let estimator = Sc2PcrPlusPlus::three_d_match_fpfh();
    bencher.bench(|| estimator.estimate_with(&pairs, &candidates));
}

#[divan::bench(args = [250, 1000, 2500])]
fn mac(bencher: Bencher, count: usize) {
    let pairs = correspondences(count);
    bencher.bench(|| Mac::three_d_match().hypotheses(&pairs, 2));
}

#[divan::bench(args = [250, 1000, 2500])]
fn fast_mac(bencher: Bencher, count: usize) {
    let pairs = correspondences(count);
    bencher.bench(|| FastMac::three_d_match().hypotheses(&pairs, 2));
}

#[divan::bench]
fn mac_of_matches(bencher: Bencher) {
    let pairs = matches();
    bencher.bench(|| Mac::three_d_match().hypotheses(&pairs, 2));
}

#[divan::bench]
fn mac_of_matches_at_a_low_bound(bencher: Bencher) {
    let pairs = matches();
    bencher.bench(|| Mac::three_d_lo_match().hypotheses(&pairs, 2));
}

#[divan::bench]
fn fast_mac_of_matches(bencher: Bencher) {
    let pairs = matches();
    bencher.bench(|| FastMac::three_d_match().hypotheses(&pairs, 2));
}

/// Against the limit on the work: nine tenths of the pairs agree.
#[divan::bench(args = [500, 1000])]
fn mac_of_inliers(bencher: Bencher, count: usize) {
    let mut pairs = correspondences(count);
    let mut random = Random::new(3, 0);
    for (i, pair) in pairs.iter_mut().enumerate().filter(|(i, _)| !i.is_multiple_of(10)) {
        let noise = Vector3::from_fn(|_, _| 0.01 * random.normal());
        pair.target = motion().apply(&pair.source) + if i % 3 == 0 { noise } else { noise / 3.0 };
    }
    bencher.bench(|| Mac::three_d_lo_match().hypotheses(&pairs, 2));
}

/// All 50 000 samples, scored by the pairs.
#[divan::bench(args = [1000, 5000])]
fn ransac_of_50_000(bencher: Bencher, count: usize) {
    let pairs = correspondences(count);
    let cloud = PointCloud::new(vec![Point3::origin()]);
    let estimator = Ransac { confidence: 1.0, ..Ransac::three_d_match() };
    bencher.bench(|| cloud.as_ref().map(|cloud| estimator.estimate(cloud, cloud, &pairs)));
}

#[divan::bench(args = [1000])]
fn local_to_global(bencher: Bencher, count: usize) {
    let pairs = correspondences(count);
    // The right pairs are every tenth.
    let start = |group: usize| group % 10 + group / 10 * 50;
    let groups: Vec<Vec<usize>> =
        (0..count / 5).map(|group| (0..5).map(|at| start(group) + 10 * at).collect()).collect();
    bencher.bench(|| LocalToGlobal::three_d_match().estimate(&pairs, &groups));
}
