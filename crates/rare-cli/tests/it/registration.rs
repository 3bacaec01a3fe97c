//! What `register` and `refine` say and find.

use std::f64::consts::TAU;

use rare::nalgebra::{Point3, Vector3};

use crate::shared::{Outcome, Workplace, about, keys, pair, shifted, start, truth};

/// The keys of the record, in the order of the alphabet.
const KEYS: [&str; 16] = [
    "confidence",
    "config",
    "correspondences",
    "evidence",
    "hypotheses",
    "information",
    "initial",
    "inliers",
    "overlap",
    "sets",
    "signals",
    "target_from_source",
    "timings_s",
    "verdict",
    "version",
    "warnings",
];

/// The sparse samplings (4 cm apart) leave 0.66 degrees and 4.3 cm, the latter mostly by the turn 3 m away.
#[track_caller]
fn assert_near_truth(outcome: &Outcome) {
    let truth = about(&truth(), Vector3::new(0.0, 0.0, 3.0));
    let error = outcome.pose().error_to(&truth);
    assert!(error.rotation_degrees < 1.0 && error.translation < 0.06, "{error:?}");
}

#[test]
fn a_wrong_start_is_refined() {
    let workplace = Workplace::with_pair();
    let outcome = workplace.refine(&["--json", "out.json", "-v"]);
    assert_eq!(outcome.code, 0, "{outcome:?}");
    assert_near_truth(&outcome);
    for word in ["refined", "confidence", "degrees", "features_3d", "encode", "voxel"] {
        assert!(outcome.stderr.contains(word), "{word} is missing in {outcome:?}");
    }
    let record = workplace.json("out.json");
    assert_eq!(keys(&record), KEYS);
    assert_eq!(record["verdict"], "refined");
    assert_eq!(record["information"].as_array().unwrap().len(), 6);
    assert_eq!(keys(&record["sets"][0]), ["correspondences", "inliers", "name"]);
    assert_eq!(record["config"]["scale"]["kind"], "indoor");
    let timings = record["timings_s"].as_object().unwrap();
    let seconds = |name: &str| timings[name].as_f64().unwrap();
    assert!(seconds("total") >= seconds("read") + seconds("encode"));
    // A number that is not finite would be written as null; in the settings null stands for "no limit".
    let mut evidence = record;
    evidence["config"].take();
    assert_eq!(evidence.to_string().matches("null").count(), 1);
}

#[test]
fn the_record_says_what_was_compared_and_why() {
    let workplace = Workplace::with_pair();
    assert_eq!(workplace.refine(&["--json", "out.json"]).code, 0);
    let record = workplace.json("out.json");
    let mut signals = [
        "agreement",
        "occlusion",
        "gross_violations",
        "normal_agreement",
        "correlation",
        "support",
        "log_weaker_support",
    ];
    signals.sort_unstable();
    assert_eq!(keys(&record["signals"]), signals);
    assert_eq!(keys(&record["evidence"]), ["consistency", "contact", "support"]);
    let evidence = &record["evidence"];
    let number = |value: &serde_json::Value| value.as_f64().unwrap();
    let support = &evidence["support"];
    let share = number(&support["inliers"]) / number(&support["matches"]);
    assert!((number(&record["signals"]["support"]) - share).abs() < 1e-12 && share > 0.0);
    let contact = number(&evidence["contact"]["normal_agreement"]);
    assert_eq!(number(&record["signals"]["normal_agreement"]), contact);
    // The initial transform was one of those compared; all are probabilities of something.
    let hypotheses = record["hypotheses"].as_array().unwrap();
    assert!(hypotheses.len() > 1);
    assert!(hypotheses.iter().any(|one| one["target_from_source"] == record["initial"]));
    for one in hypotheses {
        assert_eq!(keys(one), ["from_initial", "matched", "probability", "target_from_source"]);
        assert!((0.0..=1.0).contains(&number(&one["probability"])) && one["matched"].is_boolean());
    }
}

#[test]
fn two_clouds_are_registered_from_nothing() {
    let workplace = Workplace::with_pair();
    let outcome = workplace.run(&["register", "source.xyz", "reference.xyz", "--json", "out.json"]);
    assert_eq!(outcome.code, 0, "{outcome:?}");
    assert_near_truth(&outcome);
    let record = workplace.json("out.json");
    let without_initial: Vec<&str> = KEYS.into_iter().filter(|key| *key != "initial").collect();
    assert_eq!(keys(&record), without_initial);
    assert_eq!(record["verdict"], "refined");
    assert_eq!(record["config"]["init_method"], "sc2-pcr");
}

#[test]
fn clouds_that_do_not_overlap_are_rejected_with_a_best_guess() {
    let workplace = Workplace::with_pair();
    let ball: Vec<Point3<f64>> = (0..3000)
        .map(|i| {
            let height = 2.0 * (f64::from(i) + 0.5) / 3000.0 - 1.0;
            let (angle, radius) = (f64::from(i) * 0.618 * TAU, (1.0 - height * height).sqrt());
            Point3::new(radius * angle.cos(), radius * angle.sin(), height + 40.0)
        })
        .collect();
    workplace.cloud("reference.xyz", &ball);
    let outcome = workplace.refine(&["--output", "out.txt", "--json", "out.json"]);
    assert_eq!(outcome.code, 1, "{outcome:?}");
    assert!(outcome.stderr.contains("rejected"), "{outcome:?}");
    assert_eq!(workplace.text("out.txt"), outcome.stdout);
    outcome.pose();
    assert_eq!(workplace.json("out.json")["verdict"], "rejected");
}

#[test]
fn the_number_of_threads_does_not_matter() {
    let workplace = Workplace::with_pair();
    let with_threads = |threads: &str| {
        let outcome = workplace.refine(&[
            "--threads",
            threads,
            "--json",
            "out.json",
            "--save-aligned",
            "aligned.ply",
        ]);
        let mut record = workplace.json("out.json");
        assert_eq!(record["config"]["threads"].to_string(), threads);
        record["config"]["threads"].take();
        record["timings_s"].take();
        (outcome.stdout, record, workplace.read("aligned.ply"))
    };
    assert_eq!(with_threads("1"), with_threads("2"));
}

#[test]
fn the_opposite_direction_is_the_inverse() {
    let workplace = Workplace::with_pair();
    let forward = rare::io::read_pose(workplace.path("initial.txt")).unwrap();
    workplace.pose("back.txt", &forward.inverse());
    // Inverting twice rounds twice, so the forward start is what reading the other file gives.
    let back = rare::io::read_pose(workplace.path("back.txt")).unwrap();
    workplace.pose("initial.txt", &back.inverse());
    let pair = ["refine", "source.xyz", "reference.xyz", "--init", "back.txt"];
    let outputs = ["--json", "out.json"];
    let direction = ["--init-direction", "target-to-source"];
    let inverted = workplace.run(&[&pair[..], &outputs, &direction].concat());
    assert_eq!(inverted.code, 0, "{inverted:?}");
    let difference = inverted.pose().error_to(&workplace.refine(&[]).pose());
    assert!(difference.translation < 1e-6, "{difference:?}");
    let initial = |record: serde_json::Value| record["initial"][0][3].as_f64().unwrap();
    let inverted_start = initial(workplace.json("out.json"));
    assert!((inverted_start - forward.translation().x).abs() < 1e-12);
    workplace.run(&[&pair[..], &outputs].concat());
    let start = initial(workplace.json("out.json"));
    assert!((start - forward.inverse().translation().x).abs() < 1e-12);
}

#[test]
fn georeferenced_clouds_move_the_same_to_the_millimetre() {
    let workplace = Workplace::empty();
    let utm = Vector3::new(500_000.0, 5_400_000.0, 120.0);
    let run = |shift: Vector3<f64>| {
        let [source, reference] = pair().map(|points| shifted(&points, shift));
        workplace.cloud("source.xyz", &source);
        workplace.cloud("reference.xyz", &reference);
        workplace.pose("initial.txt", &about(&start(), shift));
        let outcome = workplace.refine(&["--profile", "object", "--save-aligned", "aligned.xyz"]);
        assert_eq!(outcome.code, 0, "{outcome:?}");
        outcome.pose()
    };
    let (near, far) = (run(Vector3::zeros()), run(utm));
    for point in &pair()[0][..20] {
        let moved = far.apply(&(point + utm)) - utm;
        let apart = (moved - near.apply(point)).norm();
        assert!(apart < 1e-3, "{apart}");
    }
    let aligned = rare::io::read_cloud(workplace.path("aligned.xyz")).unwrap().world_points();
    for (point, moved) in pair()[0].iter().zip(&aligned) {
        assert!((moved - utm - near.apply(point).coords).coords.norm() < 1e-3);
    }
}

#[test]
fn quiet_is_silent_and_points_that_are_not_finite_are_warned_about() {
    let workplace = Workplace::with_pair();
    let quiet = workplace.refine(&["--quiet"]);
    assert_eq!((quiet.code, quiet.stderr.as_str()), (0, ""));
    let holes = workplace.text("source.xyz") + "nan nan nan\n1 inf 2\n";
    workplace.write("source.xyz", holes);
    let outcome = workplace.refine(&["--json", "out.json"]);
    assert_eq!(outcome.stdout, quiet.stdout);
    assert!(outcome.stderr.contains("warning: 2 points of the source"), "{outcome:?}");
    assert_eq!(workplace.json("out.json")["warnings"].as_array().unwrap().len(), 1);
    assert_eq!(workplace.refine(&["-q"]).stderr, "");
}
