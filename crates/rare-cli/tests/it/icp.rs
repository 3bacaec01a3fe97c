//! What `icp` finds, says and refuses.

use rare::nalgebra::{Point3, Vector3};

use crate::shared::{Outcome, Workplace, about, keys, truth};

fn icp(workplace: &Workplace, more: &[&str]) -> Outcome {
    let pair = ["icp", "source.xyz", "reference.xyz", "--init", "initial.txt"];
    workplace.run(&[&pair, more].concat())
}

#[test]
fn every_method_aligns_the_pair() {
    let workplace = Workplace::with_pair();
    for method in ["point-to-point", "point-to-plane", "symmetric", "gicp", "vgicp"] {
        let outcome = icp(&workplace, &["--method", method, "--voxel", "0.06"]);
        assert!(outcome.stderr.contains("fitness"), "{method} {outcome:?}");
        let error = outcome.pose().error_to(&about(&truth(), Vector3::new(0.0, 0.0, 3.0)));
        // The start is 4 degrees and 10 cm off, and 3 m away from the origin a degree is 5 cm.
        assert!(error.rotation_degrees < 1.5 && error.translation < 0.09, "{method} {error:?}");
    }
}

#[test]
fn the_record_has_the_evidence_and_the_settings() {
    let workplace = Workplace::with_pair();
    let options =
        ["--json", "out.json", "--output", "out.txt", "--kernel", "huber", "--trim", "0.9"];
    let outcome = icp(&workplace, &options);
    assert_eq!(workplace.text("out.txt"), outcome.stdout);
    let record = workplace.json("out.json");
    assert_eq!(
        keys(&record),
        [
            "config",
            "converged",
            "fitness",
            "information",
            "inlier_rmse",
            "iterations",
            "open_directions",
            "overlap",
            "residual_rmse",
            "target_from_source",
            "version",
        ]
    );
    assert_eq!(record["config"]["per_voxel"]["kernel"], "huber");
    assert_eq!(record["config"]["per_voxel"]["trim"]["overlap"], 0.9);
    assert_eq!(record["converged"], outcome.code == 0);
    let overlap = record["overlap"].as_f64().unwrap();
    // Rounded up to a whole point.
    assert!(overlap < 0.901 && overlap > 0.5, "{overlap}");
    // Two scales of three stages each.
    assert_eq!(record["iterations"].as_array().unwrap().len(), 6);
    let quiet = icp(&workplace, &["--quiet", "--scales", "1"]);
    assert_eq!(quiet.stderr, "");
}

#[test]
fn a_single_plane_is_named_and_not_trusted() {
    let workplace = Workplace::empty();
    let plane: Vec<Point3<f64>> = (0..4000)
        .map(|i| Point3::new(f64::from(i % 80) * 0.05, f64::from(i / 80) * 0.05, 0.0))
        .collect();
    workplace.cloud("a.xyz", &plane);
    let outcome = workplace.run(&["icp", "a.xyz", "a.xyz", "--voxel", "0.1"]);
    assert_eq!(outcome.code, 1, "{outcome:?}");
    assert_eq!(outcome.stderr.matches("leave a motion open").count(), 3, "{outcome:?}");
    assert!(outcome.stderr.contains("a shift along") && outcome.stderr.contains("a turn about"));
}

#[test]
fn what_cannot_be_done_is_refused() {
    let workplace = Workplace::with_pair();
    for (options, words) in [
        (vec!["--trim", "1.5"], vec!["--trim", "at most 1"]),
        (vec!["--method", "magic"], vec!["--method", "point-to-plane"]),
        (vec!["--scales", "0"], vec!["--scales"]),
        (vec!["--voxel", "0"], vec!["voxel"]),
        (vec!["--output", "source.xyz"], vec!["source.xyz", "never overwritten"]),
        (vec!["--save-aligned", "out.las"], vec!["out.las"]),
    ] {
        let outcome = icp(&workplace, &options);
        assert_eq!((outcome.code, outcome.stdout.as_str()), (2, ""), "{options:?} {outcome:?}");
        for word in words {
            assert!(outcome.stderr.contains(word), "{word} is missing in {outcome:?}");
        }
    }
    workplace.run(&["icp", "source.xyz", "nowhere.xyz"]).assert_refused(&["nowhere.xyz"]);
    // Nothing within reach is no bad input, but there is no pose.
    workplace.write("far.txt", "1 0 0 500\n0 1 0 0\n0 0 1 0\n0 0 0 1\n");
    let far = workplace.run(&["icp", "source.xyz", "reference.xyz", "--init", "far.txt"]);
    assert_eq!((far.code, far.stdout.as_str()), (1, ""), "{far:?}");
}
