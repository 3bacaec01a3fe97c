//! `--backbone`, learned `--init-method`s and `rare weights check FILE`, with small networks that nobody trained:
//! everything but the accuracy can be seen.

use std::fs;
use std::path::PathBuf;

use rare::io::NpzFile;
use serde_json::Value;

use crate::shared::{Workplace, argument, keys, shared_path};

/// The small networks that were recorded: name, golden file.
const BACKBONES: [(&str, &str); 3] = [
    ("geotransformer", "geotransformer_tiny"),
    ("predator", "predator_tiny"),
    ("cofinet", "cofinet_tiny"),
];

/// Copies the weights of a recorded network under their official names.
pub(crate) fn weights(workplace: &Workplace, golden: &str) -> Option<String> {
    let path = shared_path(&format!("golden/backbones/{golden}.weights.safetensors"))?;
    let tensors = Tensors::read(&fs::read(path).unwrap());
    let name = format!("{golden}.safetensors");
    workplace
        .write(&name, tensors.renamed(|name| name.trim_start_matches("w.").to_owned()).bytes());
    Some(name)
}

/// The weights of a recorded filter.
pub(crate) fn filter(name: &str) -> Option<PathBuf> {
    shared_path(&format!("golden/estimators/{name}_random.safetensors"))
}

/// A safetensors file, taken apart.
struct Tensors {
    header: serde_json::Map<String, Value>,
    data: Vec<u8>,
}

impl Tensors {
    fn read(bytes: &[u8]) -> Tensors {
        let length = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
        let header = serde_json::from_slice(&bytes[8..8 + length]).unwrap();
        Tensors { header, data: bytes[8 + length..].to_vec() }
    }

    fn renamed(self, rename: impl Fn(&str) -> String) -> Tensors {
        let header = self.header.into_iter().map(|(name, entry)| (rename(&name), entry)).collect();
        Tensors { header, ..self }
    }

    fn bytes(&self) -> Vec<u8> {
        let header = serde_json::to_vec(&self.header).unwrap();
        let length = (header.len() as u64).to_le_bytes();
        [&length[..], &header, &self.data].concat()
    }

    /// The bytes of a tensor.
    fn place(&self, name: &str) -> std::ops::Range<usize> {
        let ends = &self.header[name]["data_offsets"];
        let end = |index: usize| ends[index].as_u64().unwrap() as usize;
        end(0)..end(1)
    }
}

#[test]
fn every_network_describes_a_pair_and_its_features_are_refined() {
    for (backbone, golden) in BACKBONES {
        let workplace = Workplace::with_pair();
        let Some(weights) = weights(&workplace, golden) else { return };
        let network = ["--backbone", backbone, "--weights", &weights, "--keypoints", "300"];
        let features = ["features", "source.xyz", "reference.xyz", "--output", "pair.npz", "-q"];
        let outcome = workplace.run(&[&features[..], &network].concat());
        assert_eq!(outcome.code, 0, "{outcome:?}");
        let mut file = NpzFile::open(workplace.path("pair.npz")).unwrap();
        let points = file.array_f64("source_points").unwrap().shape;
        let values = file.array_f32("source_features").unwrap();
        assert!(points[0] > 20 && points[0] <= 300, "{backbone}: {points:?}");
        assert_eq!(values.shape[0], points[0]);
        assert!(values.values.iter().all(|value| value.is_finite()));
        let pairs = file.array_f64("src_corr_points").unwrap().shape[0];
        assert!(pairs > 20, "{backbone}: {pairs} correspondences");
        // What was written serves as features and as correspondences.
        let both = ["--source-features", "pair.npz", "--reference-features", "pair.npz"];
        let from_file = workplace.refine(&[&both[..], &["--json", "file.json"]].concat());
        let at_once = workplace.refine(&[&network[..], &["--json", "once.json"]].concat());
        assert_eq!((from_file.code, at_once.code), (0, 0), "{from_file:?} {at_once:?}");
        assert_eq!(from_file.stdout, at_once.stdout, "{backbone}");
        let record = workplace.json("once.json");
        let said = &record["config"]["backbone"];
        assert_eq!(said["network"], backbone);
        assert_eq!(said["trained_on"], "3dmatch");
        assert_eq!(said["selection"]["count"], 300);
        assert!(keys(&record["timings_s"]).contains(&"describe".to_owned()), "{record}");
        assert_eq!(workplace.refine(&["--correspondences", "pair.npz"]).code, 0);
    }
}

#[test]
fn registration_begins_with_the_networks_own_pose_or_with_another_estimator() {
    let workplace = Workplace::with_pair();
    let Some(weights) = weights(&workplace, "geotransformer_tiny") else { return };
    let pair = ["register", "source.xyz", "reference.xyz", "--backbone", "geotransformer"];
    let run = |more: &[&str]| workplace.run(&[&pair[..], &["--weights", &weights], more].concat());
    for threads in ["1", "3"] {
        let outcome = run(&["--init-method", "sc2-pcr", "--threads", threads]);
        assert!(outcome.code < 2, "{outcome:?}");
        workplace.write(threads, outcome.stdout);
    }
    assert_eq!(workplace.text("1"), workplace.text("3"), "threads must not matter");
    let own = run(&["--json", "own.json"]);
    // A network that nobody trained may well find nothing.
    assert!(own.code < 2, "{own:?}");
    if own.stdout.is_empty() {
        own.assert_refused_pose(&["the network found no transform", "--init-method"]);
    } else {
        let config = &workplace.json("own.json")["config"];
        assert!(config.get("init_method").is_none(), "{config}");
    }
}

#[test]
fn filters_make_initial_transforms_of_built_in_matches() {
    let workplace = Workplace::with_pair();
    for name in ["pointdsc", "vbreg"] {
        let Some(file) = filter(name) else { return };
        let pair = ["register", "source.xyz", "reference.xyz", "--json", "out.json"];
        let method = ["--init-method", name, "--weights", argument(&file)];
        let outcome = workplace.run(&[&pair[..], &method].concat());
        assert!(outcome.code < 2, "{outcome:?}");
        let config = workplace.json("out.json")["config"].clone();
        assert_eq!(
            (&config["init_method"], &config["filter"]["network"]),
            (&name.into(), &name.into())
        );
        let missing = workplace.run(&[&pair[..], &["--init-method", name]].concat());
        missing.assert_refused(&[name, "--weights", "rare weights list"]);
    }
}

#[test]
fn a_file_says_of_which_network_it_is_and_what_it_lacks() {
    let workplace = Workplace::empty();
    for (backbone, golden) in BACKBONES {
        let Some(weights) = weights(&workplace, golden) else { return };
        let outcome = workplace.run(&["weights", "check", &weights]);
        assert_eq!(outcome.code, 0, "{outcome:?}");
        let said = outcome.stdout.to_lowercase();
        assert!(said.contains(&format!("network           {backbone}\n")), "{said}");
        assert!(said.contains("missing           none") && said.contains("0.1 m"), "{said}");
    }
    for name in ["PointDSC", "VBReg"] {
        let Some(file) = filter(&name.to_lowercase()) else { return };
        let outcome = workplace.run(&["weights", "check", argument(&file)]);
        assert_eq!(outcome.code, 0, "{outcome:?}");
        assert!(outcome.stdout.contains(name), "{outcome:?}");
    }
    let whole = Tensors::read(&workplace.read("predator_tiny.safetensors"));
    let other = whole.renamed(|name| name.replace("bottle", "neck"));
    workplace.write("other.safetensors", other.bytes());
    let outcome = workplace.run(&["weights", "check", "other.safetensors"]);
    assert_eq!(outcome.code, 2, "{outcome:?}");
    assert!(outcome.stdout.contains("bottle.weight") && outcome.stdout.contains("neck.weight"));
}

#[test]
fn weights_that_do_not_fit_are_named() {
    let workplace = Workplace::with_pair();
    let Some(weights) = weights(&workplace, "predator_tiny") else { return };
    let refused = |more: &[&str], words: &[&str]| {
        let pair = ["register", "source.xyz", "reference.xyz"];
        workplace.run(&[&pair[..], more].concat()).assert_refused(words);
    };
    let predator = ["--backbone", "predator", "--weights"];
    // Another network, none at all, one that nothing uses.
    refused(
        &["--backbone", "cofinet", "--weights", &weights],
        &["Predator", &weights, "--backbone predator"],
    );
    refused(&["--backbone", "predator"], &["Predator", "--weights", "rare weights list"]);
    refused(&["--weights", &weights], &["Predator", "--backbone predator"]);
    let features = ["features", "source.xyz", "--output", "f.npz", "--weights", &weights];
    workplace.run(&features).assert_refused(&["Predator", "--backbone predator"]);
    let fcgf = ["--backbone", "fcgf", "--neighbor-limits", "3,3"];
    refused(&fcgf, &["--neighbor-limits", "FCGF"]);
    refused(&[&predator[..], &["nowhere.pth"]].concat(), &["--weights nowhere.pth"]);
    refused(&["--neighbor-limits", "3,3,3,3"], &["--neighbor-limits", "--backbone"]);
    // Cut off, damaged, with code in it.
    let bytes = workplace.read(&weights);
    workplace.write("cut.safetensors", &bytes[..bytes.len() / 2]);
    refused(&[&predator[..], &["cut.safetensors"]].concat(), &["cut.safetensors", "truncated"]);
    let mut damaged = Tensors::read(&bytes);
    let place = damaged.place("proj_gnn.bias");
    damaged.data[place.start..place.start + 4].copy_from_slice(&f32::NAN.to_le_bytes());
    workplace.write("nan.safetensors", damaged.bytes());
    refused(
        &[&predator[..], &["nan.safetensors"]].concat(),
        &["nan.safetensors", "proj_gnn.bias", "not finite"],
    );
    workplace.write("code.pkl", b"\x80\x02cos\nsystem\nX\x04\x00\x00\x00true\x85R.");
    refused(&[&predator[..], &["code.pkl"]].concat(), &["code.pkl", "os.system"]);
}

#[test]
fn clouds_that_do_not_fit_are_named() {
    let workplace = Workplace::with_pair();
    let Some(weights) = weights(&workplace, "geotransformer_tiny") else { return };
    let network = ["--backbone", "geotransformer", "--weights", &weights];
    let run = |source: &str, more: &[&str]| {
        workplace.run(&[&["register", source, "reference.xyz"][..], &network, more].concat())
    };
    run("source.xyz", &["--neighbor-limits", "3,3"]).assert_refused(&["[3, 3]", "4"]);
    workplace.write("few.xyz", "0 0 0\n0.1 0 0\n0 0.1 0\n0 0 0.1\n");
    let few = run("few.xyz", &[]);
    assert_eq!(few.code, 2, "{few:?}");
    // In millimetres, the points lie a thousand times as far apart as those of the training.
    let sparse: String = workplace
        .text("source.xyz")
        .lines()
        .map(|line| {
            let numbers = line.split_whitespace().map(|word| word.parse::<f64>().unwrap());
            numbers.map(|number| format!("{} ", 1000.0 * number)).collect::<String>() + "\n"
        })
        .collect();
    workplace.write("sparse.xyz", sparse);
    let outcome = run("sparse.xyz", &[]);
    assert!(outcome.stderr.contains("0.1 m apart") || outcome.code == 2, "{outcome:?}");
}

#[test]
fn one_configuration_serves_commands_that_estimate_nothing() {
    let workplace = Workplace::with_pair();
    let Some(pointdsc) = filter("pointdsc") else { return };
    let file = format!("init-method = \"pointdsc\"\nweights = {:?}\n", argument(&pointdsc));
    workplace.write("rare.toml", file);
    let outcome = workplace.refine(&["--config", "rare.toml"]);
    assert_eq!(outcome.code, 0, "{outcome:?}");
    let pair = ["register", "source.xyz", "reference.xyz", "--config", "rare.toml"];
    let outcome = workplace.run(&[&pair[..], &["--json", "out.json"]].concat());
    assert!(outcome.code < 2, "{outcome:?}");
    assert_eq!(workplace.json("out.json")["config"]["init_method"], "pointdsc");
}

#[test]
fn the_list_says_where_a_person_finds_checkpoints() {
    let outcome = Workplace::empty().run(&["weights", "list"]);
    assert_eq!(outcome.code, 0);
    for word in ["geotransformer-3dmatch.pth.tar", "best_kitti.pth", "unknown", "a person must"] {
        assert!(outcome.stdout.contains(word), "{word}: {outcome:?}");
    }
}
