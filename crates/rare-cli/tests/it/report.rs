//! `--report`: pages that hold everything and show every name as text. What they look like in a browser is tested there.

use serde_json::Value;

use crate::shared::{Workplace, argument};

/// The data of a page.
fn data(page: &str) -> Value {
    let (_, after) = page.split_once("id=\"data\">").unwrap();
    let text = after.split_once("</script>").unwrap().0;
    assert!(!text.contains(['<', '>', '&']), "what is in a name may end the script");
    serde_json::from_str(text).unwrap()
}

/// The base64 text of a blob.
fn blob<'a>(page: &'a str, id: &str) -> &'a str {
    let (_, after) = page.split_once(&format!("id=\"{id}\">")).unwrap();
    after.split_once("</script>").unwrap().0
}

/// Nothing of a page is sought elsewhere.
fn assert_self_contained(page: &str) {
    let markup: String =
        page.split("<script").map(|part| part.split(">").next().unwrap()).collect();
    for elsewhere in ["src=", "<link", "<iframe", "@import", "url(http"] {
        assert!(!markup.contains(elsewhere), "{elsewhere}");
    }
    assert!(page.contains("Content-Security-Policy"));
    assert!(!page.contains("{{"), "a placeholder is left");
}

#[test]
fn the_page_says_what_the_record_says() {
    let workplace = Workplace::with_pair();
    let plain = workplace.refine(&[]);
    let outcome = workplace.refine(&["--report", "out.html", "--json", "out.json"]);
    // Showing it changes nothing.
    assert_eq!((outcome.code, &outcome.stdout), (plain.code, &plain.stdout));
    let page = workplace.text("out.html");
    assert_self_contained(&page);
    let (data, record) = (data(&page), workplace.json("out.json"));
    assert_eq!(data["transform"]["rows"], record["target_from_source"]);
    assert_eq!(data["initial"]["rows"], record["initial"]);
    assert_eq!(data["verdict"]["kind"], record["verdict"]);
    assert_eq!(data["record"]["evidence"], record["evidence"]);
    for (set, recorded) in
        data["sets"].as_array().unwrap().iter().zip(record["sets"].as_array().unwrap())
    {
        for key in ["name", "correspondences", "inliers"] {
            assert_eq!(set[key], recorded[key]);
        }
        // Six numbers and a flag of each correspondence, in base64.
        let bytes = 25 * set["shown"].as_u64().unwrap() as usize;
        let text = blob(&page, set["blob"].as_str().unwrap());
        assert_eq!(text.len(), bytes.div_ceil(3) * 4);
    }
    let keys: Vec<&str> = data["scene"]["poses"]
        .as_array()
        .unwrap()
        .iter()
        .map(|pose| pose["key"].as_str().unwrap())
        .collect();
    assert_eq!(keys, ["given", "initial", "result"]);
    for name in ["source", "reference"] {
        let cloud = &data["scene"]["clouds"][name];
        let count = rare::io::read_cloud(workplace.path(&format!("{name}.xyz"))).unwrap().len();
        assert_eq!(
            (cloud["points"].as_u64(), &cloud["shown"]),
            (Some(count as u64), &cloud["points"])
        );
        let text = blob(&page, cloud["blob"].as_str().unwrap());
        assert_eq!(text.len(), (12 * count).div_ceil(3) * 4);
    }
    // The command on the page does the same again.
    let command: Vec<&str> = data["command"].as_str().unwrap().split(' ').collect();
    assert_eq!(command[0], "rare");
    assert_eq!(workplace.run(&command[1..]).stdout, outcome.stdout);
}

#[cfg(unix)]
#[test]
fn hostile_names_stay_text() {
    let workplace = Workplace::with_pair();
    let name = format!(
        "<script>alert('1')<\u{29f8}script>\"& {{{{data}}}} \u{fc}\u{202e}{}.xyz",
        "x".repeat(150)
    );
    std::fs::rename(workplace.path("source.xyz"), workplace.path(&name)).unwrap();
    let outcome = workplace.run(&[
        "refine",
        &name,
        "reference.xyz",
        "--init",
        "initial.txt",
        "--report",
        "out.html",
    ]);
    assert_eq!(outcome.code, 0, "{outcome:?}");
    let page = workplace.text("out.html");
    assert!(!page.contains("<script>alert"));
    let data = data(&page);
    assert_eq!(data["inputs"]["source"], name.as_str());
    assert!(data["title"].as_str().unwrap().starts_with("<script>"));
    // The command is still one that a shell takes apart rightly: the name is quoted.
    assert!(data["command"].as_str().unwrap().contains("'<script>alert('\\''1'\\'')"));
}

#[test]
fn registrations_and_rejected_ones_have_pages() {
    let workplace = Workplace::with_pair();
    let outcome =
        workplace.run(&["register", "source.xyz", "reference.xyz", "--report", "out.html"]);
    assert_eq!(outcome.code, 0, "{outcome:?}");
    let data = data(&workplace.text("out.html"));
    assert_eq!(data["initial"], Value::Null);
    assert_eq!(data["scene"]["poses"].as_array().unwrap().len(), 2);
    // A ball onto a corner: nothing can be trusted.
    let ball = (0..2000).map(|i| {
        let (turn, height) = (f64::from(i) * 2.4, f64::from(i) / 1000.0 - 1.0);
        let radius = (1.0 - height * height).sqrt();
        rare::nalgebra::Point3::new(radius * turn.cos(), radius * turn.sin(), height + 2.5)
    });
    workplace.cloud("ball.xyz", &ball.collect::<Vec<_>>());
    let arguments = ["refine", "ball.xyz", "reference.xyz", "--init", "initial.txt"];
    let outcome = workplace.run(&[&arguments[..], &["--report", "ball.html"]].concat());
    assert_eq!(outcome.code, 1, "{outcome:?}");
    let data = self::data(&workplace.text("ball.html"));
    assert_eq!(data["verdict"]["kind"], "rejected");
    assert!(data["verdict"]["explanation"].as_str().unwrap().contains("do not use"));
}

#[test]
fn a_page_is_an_output_like_others() {
    let workplace = Workplace::with_pair();
    let refused = workplace.refine(&["--report", "nowhere/out.html"]);
    refused.assert_refused(&["--report", "nowhere", "does not exist"]);
    let source = workplace.path("source.xyz");
    workplace.refine(&["--report", argument(&source)]).assert_refused(&["--report", "input"]);
    let same = workplace.refine(&["--report", "out", "--json", "out"]);
    same.assert_refused(&["--report", "--json", "same file"]);
    workplace.write("file", "kept");
    workplace.refine(&["--figures", "file"]).assert_refused(&["--figures", "file"]);
    for (option, place) in [("--report", "nowhere/out.html"), ("--figures", "file")] {
        let before = workplace.names();
        workplace.run(&["demo", "--quiet", option, place]).assert_refused(&[option, place]);
        assert_eq!(workplace.names(), before);
    }
    workplace.write("rare.toml", "report = \"from_file.html\"\n");
    assert_eq!(workplace.refine(&["--config", "rare.toml", "--quiet"]).code, 0);
    assert!(workplace.path("from_file.html").is_file());
}
