//! Whatever is wrong with an input: exit code 2, one line that names the file, nothing written.

use rare::nalgebra::Point3;

use crate::shared::Workplace;

/// Registers a cloud that cannot be used, as source and as reference.
#[track_caller]
fn refuse_cloud(workplace: &Workplace, name: &str, words: &[&str]) {
    let before = workplace.names();
    let words = [&[name], words].concat();
    let outputs = ["--output", "out.txt", "--json", "out.json", "--save-aligned", "out.ply"];
    let source = ["register", name, "reference.xyz"];
    workplace.run(&[&source[..], &outputs].concat()).assert_refused(&words);
    let reference = ["refine", "source.xyz", name, "--init", "initial.txt"];
    workplace.run(&[&reference[..], &outputs].concat()).assert_refused(&words);
    assert_eq!(workplace.names(), before);
}

/// The same with a file of this content.
#[track_caller]
fn refuse_content(name: &str, content: impl AsRef<[u8]>, words: &[&str]) {
    let workplace = Workplace::with_pair();
    workplace.write(name, content);
    refuse_cloud(&workplace, name, words);
}

#[test]
fn a_file_that_is_not_there() {
    refuse_cloud(&Workplace::with_pair(), "missing.ply", &["no such file"]);
}

#[test]
fn a_folder() {
    let workplace = Workplace::with_pair();
    std::fs::create_dir(workplace.path("scans.ply")).unwrap();
    refuse_cloud(&workplace, "scans.ply", &["folder"]);
}

#[test]
fn an_unknown_extension() {
    refuse_content("cloud.obj", "v 1 2 3\n", &[".obj", ".ply"]);
}

#[test]
fn a_lying_extension() {
    refuse_content("cloud.ply", "1 2 3\n4 5 6\n7 8 10\n", &["named .ply"]);
}

#[test]
fn an_empty_file_and_an_empty_cloud() {
    refuse_content("cloud.xyz", "", &["empty"]);
    let header = "ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\n\
                  property float z\nend_header\n";
    refuse_content("cloud.ply", header, &["no point"]);
}

#[test]
fn fewer_than_three_points() {
    refuse_content("cloud.xyz", "0 0 1\n1 0 1\n", &["2 points", "at least 3"]);
}

#[test]
fn identical_points() {
    refuse_content("cloud.xyz", "1 2 3\n".repeat(50), &["identical"]);
}

#[test]
fn collinear_points() {
    let line: String = (0..50).map(|i| format!("{i} {} 1\n", 2 * i)).collect();
    refuse_content("cloud.xyz", line, &["one line"]);
}

#[test]
fn only_points_that_are_not_finite() {
    refuse_content("cloud.xyz", "nan nan nan\n".repeat(9), &["no finite point", "9"]);
}

#[test]
fn a_truncated_binary_file() {
    let workplace = Workplace::with_pair();
    workplace.cloud("cloud.ply", &[Point3::new(1.0, 2.0, 3.0); 40]);
    let mut content = workplace.read("cloud.ply");
    content.truncate(content.len() - 30);
    workplace.write("cloud.ply", content);
    refuse_cloud(&workplace, "cloud.ply", &[]);
}

#[test]
fn a_header_that_counts_more_than_the_file_holds() {
    let header = "ply\nformat binary_little_endian 1.0\nelement vertex 4000000000\n\
                  property float x\nproperty float y\nproperty float z\nend_header\n";
    refuse_content("cloud.ply", [header.as_bytes(), &[0; 36]].concat(), &["4000000000"]);
}

#[test]
fn a_word_among_the_numbers() {
    refuse_content("cloud.xyz", "0 0 1\n1 0 1\n1 1 oops\n0 1 1\n", &["oops", "3"]);
}

/// Refines from a file that is no pose.
#[track_caller]
fn refuse_initial(content: &str, words: &[&str]) {
    let workplace = Workplace::with_pair();
    workplace.write("initial.txt", content);
    let outcome = workplace.refine(&["--output", "out.txt"]);
    outcome.assert_refused(&[&["initial.txt"], words].concat());
    assert!(!workplace.path("out.txt").exists());
}

#[test]
fn an_initial_transform_that_is_not_rigid() {
    refuse_initial("2 0 0 0\n0 2 0 0\n0 0 2 0\n0 0 0 1\n", &["rotation"]);
    refuse_initial("1 0 0 0\n0 1 0 0\n0 0 1 0\n5 0 0 1\n", &["last row"]);
    refuse_initial("nan 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", &["finite"]);
    refuse_initial("1 0 0\n0 1 0\n0 0 1\n", &["3 x 3"]);
}

#[test]
fn features_that_do_not_belong_together() {
    let workplace = Workplace::with_pair();
    let points = vec![1.0, 2.0, 3.0, 2.0, 2.0, 3.0, 1.0, 1.0, 3.0, 1.0, 2.0, 2.5];
    let features = |name: &str, shape: [usize; 2]| {
        let values = (0..shape[0] * shape[1]).map(|i| i as f64).collect();
        let arrays = [("points", &[4, 3][..], points.clone()), ("features", &shape[..], values)];
        workplace.npz(name, &arrays);
    };
    features("good.npz", [4, 2]);
    features("short.npz", [3, 2]);
    features("wide.npz", [4, 3]);
    let refine = |source: &str, reference: &str| {
        workplace.refine(&["--source-features", source, "--reference-features", reference])
    };
    refine("short.npz", "good.npz").assert_refused(&["short.npz", "4 rows", "3"]);
    refine("good.npz", "wide.npz").assert_refused(&["2 dimensions", "3"]);
    assert_ne!(refine("good.npz", "good.npz").code, 2);
    assert_eq!(workplace.refine(&["--source-features", "good.npz"]).code, 2);
}

#[test]
fn recorded_features_under_another_initial_transform() {
    let workplace = Workplace::with_pair();
    let record = |name: &str, initial: Vec<f64>| {
        let layer = |map: &str| format!("{map}_layer0");
        let names: Vec<String> = rare::encode::MAP_NAMES.into_iter().map(layer).collect();
        let values: Vec<f64> = (0..2 * 30 * 40).map(|i| f64::from(i % 17)).collect();
        let mut arrays = vec![("initial", &[4, 4][..], initial)];
        arrays.extend(names.iter().map(|name| (name.as_str(), &[2, 30, 40][..], values.clone())));
        workplace.npz(name, &arrays);
    };
    let initial: Vec<f64> = workplace
        .text("initial.txt")
        .split_whitespace()
        .map(|number| number.parse().unwrap())
        .collect();
    let mut other = initial.clone();
    other[3] += 0.001;
    record("own.npz", initial);
    record("other.npz", other);
    let outcome = workplace.refine(&["--depth-features", "other.npz", "--output", "out.txt"]);
    outcome.assert_refused(&["other.npz", "another initial transform"]);
    assert!(!workplace.path("out.txt").exists());
    let outcome = workplace.refine(&["--depth-features", "own.npz", "--profile", "indoor"]);
    assert_ne!(outcome.code, 2, "{outcome:?}");
    let register = ["register", "source.xyz", "reference.xyz", "--depth-features", "own.npz"];
    workplace.run(&register).assert_refused(&["own.npz", "rare refine"]);
}
