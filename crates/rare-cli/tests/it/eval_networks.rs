//! Evaluations in which networks on points have a part.

use serde_json::Value;

use crate::backbones::{filter as filter_weights, weights as network_weights};
use crate::eval::{benchmark, lines as lines_of, three_d_match};
use crate::shared::argument;

#[test]
fn networks_are_evaluated_beside_other_methods() {
    let workplace = benchmark();
    let Some(predator) = network_weights(&workplace, "predator_tiny") else { return };
    let Some(pointdsc) = filter_weights("pointdsc") else { return };
    let evaluation = ["eval", "folder", "room", "--out", "out", "--limit", "2", "-q"];
    let networks = ["--backbone", "predator", "--weights", &predator, "--weights"];
    let methods = ["--methods", "init,ransac-50k,sc2-pcr++,pointdsc,refine"];
    let arguments = [&evaluation[..], &networks, &[argument(&pointdsc)], &methods].concat();
    let outcome = workplace.run(&arguments);
    assert_eq!(outcome.code, 0, "{outcome:?}");
    let lines = lines_of(&workplace, "out");
    assert_eq!(lines.len(), 10, "{lines:?}");
    let settings = workplace.json("out/benchmark.json")["settings"].clone();
    assert_eq!(settings["start"], "described", "{settings}");
    assert_eq!(settings["backbone"]["network"], "predator");
    // The features of a network can also be refined from transforms that came from elsewhere.
    let given = ["--init", "init.json", "--methods", "refine"];
    let backbone = ["--backbone", "predator", "--weights", &predator];
    let evaluation = ["eval", "folder", "room", "--out", "given", "--limit", "1", "-q"];
    let outcome = workplace.run(&[&evaluation[..], &given, &backbone].concat());
    assert_eq!(outcome.code, 0, "{outcome:?}");
    let line = &lines_of(&workplace, "given")[0];
    assert!(line["target_from_source"].is_array(), "{line}");
    let missing = ["eval", "folder", "room", "--out", "none", "--methods", "vbreg"];
    workplace.run(&missing).assert_refused(&["vbreg", "VBReg", "--weights"]);
}

#[test]
fn weights_fill_rows_of_the_papers_tables() {
    let workplace = three_d_match();
    let Some(predator) = network_weights(&workplace, "predator_tiny") else { return };
    let Some(pointdsc) = filter_weights("pointdsc") else { return };
    let weights = ["--weights", &predator, "--weights", argument(&pointdsc)];
    let outcome =
        workplace.run(&[&["eval", "paper", "data", "--out", "out", "-q"][..], &weights].concat());
    assert_eq!(outcome.code, 0, "{outcome:?}");
    let text = workplace.text("out/paper.txt");
    assert!(!text.contains("PointDSC: not run: no --weights of PointDSC for 3DMatch"), "{text}");
    assert!(!text.contains("no --weights of Predator for 3DMatch"), "{text}");
    assert!(text.contains("no --weights of FCGF for 3DMatch"), "{text}");
    assert!(workplace.path("out/3DMatch-predator/results.jsonl").is_file());
}

#[test]
fn estimators_need_no_pose_of_the_network() {
    let workplace = benchmark();
    let Some(network) = network_weights(&workplace, "geotransformer_tiny") else { return };
    let evaluation = ["eval", "folder", "room", "--out", "out", "--limit", "2", "-q"];
    let backbone = ["--backbone", "geotransformer", "--weights", &network];
    let methods = ["--methods", "init,ransac-50k"];
    let outcome = workplace.run(&[&evaluation[..], &backbone, &methods].concat());
    assert_eq!(outcome.code, 0, "{outcome:?}");
    let lines = lines_of(&workplace, "out");
    let of = |pair: usize, method: &str| {
        let is_it = |line: &&Value| line["pair"] == pair && line["method"] == method;
        lines.iter().find(is_it).unwrap().clone()
    };
    // Nobody trained the network: its own registration finds nothing, which is no matter of RANSAC's.
    for pair in 0..2 {
        let (own, ransac) = (of(pair, "init"), of(pair, "ransac-50k"));
        assert!(own["target_from_source"].is_null() && own["error"].is_string(), "{own}");
        assert_ne!(own["error"], ransac["error"], "{ransac}");
    }
    // Other limits give other results: they need another folder.
    let limits = ["--neighbor-limits", "9,9,9,9"];
    let other = workplace.run(&[&evaluation[..], &backbone, &methods, &limits].concat());
    other.assert_refused(&["out"]);
}
