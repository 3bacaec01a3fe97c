//! The numbers of benchmarks against those of their own scripts.

use std::path::{Path, PathBuf};

use rare::eval::log_folders::{self, Missing};
use rare::eval::{Protocol, Rules, ScoredPair, Summary};

use crate::shared;

fn golden(name: &str) -> Option<(Vec<ScoredPair>, serde_json::Value)> {
    let folder = shared::path(&format!("golden/backbones/eval/{name}"))?;
    let truth = log_folders::read_truth(folder.join("gt")).unwrap();
    let scored = log_folders::score(&truth, folder.join("est"), Missing::Refuse).unwrap();
    let expected = std::fs::read_to_string(folder.join("expected.json")).unwrap();
    Some((scored, serde_json::from_str(&expected).unwrap()))
}

fn assert_close(found: Option<f64>, expected: &serde_json::Value, what: &str) {
    let (found, expected) = (found.unwrap(), expected.as_f64().unwrap());
    assert!((found - expected).abs() < 1e-9, "{what}: {found} {expected}");
}

#[test]
fn every_pair_scene_and_mean_agrees_with_the_official_scripts() {
    for name in ["consec_first", "nonconsec_first"] {
        let Some((scored, expected)) = golden(name) else { return };
        let (predator, dgr) = (Protocol::Predator.published(), Protocol::Dgr.published());
        let summary = Summary::of(&scored, &predator);
        for scene in &summary.scenes {
            let expected = &expected["per_scene"][&scene.scene];
            check_pairs(&scored, &scene.scene, &predator, expected);
            assert_close(scene.recall(), &expected["predator_recall"], "recall");
            assert_close(scene.rotation.mean, &expected["mean_re"], "mean re");
            assert_close(scene.rotation.median, &expected["median_re"], "median re");
            assert_close(scene.translation.mean, &expected["mean_te"], "mean te");
            assert_close(scene.translation.median, &expected["median_te"], "median te");
        }
        for scene in &Summary::of(&scored, &dgr).scenes {
            let expected = &expected["per_scene"][&scene.scene];
            assert_close(scene.recall(), &expected["dgr_recall"], "dgr recall");
            assert_close(scene.rotation.mean, &expected["dgr_mean_re"], "dgr re");
            assert_close(scene.translation.mean, &expected["dgr_mean_te"], "dgr te");
        }
        let means = &expected["predator"];
        assert_close(summary.recall, &means["predator_recall"], "mean recall");
        let (rotation, translation) = (summary.of_solved.rotation, summary.of_solved.translation);
        assert_close(rotation.scenes.mean, &means["mean_re"], "mean mean re");
        assert_close(rotation.scenes.median, &means["median_re"], "mean median re");
        assert_close(translation.scenes.mean, &means["mean_te"], "mean mean te");
        assert_close(translation.scenes.median, &means["median_te"], "mean median te");
        let pairs = Summary::of(&scored, &dgr);
        let means = &expected["dgr_pair_average"];
        assert_close(pairs.recall, &means["recall"], "pair recall");
        assert_close(pairs.of_solved.rotation.pairs.mean, &means["re"], "pair re");
        assert_close(pairs.of_solved.translation.pairs.mean, &means["te"], "pair te");
    }
}

/// Flags of the official script: 0 solved, 1 not solved, 2 not counted.
fn check_pairs(scored: &[ScoredPair], scene: &str, rules: &Rules, expected: &serde_json::Value) {
    let pairs: Vec<&ScoredPair> = scored.iter().filter(|pair| pair.scene == scene).collect();
    assert_eq!(pairs.len(), expected["flags"].as_array().unwrap().len());
    for (index, pair) in pairs.into_iter().enumerate() {
        let errors = pair.errors.unwrap();
        assert_close(errors.rmse, &expected["rmse"][index], "rmse");
        assert_close(Some(errors.official_rotation), &expected["re"][index], "re");
        assert_close(Some(errors.translation), &expected["te"][index], "te");
        let flag = match (rules.counts(pair), rules.solved(pair)) {
            (true, true) => 0,
            (true, false) => 1,
            (false, _) => 2,
        };
        assert_eq!(Some(flag), expected["flags"][index].as_i64(), "{scene} {index}");
    }
}

fn cofinet(set: &str) -> Option<Vec<ScoredPair>> {
    let root = shared::path("data/3dmatch-official")?;
    let truth = log_folders::read_truth(root.join("benchmarks").join(set)).unwrap();
    let estimates = root.join("cofinet_est").join(set).join("5000");
    Some(log_folders::score(&truth, estimates, Missing::Refuse).unwrap())
}

#[test]
fn published_result_files_give_the_published_numbers() {
    let Some(scored) = cofinet("3DMatch") else { return };
    let summary = Summary::of(&scored, &Protocol::Predator.published());
    let digits = |value: Option<f64>, digits: usize| format!("{:.digits$}", value.unwrap());
    assert_eq!((scored.len(), summary.pairs), (1623, 1279));
    assert_eq!(digits(summary.recall, 4), "0.8936");
    assert_eq!(digits(summary.of_solved.rotation.scenes.median, 4), "2.0023");
    assert_eq!(digits(summary.of_solved.translation.scenes.median, 4), "0.0638");
    let recalls: Vec<String> =
        summary.scenes.iter().map(|scene| digits(scene.recall(), 3)).collect();
    assert_eq!(recalls, ["0.964", "1.000", "0.761", "0.978", "0.897", "0.846", "0.902", "0.800"]);

    let Some(scored) = cofinet("3DLoMatch") else { return };
    let summary = Summary::of(&scored, &Protocol::Predator.published());
    assert_eq!((scored.len(), summary.pairs), (1781, 1726 - 7));
    assert_eq!(digits(summary.recall, 4), "0.6719");
    assert_eq!(digits(summary.of_solved.rotation.scenes.median, 3), "3.271");
    assert_eq!(digits(summary.of_solved.translation.scenes.median, 3), "0.090");
    // Without the trap: all pairs count; against a truth that is a rotation the errors are a little smaller.
    let all = Rules { predator_index_zero: false, ..Protocol::Predator.published() };
    let with_all = Summary::of(&scored, &all);
    assert_eq!((with_all.pairs, digits(with_all.recall, 4)), (1726, "0.6716".to_owned()));
    assert_eq!(digits(with_all.of_solved.rotation.scenes.median, 3), "3.289");
    let exact = Summary::of(&scored, &Protocol::Predator.published().exact());
    assert!(exact.of_solved.rotation.scenes.mean < with_all.of_solved.rotation.scenes.mean);
    assert_eq!(exact.recall, with_all.recall);
}

#[test]
fn unequal_lists_and_malformed_files_are_named_with_their_line() {
    let folder = tempfile::tempdir().unwrap();
    let write = |file: &str, text: &str| {
        let path = folder.path().join(file);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, text).unwrap();
    };
    let identity = |header: &str| format!("{header}\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n");
    let information = |header: &str| {
        let row =
            |r: usize| (0..6).map(|c| if r == c { "9 " } else { "0 " }).collect::<String>() + "\n";
        format!("{header}\n") + &(0..6).map(row).collect::<String>()
    };
    let (gt, est) = (folder.path().join("gt"), folder.path().join("est"));
    let message = |missing| -> String {
        let truth = match log_folders::read_truth(&gt) {
            Ok(truth) => truth,
            Err(error) => return error.to_string(),
        };
        match log_folders::score(&truth, &est, missing) {
            Ok(scored) => format!("{} scored", scored.len()),
            Err(error) => error.to_string(),
        }
    };
    let expect = |words: &[&str]| {
        let message = message(Missing::Refuse);
        assert!(words.iter().all(|word| message.contains(word)), "{message} {words:?}");
    };
    std::fs::create_dir(&gt).unwrap();
    expect(&["gt", "no scene"]);
    let both = identity("0 1 3") + &identity("0 2 3");
    write("gt/room/gt.log", &both);
    write("gt/room/gt.info", &information("0 1 3"));
    expect(&["room/gt.log", "line 6", "no information", "0 2"]);
    write("gt/room/gt.info", &(information("0 1 3") + &information("0 2 3")));
    expect(&["est/room/est.log"]);
    write("est/room/est.log", &identity("0 1 3"));
    expect(&["est/room/est.log", "no estimate", "0 2"]);
    assert_eq!(message(Missing::CountAsFailures), "2 scored");
    write("est/room/est.log", &(both.clone() + &identity("1 2 3")));
    expect(&["est/room/est.log", "line 11", "no pair 1 2"]);
    write("est/room/est.log", &(both.clone() + &identity("0 2 3")));
    expect(&["line 11", "0 2", "line 6"]);
    for (text, words) in [
        ("0 1 3\n1 0 0 0\n", vec!["line 1", "1 rows"]),
        ("0 x 3\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", vec!["line 1", "i j n"]),
        ("0 1 3\n1 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", vec!["line 2", "4 finite"]),
        ("0 1 3\n1 0 0 nan\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", vec!["line 2", "4 finite"]),
        ("\n0 1 3\n1 0 0 0\n0 1 0 0\n0 0 1 0\n1 0 0 1\n", vec!["line 6", "last row"]),
    ] {
        write("est/room/est.log", text);
        expect(&words);
    }
    write("est/room/est.log", &both);
    write("gt/room/gt_overlap.log", "0,1,0.5\n0,2,1.5\n");
    expect(&["gt_overlap.log", "line 2", "between 0 and 1"]);
    write("gt/room/gt_overlap.log", "0,1,0.5\n0,1,0.6\n");
    expect(&["gt_overlap.log", "line 2", "second time"]);
    write("gt/room/gt_overlap.log", "0,1,0.5\n");
    expect(&["2 scored"]);
    write("gt/room/gt.log", &both.replacen("1 0 0 0", "2 0 0 0", 1));
    expect(&["gt.log", "line 1", "not rigid"]);
}

#[test]
fn a_written_log_is_read_back_exactly() {
    let folder = tempfile::tempdir().unwrap();
    let path: PathBuf = folder.path().join("est.log");
    let mut matrix = nalgebra::Matrix4::identity();
    matrix[(0, 3)] = 0.1 + 0.2;
    matrix[(1, 0)] = -1.0 / 3.0;
    let text = rare::eval::trajectory::format_log([(3, 7, &matrix)], 60);
    std::fs::write(&path, text).unwrap();
    let blocks = rare::eval::trajectory::read_log(Path::new(&path)).unwrap();
    assert_eq!((blocks.len(), blocks[0].first, blocks[0].second), (1, 3, 7));
    assert_eq!(blocks[0].matrix, matrix);
}

/// A drive straight ahead, a metre per scan: three sequences of 30 scans.
fn drive(folder: &Path) {
    std::fs::create_dir_all(folder.join("poses")).unwrap();
    for sequence in ["08", "09", "10"] {
        let base = folder.join("sequences").join(sequence);
        std::fs::create_dir_all(base.join("velodyne")).unwrap();
        let poses: String = (0..30).map(|z| format!("1 0 0 0 0 1 0 0 0 0 1 {z}\n")).collect();
        std::fs::write(folder.join(format!("poses/{sequence}.txt")), poses).unwrap();
        std::fs::write(base.join("calib.txt"), "P0: 1\nTr: 0 -1 0 0 0 0 -1 0 1 0 0 0\n").unwrap();
        for frame in 0..30 {
            std::fs::write(base.join(format!("velodyne/{frame:06}.bin")), [0; 16]).unwrap();
        }
    }
}

#[test]
fn kitti_is_listed_and_its_truth_is_that_of_the_calibration() {
    use rare::eval::dataset::{KittiTruth, read_kitti};
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path().join("dataset");
    drive(&root);
    // The root may be the folder above.
    let exact = read_kitti(folder.path(), KittiTruth::Exact).unwrap();
    let pairs: Vec<(&str, usize, usize)> = (exact.pairs.iter())
        .map(|pair| (pair.truth.scene.as_str(), pair.truth.source, pair.truth.reference))
        .collect();
    // The eleventh scan is the first more than 10 m away.
    let of = |scene| [(scene, 0, 10), (scene, 11, 21)];
    assert_eq!(pairs, [of("08"), of("09"), of("10")].concat());
    assert_eq!(exact.protocol, Protocol::Kitti2m);
    assert!(exact.pairs[0].source.ends_with("sequences/08/velodyne/000000.bin"));
    // The camera looks along the scanner's x: what was 10 m ahead is beside the car.
    let truth = exact.pairs[0].truth.target_from_source;
    assert!((truth[(0, 3)] + 10.0).abs() < 1e-12 && truth[(1, 3)].abs() < 1e-12, "{truth}");
    let official = read_kitti(&root, KittiTruth::Official).unwrap();
    let truth = official.pairs[0].truth.target_from_source;
    assert!((truth[(0, 3)] + 10.0).abs() < 0.02 && truth[(1, 3)].abs() > 1e-3, "{truth}");

    // A refined truth beside the data wins, for the official one alone.
    std::fs::create_dir(root.join("icp")).unwrap();
    let mut refined = nalgebra::Matrix4::identity();
    refined[(0, 3)] = -9.5;
    let text = rare::io::format_pose(&rare::RigidTransform::from_matrix(&refined).unwrap());
    std::fs::write(root.join("icp/8_0_10.npy"), text).unwrap();
    let official = read_kitti(&root, KittiTruth::Official).unwrap();
    assert_eq!(official.pairs[0].truth.target_from_source, refined);

    let calibration = root.join("sequences/09/calib.txt");
    std::fs::write(&calibration, "Tr: 0 -1 0\n").unwrap();
    let message = read_kitti(&root, KittiTruth::Exact).unwrap_err().to_string();
    assert!(message.contains("09/calib.txt") && message.contains("line 1"), "{message}");
    std::fs::remove_file(root.join("poses/10.txt")).unwrap();
    let message = read_kitti(&root, KittiTruth::Official).unwrap_err().to_string();
    assert!(message.contains("10.txt"), "{message}");
}

#[test]
fn fragments_are_found_in_the_known_layouts() {
    use rare::eval::dataset::read_three_d_match;
    let identity = "0 2 9\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n";
    let zeros = "0 0 0 0 0 0\n".repeat(6);
    for (truth, fragments) in [
        ("metadata/benchmarks/3DLoMatch/kitchen", "data/test/kitchen/cloud_bin_N.pth"),
        ("gt_result/kitchen-evaluation", "fragments/kitchen/cloud_bin_N.ply"),
        ("kitchen-evaluation", "kitchen/cloud_bin_N.ply"),
    ] {
        let folder = tempfile::tempdir().unwrap();
        let truth = folder.path().join(truth);
        std::fs::create_dir_all(&truth).unwrap();
        std::fs::write(truth.join("gt.log"), identity).unwrap();
        std::fs::write(truth.join("gt.info"), format!("0 2 9\n{zeros}")).unwrap();
        let message = read_three_d_match(folder.path(), "3DLoMatch").unwrap_err().to_string();
        assert!(message.contains("fragment 2") && message.contains("kitchen"), "{message}");
        for number in ["0", "2"] {
            let file = folder.path().join(fragments.replace('N', number));
            std::fs::create_dir_all(file.parent().unwrap()).unwrap();
            std::fs::write(file, "x").unwrap();
        }
        let dataset = read_three_d_match(folder.path(), "3DLoMatch").unwrap();
        assert_eq!(dataset.pairs.len(), 1);
        assert!(dataset.pairs[0].source.ends_with(fragments.replace('N', "2")));
        assert!(dataset.pairs[0].reference.ends_with(fragments.replace('N', "0")));
    }
    let nothing = tempfile::tempdir().unwrap();
    let message = read_three_d_match(nothing.path(), "3DMatch").unwrap_err().to_string();
    assert!(message.contains("no 3DMatch") && message.contains("benchmarks/3DMatch"), "{message}");
}
