//! Flags and the configuration file.

use crate::shared::Workplace;

#[test]
fn a_configuration_file_equals_flags_and_flags_win() {
    let workplace = Workplace::with_pair();
    workplace.write(
        "rare.toml",
        "preset = \"paper\"\nprofile = \"indoor\"\nvoxel = 0.06\nseed = 7\njson = \"file.json\"\n",
    );
    let flags = ["--preset", "paper", "--profile", "indoor", "--voxel", "0.06", "--seed", "7"];
    let by_flags = workplace.refine(&[&flags[..], &["--json", "flags.json"]].concat());
    let by_file = workplace.refine(&["--config", "rare.toml"]);
    assert_eq!(by_file.stdout, by_flags.stdout);
    let config = |name: &str| workplace.json(name)["config"].clone();
    assert_eq!(config("file.json"), config("flags.json"));
    assert_eq!(config("file.json")["preset"], "paper");
    workplace.refine(&["--config", "rare.toml", "--voxel", "0.07", "--preset", "default"]);
    assert_eq!(config("file.json")["voxel"].as_f64().unwrap(), 0.07);
    assert_eq!(config("file.json")["preset"], "default");
    assert_eq!(config("file.json")["seed"], 7);
}

#[test]
fn steps_are_switched_off_by_flags_and_by_files() {
    let workplace = Workplace::with_pair();
    let steps = |more: &[&str]| {
        let outcome = workplace.refine(&[&["--json", "out.json"], more].concat());
        assert_eq!(outcome.code, 0, "{outcome:?}");
        let recipe = workplace.json("out.json")["config"]["recipe"].clone();
        ["verify", "search", "polish"].map(|step| recipe[step].as_bool().unwrap())
    };
    assert_eq!(steps(&[]), [true, true, true]);
    assert_eq!(steps(&["--no-search"]), [true, false, true]);
    assert_eq!(steps(&["--no-polish"]), [true, true, false]);
    // Where nothing is compared nothing is sought.
    assert_eq!(steps(&["--no-verify"]), [false, false, true]);
    assert_eq!(workplace.json("out.json")["hypotheses"].as_array().unwrap().len(), 2);
    workplace.write("rare.toml", "no-polish = true\nno-search = true\n");
    assert_eq!(steps(&["--config", "rare.toml"]), [true, false, false]);
    let timings = workplace.json("out.json")["timings_s"].clone();
    assert!(timings["polish"].is_null() && timings["search"].is_null(), "{timings}");
    workplace.write("rare.toml", "no-verify = true\nno-search = false\n");
    assert_eq!(steps(&["--config", "rare.toml", "--no-polish"]), [false, false, false]);
    workplace.write("rare.toml", "no-polish = \"yes\"\n");
    workplace.refine(&["--config", "rare.toml"]).assert_refused(&["rare.toml", "line 1"]);
}

#[test]
fn an_unknown_key_of_a_configuration_file_is_named() {
    let workplace = Workplace::with_pair();
    workplace.write("rare.toml", "seed = 1\nvoxels = 0.05\n");
    workplace.refine(&["--config", "rare.toml"]).assert_refused(&["rare.toml", "line 2", "voxels"]);
    workplace.write("rare.toml", "profile = \"desert\"\n");
    workplace.refine(&["--config", "rare.toml"]).assert_refused(&["rare.toml", "desert"]);
    workplace.refine(&["--config", "none.toml"]).assert_refused(&["none.toml"]);
}

#[test]
fn contradictions_and_impossible_values_are_refused() {
    let workplace = Workplace::with_pair();
    workplace.refine(&["--encoder", "recorded"]).assert_refused(&["--depth-features"]);
    workplace.refine(&["--voxel", "-1"]).assert_refused(&["-1", "positive"]);
    for words in [&["--quiet", "-v"][..], &["--profile", "desert"], &["--threads", "-1"]] {
        let outcome = workplace.refine(words);
        assert_eq!((outcome.code, outcome.stdout.as_str()), (2, ""), "{outcome:?}");
    }
}

#[test]
fn the_paper_looks_at_streets_through_one_camera() {
    let workplace = Workplace::with_pair();
    let camera = |more: &[&str]| {
        let fixed = ["--profile", "lidar", "--json", "out.json", "--voxel", "0.1"];
        workplace.refine(&[&fixed[..], more].concat());
        workplace.json("out.json")["config"]["camera"].clone()
    };
    assert_eq!(camera(&["--preset", "paper"]), "kitti");
    assert_eq!(camera(&["--preset", "paper", "--camera", "sensor"]), "sensor");
    assert_eq!(camera(&[]), "ring");
}
