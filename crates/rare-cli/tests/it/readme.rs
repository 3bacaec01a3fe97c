//! The README says what is true: its commands exist and it stays short.

use std::path::Path;
use std::process::Command;

fn readme() -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../README.md");
    std::fs::read_to_string(path).unwrap()
}

/// The lines of the shell blocks.
fn commands() -> Vec<String> {
    let text = readme();
    let blocks = text.split("```sh\n").skip(1).filter_map(|block| block.split("```").next());
    blocks.flat_map(str::lines).map(str::to_owned).collect()
}

#[test]
fn it_is_short() {
    let lines = readme().lines().count();
    assert!(lines <= 120, "{lines} lines");
}

#[test]
fn its_two_commands_come_first() {
    assert_eq!(commands()[..2], ["cargo run --release -- demo", "cargo test --release"]);
}

#[test]
fn every_command_and_flag_exists() {
    let of_rare: Vec<String> =
        commands().into_iter().filter(|line| line.starts_with("rare ")).collect();
    assert!(of_rare.len() >= 5, "{of_rare:?}");
    for line in of_rare {
        let words: Vec<&str> = line.split_whitespace().collect();
        let help =
            Command::new(env!("CARGO_BIN_EXE_rare")).args([words[1], "--help"]).output().unwrap();
        assert!(help.status.success(), "{line}");
        let help = String::from_utf8(help.stdout).unwrap();
        for flag in words.iter().filter(|word| word.starts_with("--")) {
            assert!(help.contains(&format!("{flag} ")), "{line}: no {flag}");
        }
    }
}
