//! Measures designs of the built-in depth features: both clouds of every labelled pair rendered into the reference
//! view under an initial transform, features matched mutually, inliers counted under the ground truth.
//!
//! `cargo run --release --example depth_feature_designs -- FOLDER PAIRS.json INIT.json [INIT.json ...]`
#![expect(clippy::print_stdout, clippy::unwrap_used, reason = "a measuring program")]

use std::collections::BTreeMap;
use std::path::Path;
use std::time::Instant;

use nalgebra::{Matrix4, Point3};
use rare::data::PointFeatures;
use rare::densify::Densifier;
use rare::depth_features::DepthFeatures;
use rare::encode::DepthEncoder;
use rare::{Intrinsics, RigidTransform};
use serde_json::Value;

fn transform(value: &Value) -> RigidTransform {
    let numbers: Vec<f64> = value
        .as_array()
        .unwrap()
        .iter()
        .flat_map(|row| row.as_array().unwrap())
        .map(|x| x.as_f64().unwrap())
        .collect();
    RigidTransform::from_matrix(&Matrix4::from_row_slice(&numbers)).unwrap()
}

fn designs() -> Vec<(String, DepthFeatures)> {
    let base = DepthFeatures::for_voxel(0.05);
    vec![
        ("default".into(), base.clone()),
        ("all frequencies".into(), DepthFeatures { frequencies: 18, ..base.clone() }),
        ("two sizes".into(), DepthFeatures { radii: vec![0.15, 0.35], ..base.clone() }),
        ("larger sizes".into(), DepthFeatures { radii: vec![0.12, 0.25, 0.5], ..base.clone() }),
        ("stride 8".into(), DepthFeatures { stride: 8, ..base }),
    ]
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let folder = Path::new(&arguments[0]);
    let json = |name: &str| -> Value {
        serde_json::from_slice(&std::fs::read(folder.join(name)).unwrap()).unwrap()
    };
    let pairs = json(&arguments[1]);
    let mut clouds = BTreeMap::new();
    for pair in pairs.as_array().unwrap() {
        for key in ["src", "ref"] {
            let id = pair[key].as_u64().unwrap();
            clouds.entry(id).or_insert_with(|| {
                rare::io::read_cloud(folder.join(format!("cloud_bin_{id}.ply"))).unwrap()
            });
        }
    }
    let intrinsics = Intrinsics::indoor();
    for init in &arguments[2..] {
        let initials = json(init);
        for (name, design) in designs() {
            let (mut ratios, mut inliers, mut seconds) = (Vec::new(), 0, 0.0);
            for pair in pairs.as_array().unwrap() {
                let truth = transform(&pair["gt"]);
                let entry = initials["pairs"]
                    .as_array()
                    .unwrap()
                    .iter()
                    .find(|e| e["src"] == pair["src"] && e["ref"] == pair["ref"]);
                let Some(entry) = entry else { continue };
                let initial = transform(&entry["init"]);
                let source = clouds[&pair["src"].as_u64().unwrap()].points();
                let reference = clouds[&pair["ref"].as_u64().unwrap()].points();
                let maps = [(reference, RigidTransform::identity()), (source, initial)].map(
                    |(cloud, camera_from_cloud)| {
                        Densifier::Fast.densify(
                            &rare::project::project_moved(cloud, &camera_from_cloud, &intrinsics)
                                .depth_map,
                        )
                    },
                );
                let start = Instant::now();
                let features = design.encode(&maps).unwrap();
                let lifted: Vec<PointFeatures> =
                    (0..2).map(|i| lift(&maps[i], &features[i][0])).collect();
                // Too little in common in this view to say anything; the same rule for all designs.
                if lifted.iter().any(|keypoints| keypoints.len() < 50) {
                    continue;
                }
                let matches = rare::matching::mutual_nearest(&lifted[1], &lifted[0], None).unwrap();
                seconds += start.elapsed().as_secs_f64();
                let truth_from_view = truth * initial.inverse();
                let good = matches
                    .iter()
                    .filter(|m| {
                        (truth_from_view.apply(&lifted[1].points()[m.source_index])
                            - lifted[0].points()[m.target_index])
                            .norm()
                            < 0.1
                    })
                    .count();
                ratios.push(good as f64 / matches.len().max(1) as f64);
                inliers += good;
            }
            ratios.sort_by(f64::total_cmp);
            let n = ratios.len();
            println!(
                "| {init} | {name} | {n} | {:.3} | {:.3} | {:.0} | {:.0} ms |",
                ratios.iter().sum::<f64>() / n as f64,
                (ratios[n / 2] + ratios[(n - 1) / 2]) / 2.0,
                inliers as f64 / n as f64,
                1e3 * seconds / n as f64
            );
        }
    }
}

fn lift(map: &rare::DepthMap, features: &rare::FeatureMap) -> PointFeatures {
    let (rows, columns, cells) =
        (features.height(), features.width(), features.height() * features.width());
    let (su, sv) = (map.width() / columns, map.height() / rows);
    let (mut points, mut values): (Vec<Point3<f64>>, Vec<f32>) = (Vec::new(), Vec::new());
    for cell in 0..cells {
        let (u, v) = ((cell % columns) * su + su / 2, (cell / columns) * sv + sv / 2);
        let depth = map.at(u, v);
        if depth > 0.0 {
            points.push(map.intrinsics().back_project(u as f64, v as f64, f64::from(depth)));
            values.extend((0..features.channels()).map(|c| features.values()[c * cells + cell]));
        }
    }
    PointFeatures::new(points, features.channels(), values).unwrap()
}
