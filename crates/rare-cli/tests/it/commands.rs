//! `info`, `convert`, `demo` and `completions`.

use crate::shared::{Workplace, added};

#[test]
fn info_says_what_is_in_a_file() {
    let workplace = Workplace::with_pair();
    let outcome = workplace.run(&["info", "source.xyz", "reference.xyz"]);
    assert_eq!((outcome.code, outcome.stderr.as_str()), (0, ""));
    let count = rare::io::read_cloud(workplace.path("source.xyz")).unwrap().len().to_string();
    let words = ["source.xyz", "reference.xyz", &count, "text", "extent", "indoor", "voxel"];
    for word in words {
        assert!(outcome.stdout.contains(word), "{word} is missing in {outcome:?}");
    }
    workplace.run(&["info", "source.xyz", "missing.ply"]).assert_refused(&["missing.ply"]);
}

#[test]
fn a_converted_cloud_has_the_same_points() {
    let workplace = Workplace::with_pair();
    for name in ["out.ply", "out.pcd", "out.npy"] {
        let outcome = workplace.run(&["convert", "source.xyz", name]);
        assert_eq!((outcome.code, outcome.stdout.as_str()), (0, ""), "{outcome:?}");
        assert!(outcome.stderr.contains(name));
    }
    let source = rare::io::read_cloud(workplace.path("source.xyz")).unwrap();
    let copy = rare::io::read_cloud(workplace.path("out.npy")).unwrap();
    assert_eq!(source.points(), copy.points());
    workplace.run(&["convert", "source.xyz", "out.laz"]).assert_refused(&["out.laz", ".ply"]);
    workplace.run(&["convert", "source.xyz", "no/out.ply"]).assert_refused(&["does not exist"]);
}

#[test]
fn the_demo_comes_close_to_the_truth() {
    let workplace = Workplace::empty();
    let outcome = workplace.run(&["demo"]);
    assert_eq!(outcome.code, 0, "{outcome:?}");
    let degrees = |name: &str| -> f64 {
        let line = outcome.stderr.lines().find(|line| line.trim().starts_with(name)).unwrap();
        line.split_whitespace().nth(2).unwrap().parse().unwrap()
    };
    assert!(degrees("before") > 11.0 && degrees("after") < 1.0, "{outcome:?}");
    assert_eq!(added(&[], &workplace.names()), ["rare-demo"]);
    for name in ["source.ply", "reference.ply", "before.ply", "after.ply"] {
        assert!(rare::io::read_cloud(workplace.path("rare-demo").join(name)).unwrap().len() > 1000);
    }
    assert_eq!(workplace.text("rare-demo/result.txt"), outcome.stdout);
    assert_eq!(workplace.json("rare-demo/result.json")["verdict"], "refined");
    // What the demo says how to repeat gives the same.
    let again = outcome.stderr.lines().last().unwrap().trim().strip_prefix("rare ").unwrap();
    let again: Vec<&str> = again.split(' ').collect();
    assert_eq!(workplace.run(&again).stdout, outcome.stdout);
}

#[test]
fn every_shell_gets_its_completions() {
    let workplace = Workplace::empty();
    for shell in ["bash", "zsh", "fish", "powershell", "elvish"] {
        let outcome = workplace.run(&["completions", shell]);
        assert_eq!((outcome.code, outcome.stderr.as_str()), (0, ""));
        assert!(outcome.stdout.contains("init-direction"), "{shell}");
    }
    assert_eq!(workplace.run(&["completions", "tcsh"]).code, 2);
}

#[test]
fn help_states_direction_and_units() {
    let workplace = Workplace::empty();
    for command in ["register", "refine"] {
        let help = workplace.run(&[command, "--help"]).stdout;
        for word in ["Examples:", "frame", "metres", "[default: auto"] {
            assert!(help.contains(word), "{word} is missing in the help of {command}");
        }
    }
    assert_eq!(workplace.run(&[]).code, 2);
}
