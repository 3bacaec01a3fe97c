//! `rare features`: what it writes is what other commands read.

use crate::shared::Workplace;

/// Writes the features of the pair and refines with them.
#[track_caller]
fn assert_recorded_is_identical(more: &[&str]) {
    let workplace = Workplace::with_pair();
    let once = ["--rounds", "1", "--no-search", "--json", "direct.json"];
    let direct = workplace.refine(&[&once[..], more].concat());
    assert_eq!(direct.code, 0, "{direct:?}");
    let pair = ["features", "source.xyz", "reference.xyz", "--init", "initial.txt"];
    let features = workplace.run(&[&pair[..], &["--output", "pair.npz"], more].concat());
    assert_eq!((features.code, features.stdout.as_str()), (0, ""), "{features:?}");
    assert!(features.stderr.contains("pair.npz"), "{features:?}");
    let again = ["--encoder", "recorded", "--depth-features", "pair.npz", "--json", "again.json"];
    let recorded = workplace.refine(&[&again[..], more].concat());
    assert_eq!((recorded.code, &recorded.stdout), (0, &direct.stdout), "{recorded:?}");
    let evidence = |name: &str| {
        let mut record = workplace.json(name);
        record["timings_s"].take();
        for key in ["encoder", "depth_features"] {
            record["config"][key].take();
        }
        record
    };
    assert_eq!(evidence("again.json"), evidence("direct.json"));
}

#[test]
fn a_run_with_recorded_features_is_identical() {
    assert_recorded_is_identical(&[]);
}

#[test]
fn it_is_with_six_cameras_per_cloud_as_well() {
    assert_recorded_is_identical(&["--camera", "overlap"]);
}

#[test]
fn features_of_other_settings_are_refused() {
    let workplace = Workplace::with_pair();
    let pair = ["features", "source.xyz", "reference.xyz", "--init", "initial.txt"];
    assert_eq!(workplace.run(&[&pair[..], &["--out", "pair.npz"]].concat()).code, 0);
    let again = ["--depth-features", "pair.npz"];
    let refused = |more: &[&str], words: &[&str]| {
        workplace.refine(&[&again[..], more].concat()).assert_refused(words);
    };
    refused(&["--voxel", "0.07"], &["refview_ref", "voxel"]);
    refused(&["--camera", "ring"], &["4 depth maps", "24 maps"]);
    refused(&["--rounds", "2"], &["--rounds 2", "one round"]);
    refused(&["--encoder", "builtin"], &["--encoder builtin", "pair.npz"]);
    let swapped = ["refine", "reference.xyz", "source.xyz", "--init", "initial.txt"];
    workplace.run(&[&swapped[..], &again].concat()).assert_refused(&["refview_ref", "clouds"]);
}

#[test]
fn features_of_single_clouds_serve_as_3d_features() {
    let workplace = Workplace::with_pair();
    for name in ["source", "reference"] {
        let (cloud, features) = (format!("{name}.xyz"), format!("{name}.npz"));
        let outcome = workplace.run(&["features", &cloud, "--output", &features]);
        assert_eq!((outcome.code, outcome.stdout.as_str()), (0, ""), "{outcome:?}");
        assert!(outcome.stderr.contains("points with 252 features"), "{outcome:?}");
        // They lie on the cloud.
        let features = rare::io::read_point_features(workplace.path(&features)).unwrap();
        let cloud = rare::io::read_cloud(workplace.path(&cloud)).unwrap();
        let tree = rare::data::KdTree::new(cloud.points());
        let on_it = |point: &&rare::nalgebra::Point3<f64>| {
            tree.nearest_within(&(**point - cloud.shift()), 0.1).is_some()
        };
        let count = features.points().iter().filter(on_it).count();
        assert!(features.len() > 300 && 10 * count > 8 * features.len(), "{count}");
    }
    let use_them = ["--source-features", "source.npz", "--reference-features", "reference.npz"];
    let outcome = workplace.refine(&[&use_them[..], &["--json", "out.json"]].concat());
    assert_eq!(outcome.code, 0, "{outcome:?}");
    let record = workplace.json("out.json");
    let set = record["sets"].as_array().unwrap().iter().find(|set| set["name"] == "features_3d");
    assert!(set.unwrap()["inliers"].as_u64().unwrap() > 20, "{record}");
}

#[test]
fn what_cannot_be_written_is_refused_before_work() {
    let workplace = Workplace::with_pair();
    let before = workplace.names();
    let features = |more: &[&str]| workplace.run(&[&["features", "source.xyz"], more].concat());
    features(&[]).assert_refused(&["--output"]);
    features(&["--output", "nowhere/a.npz"]).assert_refused(&["nowhere", "does not exist"]);
    features(&["--output", "source.xyz"]).assert_refused(&["input"]);
    features(&["--output", "a.npz", "--json", "a.json"]).assert_refused(&["--json"]);
    // A pair needs its transform, and a transform a pair.
    assert_eq!(features(&["reference.xyz", "--output", "a.npz"]).code, 2);
    assert_eq!(features(&["--init", "initial.txt", "--output", "a.npz"]).code, 2);
    features(&["--output", "a.npz", "--rounds", "0"]).assert_refused(&["--rounds 0"]);
    assert_eq!(workplace.names(), before);
}

#[test]
fn a_cloud_that_no_camera_sees_is_said_to_be_unseen() {
    let workplace = Workplace::with_pair();
    // Behind the camera.
    let behind =
        |point: &rare::nalgebra::Point3<f64>| point - rare::nalgebra::Vector3::new(0.0, 0.0, 40.0);
    let cloud = rare::io::read_cloud(workplace.path("source.xyz")).unwrap().world_points();
    workplace.cloud("behind.xyz", &cloud.iter().map(behind).collect::<Vec<_>>());
    let sensor = ["--profile", "indoor", "--camera", "sensor", "--output", "a.npz"];
    let outcome = workplace.run(&[&["features", "behind.xyz"][..], &sensor].concat());
    outcome.assert_refused(&["behind.xyz", "--camera"]);
}
