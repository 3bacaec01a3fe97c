//! Evaluations that are interrupted, split and scored.

use std::fs;
use std::process::{Child, Command, Stdio};
use std::thread;
use std::time::Duration;

use rare::RigidTransform;
use rare::nalgebra::{Rotation3, Vector3};
use rare::random::Random;
use serde_json::{Value, json};

use crate::pickle_writer::Pickle;
use crate::shared::{Workplace, argument, pair, shifted, start};

/// Pairs of the benchmark.
const PAIRS: usize = 6;
/// The tables of an evaluation, times excluded.
const TABLES: [&str; 6] =
    ["tables.txt", "tables.md", "tables.csv", "tables.json", "tables.tex", "pairs.csv"];

/// A benchmark in the folder layout: one reference, several sources, starts of which some are hopeless.
pub(crate) fn benchmark() -> Workplace {
    let workplace = Workplace::empty();
    fs::create_dir(workplace.path("room")).unwrap();
    let [source, reference] = pair().map(|points| shifted(&points, Vector3::new(0.0, 0.0, 3.0)));
    workplace.cloud("room/cloud_bin_0.ply", &reference);
    let (mut pairs, mut starts) = (Vec::new(), Vec::new());
    for number in 1..=PAIRS {
        let motion = RigidTransform::new(
            Rotation3::new(Vector3::new(0.02 * number as f64, 0.1, -0.05)),
            Vector3::new(0.1, -0.02 * number as f64, 0.05),
        );
        let truth = crate::shared::about(&crate::shared::truth(), Vector3::new(0.0, 0.0, 3.0));
        workplace.cloud(&format!("room/cloud_bin_{number}.ply"), &motion.apply_all(&source));
        let truth = truth * motion.inverse();
        let error = if number % 3 == 0 { start() * start() * start() } else { start() };
        let pose = |pose: &RigidTransform| json!(rare::eval::results::rows_of(&pose.to_matrix()));
        pairs.push(json!({"src": number, "ref": 0, "gt": pose(&truth), "overlap": 0.9}));
        starts.push(json!({"src": number, "ref": 0, "init": pose(&(error * truth))}));
    }
    workplace.write("room/pairs.json", json!(pairs).to_string());
    workplace.write("room/init.json", json!({"name": "wrong", "pairs": starts}).to_string());
    workplace
}

fn command(workplace: &Workplace, out: &str, more: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_rare"));
    command
        .args(["eval", "folder", "room", "--init", "init.json", "--out", out, "--threads", "1"])
        .args(more)
        .current_dir(argument(&workplace.path(".")))
        .stdout(Stdio::null())
        .stderr(Stdio::null());
    command
}

fn finish(mut child: Child) {
    assert!(child.wait().unwrap().success());
}

#[track_caller]
fn assert_equal_tables(workplace: &Workplace, first: &str, second: &str) {
    for table in TABLES {
        let [a, b] = [first, second].map(|folder| workplace.text(&format!("{folder}/{table}")));
        assert_eq!(a, b, "{table}");
    }
}

pub(crate) fn lines(workplace: &Workplace, out: &str) -> Vec<Value> {
    let text = fs::read_to_string(workplace.path(out).join("results.jsonl")).unwrap_or_default();
    text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

#[test]
fn killed_split_and_shared_evaluations_give_the_tables_of_an_undisturbed_one() {
    let workplace = benchmark();
    finish(command(&workplace, "whole", &[]).spawn().unwrap());
    let whole = lines(&workplace, "whole");
    assert_eq!(whole.len(), 2 * PAIRS);
    let text = workplace.text("whole/tables.txt");
    assert!(text.contains("refine") && text.contains("6/6"), "{text}");

    // Killed at moments that have nothing to do with what it is doing.
    let mut random = Random::new(5, 0);
    for _ in 0..6 {
        let mut child = command(&workplace, "killed", &[]).spawn().unwrap();
        thread::sleep(Duration::from_millis(50 + random.below(900) as u64));
        child.kill().unwrap();
        child.wait().unwrap();
    }
    // And in the middle of a line.
    let results = workplace.path("killed/results.jsonl");
    let torn = [fs::read(&results).unwrap_or_default(), b"{\"pair\":1,\"meth".to_vec()].concat();
    fs::write(&results, torn).unwrap();
    finish(command(&workplace, "killed", &[]).spawn().unwrap());
    assert_eq!(lines(&workplace, "killed").len(), 2 * PAIRS);
    assert_equal_tables(&workplace, "whole", "killed");

    // Two processes in one folder.
    let both = [0, 1].map(|_| command(&workplace, "both", &["--jobs", "2"]).spawn().unwrap());
    both.into_iter().for_each(finish);
    assert_eq!(lines(&workplace, "both").len(), 2 * PAIRS);
    assert_equal_tables(&workplace, "whole", "both");

    // Four shards.
    let shards = ["s0", "s1", "s2", "s3"];
    for (index, out) in shards.iter().enumerate() {
        let shard = format!("{index}/4");
        finish(command(&workplace, out, &["--shard", &shard]).spawn().unwrap());
    }
    let scored = workplace.run(&[&["score"], &shards[..], &["--out", "merged"]].concat());
    assert_eq!(scored.code, 0, "{scored:?}");
    assert_equal_tables(&workplace, "whole", "merged");
    assert_eq!(scored.stdout, workplace.text("whole/tables.txt"));

    // Unfinished results say so.
    let part = workplace.run(&["score", "s0"]);
    assert!(part.stdout.contains("4 pairs have not been tried"), "{part:?}");
}

#[test]
fn what_does_not_fit_is_refused() {
    let workplace = benchmark();
    let eval = |more: &[&str]| {
        let command = ["eval", "folder", "room", "--init", "init.json", "--methods", "init"];
        workplace.run(&[&command, more].concat())
    };
    assert_eq!(eval(&["--out", "results", "--limit", "2"]).code, 0);
    eval(&["--out", "results", "--limit", "3"]).assert_refused(&["results", "another folder"]);
    eval(&[]).assert_refused(&["--out"]);
    eval(&["--out", "x", "--limit", "0"]).assert_refused(&["--limit"]);
    eval(&["--out", "x", "--truth", "gt_refined"]).assert_refused(&[
        "pairs.json",
        "1 -> 0",
        "gt_refined",
    ]);
    let unknown = workplace.run(&["eval", "folder", "room", "--methods", "magic", "--out", "x"]);
    unknown.assert_refused(&["magic", "refine"]);
    let unknown =
        workplace.run(&["eval", "folder", "room", "--init", "nothing.json", "--out", "x"]);
    unknown.assert_refused(&["nothing.json"]);
    eval(&["--out", "x", "--encoder", "diffusion"]).assert_refused(&["diffusion", "built-in"]);
    // One scene's log serves as well.
    let starts = workplace.json("room/init.json");
    let block = |pair: &Value| {
        let rows: Vec<String> = (pair["init"].as_array().unwrap().iter())
            .map(|row| {
                let numbers = row.as_array().unwrap().iter().map(Value::to_string);
                numbers.collect::<Vec<_>>().join(" ")
            })
            .collect();
        format!("0 {} 7\n{}\n", pair["src"], rows.join("\n"))
    };
    let log: String = starts["pairs"].as_array().unwrap().iter().map(block).collect();
    workplace.write("est.log", log);
    let by_log =
        ["eval", "folder", "room", "--init", "est.log", "--methods", "init", "--out", "by_log"];
    assert_eq!(workplace.run(&by_log).code, 0);
    assert_eq!(eval(&["--out", "by_json"]).code, 0);
    assert_equal_tables(&workplace, "by_log", "by_json");
    workplace.run(&["score", "nowhere"]).assert_refused(&["nowhere"]);
    workplace.write("results/results.jsonl", "{\"pair\":0}\n");
    workplace.run(&["score", "results"]).assert_refused(&["results.jsonl", "line 1"]);
    fs::remove_file(workplace.path("room/cloud_bin_1.ply")).unwrap();
    eval(&["--out", "x"]).assert_refused(&["cloud_bin_1.ply"]);
}

#[test]
fn methods_without_single_steps_are_evaluated() {
    let workplace = benchmark();
    let methods = ["refine", "refine-no-search", "refine-no-verify"];
    let names = methods.join(",");
    let more = ["--methods", &names, "--limit", "3"];
    finish(command(&workplace, "out", &more).spawn().unwrap());
    let results = lines(&workplace, "out");
    assert_eq!(results.len(), methods.len() * 3);
    let of = |method: &str| -> Vec<Value> {
        let found = results.iter().filter(|line| line["method"] == method);
        found.map(|line| line["signals"].clone()).collect()
    };
    for method in methods {
        let found = of(method);
        assert_eq!(found.len(), 3, "{method}");
        for signals in found {
            assert!(signals["agreement"].is_number() && signals["log_weaker_support"].is_number());
        }
    }
    assert_ne!(of("refine"), of("refine-no-verify"));
    let gone = ["eval", "folder", "room", "--methods", "refine-no-fallback", "--out", "x"];
    workplace.run(&gone).assert_refused(&["refine-no-fallback", "refine-no-verify"]);
}

#[test]
fn ten_thousand_pairs_are_scored_at_once() {
    let workplace = Workplace::empty();
    let (mut gt, mut info, mut est) = (String::new(), String::new(), String::new());
    let row =
        |n: usize, at: usize| (0..n).map(|c| if c == at { "1 " } else { "0 " }).collect::<String>();
    let block = |n: usize| (0..n).map(|r| row(n, r) + "\n").collect::<String>();
    for first in 0..100 {
        for second in 0..100 {
            let header = format!("{first} {second} 100\n");
            gt += &(header.clone() + &block(4));
            est += &(header.clone() + &block(4));
            info += &(header + &block(6));
        }
    }
    for folder in ["gt/scene", "est/scene"] {
        fs::create_dir_all(workplace.path(folder)).unwrap();
    }
    workplace.write("gt/scene/gt.log", gt);
    workplace.write("gt/scene/gt.info", info);
    workplace.write("est/scene/est.log", est);
    let clock = std::time::Instant::now();
    let scored = workplace.run(&["score", "--gt", "gt", "--est", "est", "--protocol", "all"]);
    assert_eq!(scored.code, 0, "{scored:?}");
    assert!(
        scored.stdout.contains("10000/10000") && scored.stdout.contains("9702/9702"),
        "{scored:?}"
    );
    // Five protocols take 0.8 s alone on two cores; the limit leaves room for neighbours.
    assert!(clock.elapsed() < Duration::from_secs(10), "{:?}", clock.elapsed());
}

/// The benchmark in the layout of 3DMatch, with dumps of a network for every pair.
pub(crate) fn three_d_match() -> Workplace {
    let workplace = benchmark();
    for folder in
        ["data/benchmarks/3DMatch/room", "data/features/geotransformer/3DMatch/room", "data/room"]
    {
        fs::create_dir_all(workplace.path(folder)).unwrap();
    }
    let [source, _] = pair().map(|points| shifted(&points, Vector3::new(0.0, 0.0, 3.0)));
    let (mut log, mut information) = (String::new(), String::new());
    let pairs: Vec<Value> = serde_json::from_str(&workplace.text("room/pairs.json")).unwrap();
    fs::copy(workplace.path("room/cloud_bin_0.ply"), workplace.path("data/room/cloud_bin_0.ply"))
        .unwrap();
    for pair in pairs.iter().take(2) {
        let number = pair["src"].as_u64().unwrap();
        let name = format!("cloud_bin_{number}.ply");
        fs::copy(workplace.path("room").join(&name), workplace.path("data/room").join(&name))
            .unwrap();
        let numbers: Vec<f64> = (pair["gt"].as_array().unwrap().iter())
            .flat_map(|row| row.as_array().unwrap().iter().map(|value| value.as_f64().unwrap()))
            .collect();
        let rows: Vec<String> = numbers
            .chunks(4)
            .map(|row| row.iter().map(f64::to_string).collect::<Vec<_>>().join(" "))
            .collect();
        // Not consecutive in the list's sense, and never first.
        log += &format!("0 {number} 9\n{}\n", rows.join("\n"));
        let diagonal =
            |r: usize| (0..6).map(|c| if r == c { "9 " } else { "0 " }).collect::<String>() + "\n";
        information += &(format!("0 {number} 9\n") + &(0..6).map(diagonal).collect::<String>());
        let truth = RigidTransform::from_matrix(&rare::nalgebra::Matrix4::from_row_slice(&numbers))
            .unwrap();
        let cloud =
            rare::io::read_cloud(workplace.path("room").join(&name)).unwrap().world_points();
        let some: Vec<_> = cloud.iter().step_by(source.len() / 150).collect();
        let coordinates = |points: &[rare::nalgebra::Point3<f64>]| {
            points.iter().flat_map(|point| [point.x, point.y, point.z]).collect::<Vec<f64>>()
        };
        let sources: Vec<_> = some.iter().map(|point| **point).collect();
        // Every third match is wrong.
        let targets: Vec<_> = (sources.iter().enumerate())
            .map(|(index, point)| {
                if index % 3 == 0 {
                    truth.apply(&sources[(7 * index + 5) % sources.len()])
                } else {
                    truth.apply(point)
                }
            })
            .collect();
        let count = sources.len();
        workplace.npz(
            &format!("data/features/geotransformer/3DMatch/room/0_{number}.npz"),
            &[
                ("src_corr_points", &[count, 3], coordinates(&sources)),
                ("ref_corr_points", &[count, 3], coordinates(&targets)),
                ("corr_scores", &[count], vec![0.5; count]),
                ("estimated_transform", &[4, 4], numbers),
            ],
        );
    }
    workplace.write("data/benchmarks/3DMatch/room/gt.log", log);
    workplace.write("data/benchmarks/3DMatch/room/gt.info", information);
    workplace
}

#[test]
fn the_papers_tables_are_filled_as_far_as_the_data_goes() {
    let workplace = three_d_match();
    let outcome =
        workplace.run(&["eval", "paper", "data", "--out", "out", "--protocol", "dgr", "--quiet"]);
    assert_eq!(outcome.code, 0, "{outcome:?}");
    let text = workplace.text("out/paper.txt");
    assert_eq!(text, outcome.stdout);
    let table = |number: usize| {
        let from = text.split(&format!("Table {number}:")).nth(1).unwrap();
        from.split("\nTable ").next().unwrap().to_owned()
    };
    let cells = |number: usize, name: &str| -> Vec<String> {
        let table = table(number);
        let line = table.lines().find(|line| line.starts_with(&format!("{name} "))).unwrap();
        line[name.len()..].split_whitespace().map(str::to_owned).collect()
    };
    for name in ["RANSAC-50K", "RANSAC-1M", "SC2-PCR", "MAC", "FastMAC", "Ours"] {
        assert_eq!(cells(1, name)[0], "100.0", "{name} {text}");
    }
    assert_eq!(cells(3, "GeoTransformer"), ["100.0", "0.00", "0.000"]);
    assert_eq!(cells(6, "w/o Inlier Aggregation").len(), 3);
    for (number, name, why) in [
        (1, "PointDSC", "no --weights of PointDSC for 3DMatch"),
        (1, "SC2-PCR++", "no transform"),
        (2, "Ours", "3DLoMatch"),
        (3, "FCGF", "features/fcgf/3DMatch"),
        (3, "Predator + Ours", "no --weights of Predator for 3DMatch"),
        (4, "Ours", "08.txt"),
        (5, "0, 3, 6", "diffusion weights"),
    ] {
        assert_eq!(cells(number, name), ["-", "-", "-"], "{name} {text}");
        assert!(table(number).contains("not run") && table(number).contains(why), "{why} {text}");
    }
    for file in ["out/paper.md", "out/paper.tex", "out/3DMatch-geotransformer/results.jsonl"] {
        assert!(workplace.path(file).is_file(), "{file}");
    }
}

#[test]
fn a_list_of_pairs_stands_for_a_missing_log() {
    let workplace = benchmark();
    fs::create_dir_all(workplace.path("data/metadata")).unwrap();
    fs::create_dir_all(workplace.path("data/data/test/room")).unwrap();
    let pairs: Vec<Value> = serde_json::from_str(&workplace.text("room/pairs.json")).unwrap();
    let row = |index: usize| -> Vec<f64> {
        pairs[0]["gt"][index]
            .as_array()
            .unwrap()
            .iter()
            .map(|value| value.as_f64().unwrap())
            .collect()
    };
    let rows = [row(0), row(1), row(2)];
    let rotation: Vec<f64> = rows.iter().flat_map(|row| row[..3].to_vec()).collect();
    let translation: Vec<f64> = rows.iter().map(|row| row[3]).collect();
    let list = Pickle(b"](}(".to_vec())
        .text("overlap")
        .number(0.9)
        .text("pcd0")
        .text("test/room/cloud_bin_0.pth")
        .text("pcd1")
        .text("test/room/cloud_bin_1.pth")
        .text("rotation")
        .array(&[3, 3], &rotation)
        .text("translation")
        .array(&[3], &translation)
        .text("scene_name")
        .text("room")
        .text("frag_id0")
        .integer(0)
        .text("frag_id1")
        .integer(1)
        .raw(b"ue");
    workplace.write("data/metadata/3DMatch.pkl", list.into_file());
    for number in [0, 1] {
        let points =
            rare::io::read_cloud(workplace.path(&format!("room/cloud_bin_{number}.ply"))).unwrap();
        // A pickle's small integers reach to 255.
        let points: Vec<f64> = points
            .world_points()
            .iter()
            .step_by(40)
            .take(200)
            .flat_map(|point| [point.x, point.y, point.z])
            .collect();
        let fragment = Pickle(Vec::new()).array(&[200, 3], &points).into_file();
        workplace.write(&format!("data/data/test/room/cloud_bin_{number}.pth"), fragment);
    }
    let outcome = workplace.run(&[
        "eval",
        "3dmatch",
        "data",
        "--init",
        "ransac",
        "--methods",
        "point-to-point",
        "--out",
        "out",
        "--quiet",
    ]);
    assert_eq!(outcome.code, 0, "{outcome:?}");
    assert!(outcome.stdout.starts_with("protocol dgr"), "{outcome:?}");
    assert_eq!(lines(&workplace, "out").len(), 1);
    fs::remove_file(workplace.path("data/data/test/room/cloud_bin_1.pth")).unwrap();
    workplace.run(&["eval", "3dmatch", "data", "--out", "out2"]).assert_refused(&[
        "3DMatch.pkl",
        "cloud_bin_1.pth",
        "missing",
    ]);
}

#[test]
fn an_evaluation_is_shown_with_all_its_pairs() {
    let workplace = benchmark();
    let limit = ["--limit", "3", "--methods", "init,refine,refine-no-polish"];
    finish(command(&workplace, "plain", &limit).spawn().unwrap());
    let with_report = [&limit[..], &["--report"]].concat();
    finish(command(&workplace, "shown", &with_report).spawn().unwrap());
    assert_equal_tables(&workplace, "plain", "shown");
    let page = workplace.text("shown/index.html");
    let (_, data) = page.split_once("id=\"data\">").unwrap();
    let data: Value = serde_json::from_str(data.split_once("</script>").unwrap().0).unwrap();
    let pairs = data["pairs"].as_array().unwrap();
    assert_eq!((pairs.len(), data["methods"].as_array().unwrap().len()), (9, 3));
    for pair in pairs {
        let refined = pair["method"].as_str().unwrap().starts_with("refine");
        assert_eq!(pair["page"].is_string(), refined, "{pair}");
        assert_eq!(pair["confidence"].is_number(), refined, "{pair}");
        if let Some(link) = pair["page"].as_str() {
            let page = workplace.text(&format!("shown/{link}"));
            // The command on the page of a pair has what it needs.
            let init = workplace.path(&format!("shown/{}", link.replace(".html", ".txt")));
            assert!(page.contains("rare refine room") && init.is_file(), "{link}");
        }
    }
    let recall = &data["methods"][0]["recall_rotation"];
    assert!(recall.as_array().unwrap().len() > 100 && recall[0][1] == 0.0, "{recall}");

    // What is there is not made again.
    let link = pairs.iter().find_map(|pair| pair["page"].as_str()).unwrap();
    workplace.write(&format!("shown/{link}"), "kept");
    finish(command(&workplace, "shown", &with_report).spawn().unwrap());
    assert_eq!(workplace.text(&format!("shown/{link}")), "kept");
    for refused in [&["--shard", "0/2"][..], &[]] {
        let kind = if refused.is_empty() { "paper" } else { "folder" };
        let all = [&["eval", kind, "room", "--out", "other", "--report"], refused].concat();
        workplace.run(&all).assert_refused(&["--report"]);
    }
}
