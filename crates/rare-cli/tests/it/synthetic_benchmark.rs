//! The benchmarks that the example `synthetic_benchmark` writes.

use rare::RigidTransform;
use rare::eval::dataset::{read_folder, read_folder_starts};
use serde_json::Value;

use crate::benchmark::{self, Scenes};
use crate::shared::Workplace;

/// Errors of the starts of a set: degrees, and metres at the middle of the source.
fn start_errors(workplace: &Workplace, folder: &str, set: &str) -> Vec<(f64, f64)> {
    let path = workplace.path(folder);
    let pairs = read_folder(&path, "pairs.json", "gt").unwrap().pairs;
    let starts = read_folder_starts(path.join(format!("init_{set}.json"))).unwrap();
    assert_eq!(pairs.len(), starts.len());
    let error = |(pair, start): (&rare::eval::dataset::DatasetPair, _)| {
        let start: &rare::eval::dataset::StartPose = start;
        let pose = |matrix| RigidTransform::from_matrix(matrix).unwrap();
        let truth = pose(&pair.truth.target_from_source);
        let start = pose(&start.target_from_source);
        let cloud = rare::io::read_cloud(&pair.source).unwrap();
        let sum: rare::nalgebra::Vector3<f64> =
            cloud.points().iter().map(|point| point.coords).sum();
        let centre = (sum / cloud.len() as f64).into();
        let moved = (start.apply(&centre) - truth.apply(&centre)).norm();
        (start.error_to(&truth).rotation_degrees, moved)
    };
    pairs.iter().zip(&starts).map(error).collect()
}

#[track_caller]
fn assert_within(errors: &[(f64, f64)], degrees: [f64; 2], metres: [f64; 2]) {
    // Clouds are written in single precision.
    const ROUNDING: f64 = 1e-4;
    for (turn, shift) in errors {
        assert!(*turn > degrees[0] && *turn < degrees[1], "{errors:?}");
        assert!(*shift > metres[0] - ROUNDING && *shift < metres[1] + ROUNDING, "{errors:?}");
    }
}

#[test]
fn simulated_rooms_are_evaluated_as_any_folder() {
    let workplace = Workplace::empty();
    benchmark::write(Scenes::Rooms, 2, 7, &workplace.path("rooms")).unwrap();
    assert_eq!(workplace.names(), ["rooms"]);
    for (start, expected) in [("pert_medium", "2/2"), ("wrong", "0/2")] {
        let init = format!("init_{start}.json");
        let command = ["eval", "folder", "rooms", "--init", &init, "--methods", "init,gicp"];
        let outcome = workplace.run(&[&command[..], &["--out", start, "--quiet"]].concat());
        assert_eq!(outcome.code, 0, "{outcome:?}");
        let line = outcome.stdout.lines().find(|line| line.contains("init ")).unwrap();
        assert!(line.contains(expected), "{outcome:?}");
    }
    let pairs: Vec<Value> = serde_json::from_str(&workplace.text("rooms/pairs.json")).unwrap();
    for (pair, least) in pairs.iter().zip([0.1, 0.2]) {
        let overlap = pair["overlap"].as_f64().unwrap();
        assert!(overlap >= least && overlap <= least + 0.1, "{overlap}");
        // The number of common voxels, out of those of a room.
        let common = pair["info"][0][0].as_f64().unwrap();
        assert!(common > 100.0 && common < 20_000.0, "{common}");
    }
    assert_within(&start_errors(&workplace, "rooms", "pert_medium"), [5.0, 10.0], [0.1, 0.2]);
    assert_within(&start_errors(&workplace, "rooms", "pert_hard"), [15.0, 25.0], [0.3, 0.5]);
}

#[test]
fn starts_grow_with_the_scene() {
    let workplace = Workplace::empty();
    benchmark::write(Scenes::Streets, 1, 1, &workplace.path("streets")).unwrap();
    assert_within(&start_errors(&workplace, "streets", "pert_medium"), [5.0, 10.0], [1.0, 2.0]);
    benchmark::write(Scenes::Objects, 1, 1, &workplace.path("objects")).unwrap();
    assert_within(&start_errors(&workplace, "objects", "pert_hard"), [15.0, 25.0], [0.01, 0.1]);
}

#[test]
fn a_benchmark_repeats_and_is_written_once() {
    let workplace = Workplace::empty();
    let write =
        |seed, name: &str| benchmark::write(Scenes::Objects, 1, seed, &workplace.path(name));
    for (seed, name) in [(3, "first"), (3, "second"), (4, "other")] {
        write(seed, name).unwrap();
    }
    let files = ["cloud_bin_0.ply", "cloud_bin_1.ply", "pairs.json", "init_wrong.json"];
    for file in files {
        let [first, second, other] =
            ["first", "second", "other"].map(|name| workplace.read(&format!("{name}/{file}")));
        assert!(first == second && first != other, "{file}");
    }
    let message = write(3, "first").unwrap_err().to_string();
    assert!(message.contains("first") && message.contains("another folder"), "{message}");
    assert!(benchmark::write(Scenes::Objects, 0, 3, &workplace.path("none")).is_err());
    assert_eq!(workplace.names(), ["first", "other", "second"]);
    assert!(Scenes::named("houses").unwrap_err().to_string().contains("houses"));
}
