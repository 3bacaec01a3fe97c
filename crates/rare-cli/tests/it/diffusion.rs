//! `--encoder diffusion`, with a pipeline of the real topology and formats whose weights nobody trained: everything but
//! the accuracy can be seen.

use std::path::{Path, PathBuf};

use crate::shared::{Outcome, Workplace, argument, keys, shared_path};

fn pipeline() -> Option<PathBuf> {
    shared_path("golden/rare/tiny-pipeline")
}

/// A real pair in a folder, with a start near the truth, and the pipeline.
fn real_pair() -> Option<(Workplace, PathBuf)> {
    let pipeline = pipeline()?;
    let folder = shared_path("data/redkitchen-dev/frag50")?;
    let workplace = Workplace::empty();
    let text = std::fs::read_to_string(folder.join("init_pert_easy.json")).unwrap();
    let starts: serde_json::Value = serde_json::from_str(&text).unwrap();
    let pair = &starts["pairs"][0];
    for (name, side) in [("source.ply", "src"), ("reference.ply", "ref")] {
        let cloud = folder.join(format!("cloud_bin_{}.ply", pair[side]));
        std::fs::copy(cloud, workplace.path(name)).unwrap();
    }
    let rows = pair["init"].as_array().unwrap().iter();
    let row = |row: &serde_json::Value| {
        row.as_array().unwrap().iter().map(ToString::to_string).collect::<Vec<_>>().join(" ")
    };
    workplace.write("initial.txt", rows.map(row).collect::<Vec<_>>().join("\n"));
    Some((workplace, pipeline))
}

fn refine(workplace: &Workplace, pipeline: &Path, more: &[&str]) -> Outcome {
    let pair = ["refine", "source.ply", "reference.ply", "--init", "initial.txt"];
    let encoder = ["--encoder", "diffusion", "--weights", argument(pipeline)];
    let outcome = workplace.run(&[&pair[..], &encoder, more].concat());
    // Features that mean nothing may leave nothing to be trusted.
    assert!(outcome.code < 2, "{outcome:?}");
    outcome
}

#[test]
fn a_real_pair_runs_through_the_networks_and_says_what_it_used() {
    let Some((workplace, pipeline)) = real_pair() else { return };
    let run = |threads| {
        let more = ["--threads", threads, "--json", "out.json", "--seed", "7", "--rounds", "1"];
        refine(&workplace, &pipeline, &more)
    };
    let one = run("1");
    assert!(one.stderr.contains("warning") && one.stderr.contains("not"), "{one:?}");
    let record = workplace.json("out.json");
    let diffusion = &record["config"]["diffusion"];
    for key in ["prompt", "negative_prompt", "steps", "guidance", "time", "seed", "layers"] {
        assert!(keys(diffusion).contains(&key.to_owned()), "{key} is not in {diffusion}");
    }
    assert_eq!(
        (diffusion["seed"].as_u64(), diffusion["maps_encoded"].as_u64()),
        (Some(7), Some(4))
    );
    assert_eq!(diffusion["weights_fingerprint"].as_str().unwrap().len(), 64);
    assert!(diffusion["weights_remark"].is_string(), "{diffusion}");
    assert!(diffusion["prompt"].as_str().unwrap().contains("room"), "{diffusion}");
    let recipe = &record["config"]["recipe"];
    assert_eq!(
        (recipe["components"].as_u64(), &recipe["aligned_corners"]),
        (Some(128), &true.into())
    );
    assert_eq!(run("2").stdout, one.stdout);
    let untimed = |mut record: serde_json::Value| {
        record["timings_s"].take();
        record["config"]["threads"].take();
        record
    };
    assert_eq!(untimed(workplace.json("out.json")), untimed(record));
}

#[test]
fn recorded_and_cached_features_give_the_identical_result() {
    let Some((workplace, pipeline)) = real_pair() else { return };
    let maps = |name: &str| {
        let diffusion = workplace.json(name)["config"]["diffusion"].clone();
        ["maps_encoded", "maps_cached"].map(|key| diffusion[key].as_u64().unwrap())
    };
    let cached = ["--rounds", "1", "--cache", "cache", "--json"];
    let first = refine(&workplace, &pipeline, &[&cached[..], &["first.json"]].concat());
    let second = refine(&workplace, &pipeline, &[&cached[..], &["second.json"]].concat());
    assert_eq!(second.stdout, first.stdout);
    assert_eq!((maps("first.json"), maps("second.json")), ([4, 0], [0, 4]));
    // Other settings, other features.
    let other =
        refine(&workplace, &pipeline, &[&cached[..], &["other.json", "--time", "300"]].concat());
    assert_eq!(maps("other.json"), [4, 0], "{other:?}");
    let files = std::fs::read_dir(workplace.path("cache")).unwrap();
    let names = files.map(|file| file.unwrap().file_name().into_string().unwrap());
    assert!(names.into_iter().all(|name| name.ends_with(".features")));
    let pair =
        ["features", "source.ply", "reference.ply", "--init", "initial.txt", "--output", "f.npz"];
    let encoder = ["--encoder", "diffusion", "--weights", argument(&pipeline), "--cache", "cache"];
    let features = workplace.run(&[&pair[..], &encoder].concat());
    assert_eq!(features.code, 0, "{features:?}");
    assert!(features.stderr.contains("4 depth maps (3 layers each)"), "{features:?}");
    let again = ["refine", "source.ply", "reference.ply", "--init", "initial.txt"];
    let recorded = workplace.run(&[&again[..], &["--depth-features", "f.npz"]].concat());
    assert_eq!(recorded.stdout, first.stdout);
}

#[test]
fn impossible_settings_and_weights_are_named() {
    let Some(pipeline) = pipeline() else { return };
    let workplace = Workplace::with_pair();
    let refused = |more: &[&str], words: &[&str]| {
        let encoder = ["--encoder", "diffusion", "--quiet"];
        workplace.refine(&[&encoder[..], more].concat()).assert_refused(words);
    };
    let with_weights = |more: &[&str], words: &[&str]| {
        refused(&[&["--weights", argument(&pipeline)], more].concat(), words);
    };
    refused(&["--weights", "nowhere"], &["--weights", "nowhere"]);
    std::fs::create_dir(workplace.path("empty")).unwrap();
    refused(&["--weights", "empty"], &["--weights", "empty"]);
    with_weights(&["--layers", "0,13"], &["13", "12"]);
    with_weights(&["--guidance", "-1"], &["guidance -1"]);
    with_weights(&["--guidance", "NaN"], &["guidance NaN"]);
    with_weights(&["--steps", "2000"], &["2000"]);
    with_weights(&["--time", "1000"], &["1000"]);
    with_weights(&["--prompt", &"kitchen ".repeat(80)], &["77"]);
    with_weights(&["--cache", "source.xyz"], &["--cache", "source.xyz"]);
    let without = workplace.refine(&["--layers", "0"]);
    without.assert_refused(&["--encoder diffusion"]);
    let both = ["--encoder", "diffusion", "--depth-features", "f.npz"];
    workplace.refine(&both).assert_refused(&["--encoder diffusion", "f.npz"]);
    workplace.write("rare.toml", "encoder = \"diffusion\"\n[diffusion]\nlayers = [3, 0]\n");
    workplace.refine(&["--config", "rare.toml"]).assert_refused(&["[3, 0]"]);
    workplace.write("rare.toml", "encoder = \"diffusion\"\n[diffusion]\nlayer = [3]\n");
    workplace.refine(&["--config", "rare.toml"]).assert_refused(&["rare.toml", "line 3", "layer"]);
}
