//! `GeoTransformer` against what its released code computes.

use rare::Correspondence;
use rare::nalgebra::Point3;
use rare_nets::Matrix;
use rare_nets::backbones::Selection;
use rare_nets::backbones::geotransformer::{
    GeoTransformerConfig, Partition, PointMatch, SuperpointMatch, layout, match_points,
};
use rare_nets::backbones::kpconv::Pyramid;

use super::case::{Case, both, reduced, reduced_parameters};
use super::comparison::compare_pose;
use super::formula;
use super::kpconv::golden_points;
use crate::shared::{GoldenTensors, path, relative_difference};

/// The names and shapes of an official checkpoint.
fn official_layout(name: &str) -> Option<Vec<(String, Vec<usize>)>> {
    let file = path(&format!("golden/backbones/geotransformer_{name}.state_dict.txt"))?;
    let text = std::fs::read_to_string(file).unwrap();
    let tensor = |line: &str| {
        let fields: Vec<&str> = line.split('\t').collect();
        let sizes = fields[1].trim_matches(['(', ')']).split(',').map(str::trim);
        let sizes = sizes.filter(|size| !size.is_empty()).map(|size| size.parse().unwrap());
        (fields[0].to_owned(), sizes.collect())
    };
    let mut tensors: Vec<(String, Vec<usize>)> = text.lines().map(tensor).collect();
    tensors.sort();
    Some(tensors)
}

#[test]
fn tensors_are_those_of_the_official_checkpoints() {
    let cases = [
        ("full3dmatch", GeoTransformerConfig::three_d_match(), 9_829_377),
        ("kitti", GeoTransformerConfig::kitti(), 25_499_137),
        ("tiny", reduced(0.1, 32), 440_769),
    ];
    for (name, config, parameters) in cases {
        let Some(official) = official_layout(name) else { return };
        let ours: Vec<(String, Vec<usize>)> = layout(&config).into_iter().collect();
        assert_eq!(ours, official, "{name}");
        // Kernel points and wave numbers are not learnt.
        let learnt = ours
            .iter()
            .filter(|(name, _)| !name.ends_with("kernel_points") && !name.ends_with("div_term"));
        assert_eq!(
            learnt.map(|(_, shape)| shape.iter().product::<usize>()).sum::<usize>(),
            parameters
        );
    }
}

#[test]
fn the_formula_gives_the_weights_of_the_small_networks() {
    let Some(tiny) = reduced_parameters("tiny") else { return };
    let mut compared = 0;
    for (name, shape) in layout(&reduced(0.1, 32)) {
        let Some(values) = formula::values(&name, &shape) else { continue };
        let golden = tiny.read(&name, &shape).unwrap().to_f32();
        let golden: Vec<f64> = golden.into_iter().map(f64::from).collect();
        assert!(relative_difference(&values, &golden) < 1e-6, "{name}");
        compared += 1;
    }
    assert_eq!(compared, 269 - 11);
}

#[test]
fn every_stage_meets_the_golden_values() {
    for name in ["tiny", "small"] {
        let Some(case) = Case::reduced(name) else { return };
        assert!(case.compare(name) >= 25);
    }
}

/// Seconds of processor time of this process and its greatest memory in bytes, where the system tells.
fn spent() -> (f64, f64) {
    let field = |file: &str, pick: &dyn Fn(&str) -> Option<f64>| {
        std::fs::read_to_string(file).ok().and_then(|text| pick(&text)).unwrap_or(f64::NAN)
    };
    let ticks = |text: &str| -> Option<f64> {
        let fields: Vec<&str> = text.rsplit(')').next()?.split_whitespace().collect();
        Some((fields.get(11)?.parse::<f64>().ok()? + fields.get(12)?.parse::<f64>().ok()?) / 100.0)
    };
    let peak = |text: &str| -> Option<f64> {
        let line = text.lines().find(|line| line.starts_with("VmHWM"))?;
        Some(line.split_whitespace().nth(1)?.parse::<f64>().ok()? * 1024.0)
    };
    (field("/proc/self/stat", &ticks), field("/proc/self/status", &peak))
}

#[test]
fn the_official_network_meets_the_golden_values() {
    let Some(case) = Case::full() else { return };
    assert!(case.compare("full") >= 3);
}

#[test]
fn the_official_network_is_fast() {
    let Some(case) = Case::full() else { return };
    let points = golden_points(&case.golden, 0);
    let [target, source] = points.clouds().map(|cloud| {
        cloud.iter().map(|point| Point3::from(point.map(f64::from))).collect::<Vec<_>>()
    });
    let expected = case.network.expected_bytes(&source, &target, &case.limits).unwrap();
    let (before, at_rest) = spent();
    let start = std::time::Instant::now();
    let found =
        case.network.describe(&source, &target, &case.limits, &Selection::default()).unwrap();
    let wall = start.elapsed().as_secs_f64();
    let (after, peak) = spent();
    println!(
        "described in {:.2} s of processor time, {wall:.2} s; memory {:.0} MB at rest, {:.0} MB at most, {:.0} MB expected",
        after - before,
        at_rest / 1e6,
        peak / 1e6,
        expected as f64 / 1e6
    );
    assert_eq!(found.correspondences.len(), 500);
    assert!(found.warnings.is_empty(), "{:?}", found.warnings);
}

#[test]
fn results_do_not_depend_on_the_number_of_threads() {
    let Some(case) = Case::reduced("tiny") else { return };
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let first = golden_points(&case.golden, 0);
            let pyramid = Pyramid::new(first.clouds(), &case.config.pyramid, &case.limits).unwrap();
            case.network.register(&pyramid, &mut |_, _| {}).unwrap()
        })
    };
    let (one, three) = (run(1), run(3));
    assert_eq!(one.superpoint_features, three.superpoint_features);
    assert_eq!(one.point_features, three.point_features);
    assert_eq!(one.plans, three.plans);
    assert_eq!(one.point_matches, three.point_matches);
}

/// Matches of given plans, and the pose that they make.
#[test]
fn poses_are_those_of_the_released_code() {
    let cases = [
        ("tiny", reduced(0.1, 32)),
        ("small", reduced(0.05, 128)),
        ("full3dmatch", GeoTransformerConfig::three_d_match()),
    ];
    for (name, config) in cases {
        let file = format!("backbones/geotransformer_{name}.safetensors");
        let Some(golden) = GoldenTensors::open(&file) else { return };
        let scores = golden.array("lgr.in.log_scores");
        let [patches, width, _] = scores.shape[..] else { panic!("three sizes") };
        let masks = both("lgr.in.*_knn_masks").map(|part| golden.array(&part).usize());
        let points = both("lgr.in.*_knn_points").map(|part| golden.array(&part).f32());
        let points = points.map(|values| {
            let point = |p: &[f32]| Point3::new(f64::from(p[0]), f64::from(p[1]), f64::from(p[2]));
            values.chunks_exact(3).map(point).collect::<Vec<_>>()
        });
        let partitions = [0, 1].map(|side| {
            let patch = |patch: usize| {
                let slots = (patch * width..(patch + 1) * width).filter(|&at| masks[side][at] > 0);
                slots.map(|at| at as u32).collect()
            };
            Partition { patches: (0..patches).map(patch).collect() }
        });
        let plan = |patch: usize| {
            let [rows, columns] = [0, 1].map(|side| partitions[side].patches[patch].len());
            let value = |at: usize| {
                let (row, column) = (at / (columns + 1), at % (columns + 1));
                let bin = row == rows || column == columns;
                if bin { 0.0 } else { scores.values[(patch * width + row) * width + column] as f32 }
            };
            Matrix::new(rows + 1, columns + 1, (0..(rows + 1) * (columns + 1)).map(value).collect())
                .unwrap()
        };
        let plans: Vec<Matrix> = (0..patches).map(plan).collect();
        let matches: Vec<SuperpointMatch> = (0..patches)
            .map(|patch| SuperpointMatch { target: patch, source: patch, score: 1.0 })
            .collect();
        let found = match_points(&plans, &partitions, &matches, &config.fine);
        let mut groups = vec![Vec::new(); patches];
        found.iter().enumerate().for_each(|(place, pair)| groups[pair.patch].push(place));
        let pair = |pair: &PointMatch| Correspondence {
            source: points[1][pair.source],
            target: points[0][pair.target],
            score: f64::from(pair.score),
        };
        let pairs: Vec<Correspondence> = found.iter().map(pair).collect();
        let golden_scores = golden.array("lgr.out.corr_scores").values;
        assert_eq!(pairs.len(), golden_scores.len(), "{name}");
        for (side, part) in both("lgr.out.*_corr_points").iter().enumerate() {
            let ours: Vec<f32> = pairs
                .iter()
                .map(|pair| if side == 0 { pair.target } else { pair.source })
                .flat_map(|point| [point.x as f32, point.y as f32, point.z as f32])
                .collect();
            assert_eq!(ours, golden.array(part).f32(), "{name} {part}");
        }
        let expected = golden.array("lgr.out.estimated_transform").values;
        let pose = config.fine.local_to_global().estimate(&pairs, &groups).unwrap();
        compare_pose(&format!("{name} alone"), &pose.target_from_source, &expected);
    }
}
