//! Where results may be written: decided before any work, and files come whole or not at all.

use std::process::{Command, Stdio};

use crate::shared::{Workplace, argument};

#[test]
fn a_folder_that_does_not_exist_is_refused_before_work() {
    let workplace = Workplace::with_pair();
    // The source is damaged as well: that it is not complained about shows what is looked at first.
    workplace.write("source.xyz", "oops\n");
    for option in ["--output", "--json", "--save-aligned"] {
        let outcome = workplace.refine(&[option, "nowhere/out.ply"]);
        outcome.assert_refused(&[option, "nowhere", "does not exist"]);
    }
    workplace.refine(&["--save-aligned", "out.las"]).assert_refused(&["out.las", ".ply"]);
    workplace.refine(&["--output", "."]).assert_refused(&["folder"]);
}

#[test]
fn an_input_is_never_overwritten() {
    let workplace = Workplace::with_pair();
    workplace.write("rare.toml", "seed = 1\n");
    std::fs::create_dir(workplace.path("sub")).unwrap();
    let absolute = workplace.path("source.xyz");
    let mut spellings = vec![argument(&absolute), "sub/../source.xyz", "./reference.xyz"];
    spellings.extend(["initial.txt", "rare.toml"]);
    #[cfg(unix)]
    {
        std::os::unix::fs::symlink("source.xyz", workplace.path("link.xyz")).unwrap();
        spellings.push("link.xyz");
    }
    let before = workplace.read("source.xyz");
    for spelling in spellings {
        let outcome = workplace.refine(&["--config", "rare.toml", "--output", spelling]);
        outcome.assert_refused(&["--output", spelling, "input"]);
    }
    let convert = workplace.run(&["convert", "source.xyz", "./source.xyz"]);
    convert.assert_refused(&["source.xyz", "input"]);
    assert_eq!(workplace.read("source.xyz"), before);
}

#[test]
fn two_outputs_are_two_files() {
    let workplace = Workplace::with_pair();
    let outcome = workplace.refine(&["--output", "out.txt", "--json", "./out.txt"]);
    outcome.assert_refused(&["--output", "--json", "same file"]);
    assert!(!workplace.path("out.txt").exists());
}

#[test]
fn all_files_say_the_same() {
    let workplace = Workplace::with_pair();
    let outcome = workplace.refine(&[
        "--output",
        "out.txt",
        "--json",
        "out.json",
        "--save-aligned",
        "aligned.xyz",
    ]);
    assert_eq!(outcome.code, 0, "{outcome:?}");
    assert_eq!(workplace.text("out.txt"), outcome.stdout);
    let pose = outcome.pose();
    let recorded = rare::io::read_pose(workplace.path("out.json")).unwrap();
    assert!((recorded.to_matrix() - pose.to_matrix()).amax() < 1e-12);
    let source = rare::io::read_cloud(workplace.path("source.xyz")).unwrap();
    let aligned = rare::io::read_cloud(workplace.path("aligned.xyz")).unwrap();
    assert_eq!(source.len(), aligned.len());
    for (point, moved) in source.points().iter().zip(aligned.points()) {
        assert!((pose.apply(point) - moved).norm() < 1e-9);
    }
}

#[test]
fn a_reader_that_has_left_is_no_failure() {
    // The work takes long enough for the reader to be gone when the transform is printed.
    let workplace = Workplace::with_pair();
    let mut child = Command::new(env!("CARGO_BIN_EXE_rare"))
        .args(["refine", "source.xyz", "reference.xyz", "--init", "initial.txt", "-q"])
        .current_dir(workplace.path("."))
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    drop(child.stdout.take());
    let output = child.wait_with_output().unwrap();
    assert_eq!((output.status.code(), output.stderr.as_slice()), (Some(0), &b""[..]));
}
