//! `rare weights`, against a server of our own.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::thread;
use std::time::Duration;

use crate::weights_server::{Fault, Server};

const UNET: &str = "unet/diffusion_pytorch_model.fp16.safetensors";

/// A server and an empty home.
struct Workplace {
    server: Server,
    root: tempfile::TempDir,
}

impl Workplace {
    fn new() -> Workplace {
        Workplace { server: Server::start(), root: tempfile::tempdir().unwrap() }
    }

    /// One whose server has the weights of small networks; `None` where the golden data are missing.
    fn with_networks() -> Option<Workplace> {
        let root = std::env::var_os("RARE_SHARED").map(PathBuf::from);
        let root =
            root.unwrap_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared"));
        let folder = root.join("golden/rare/tiny-pipeline");
        let required = std::env::var("RARE_REQUIRE_SHARED").as_deref() == Ok("1");
        assert!(folder.exists() || !required, "RARE_REQUIRE_SHARED=1, but no {}", folder.display());
        let server = folder.exists().then(|| Server::start_with(&folder))?;
        Some(Workplace { server, root: tempfile::tempdir().unwrap() })
    }

    fn path(&self, file: &str) -> PathBuf {
        self.root.path().join(file)
    }

    /// The program, knowing nothing of this machine.
    fn command(&self, program: &str) -> Command {
        let mut command = Command::new(program);
        command
            .current_dir(self.root.path())
            .env_clear()
            .env("HF_HOME", self.path("home"))
            .env("HF_ENDPOINT", self.server.endpoint())
            .env("PATH", std::env::var_os("PATH").unwrap_or_default());
        command
    }

    fn run(&self, arguments: &[&str]) -> Output {
        self.command(env!("CARGO_BIN_EXE_rare")).arg("weights").args(arguments).output().unwrap()
    }

    /// The parts of downloads.
    fn parts(&self) -> Vec<PathBuf> {
        let entries = fs::read_dir(self.path("w/unet")).into_iter().flatten();
        let mut parts: Vec<PathBuf> = entries.map(|entry| entry.unwrap().path()).collect();
        parts.retain(|path| path.extension().is_some_and(|extension| extension == "part"));
        parts
    }
}

/// The exit code, stdout and stderr.
fn said(output: &Output) -> (i32, String, String) {
    let text = |bytes: &[u8]| String::from_utf8(bytes.to_vec()).unwrap();
    (output.status.code().unwrap(), text(&output.stdout), text(&output.stderr))
}

#[test]
fn the_list_names_what_is_not_verified() {
    let (code, stdout, stderr) = said(&Workplace::new().run(&["list"]));
    assert_eq!(code, 0);
    for word in ["stable-diffusion-v1-5", "lllyasviel", UNET, "CreativeML OpenRAIL-M"] {
        assert!(stdout.contains(word), "{word} is missing in {stdout}");
    }
    assert!(stdout.contains("unverified") && stderr.contains("unverified"), "{stderr}");
}

#[test]
fn what_is_fetched_can_be_checked() {
    let Some(workplace) = Workplace::with_networks() else { return };
    let (code, stdout, stderr) = said(&workplace.run(&["fetch", "w"]));
    assert_eq!((code, stdout.as_str()), (0, "w\n"), "{stderr}");
    assert_eq!(stderr.matches("CreativeML OpenRAIL-M").count(), 1, "{stderr}");
    for word in [UNET, "3.9 MB", "10 downloaded"] {
        assert!(stderr.contains(word), "{word} is missing in {stderr}");
    }
    let (code, stdout, stderr) = said(&workplace.run(&["check", "w"]));
    assert_eq!((code, stdout.lines().count()), (0, 10), "{stderr}");
    for word in ["10 files", "as they were fetched", "warning: "] {
        assert!(stderr.contains(word), "{word} is missing in {stderr}");
    }
    let again = said(&workplace.run(&["fetch", "w", "--quiet"]));
    assert_eq!(again, (0, "w\n".to_owned(), String::new()));
    fs::write(workplace.path("w").join(UNET), "other").unwrap();
    let (code, stdout, stderr) = said(&workplace.run(&["check", "w"]));
    assert_eq!((code, stdout.as_str(), stderr.lines().count()), (2, "", 1), "{stderr}");
    assert!(stderr.starts_with("error: ") && stderr.contains(UNET), "{stderr}");
}

#[test]
fn the_folder_is_by_default_beside_the_cache() {
    let workplace = Workplace::new();
    let (code, stdout, stderr) = said(&workplace.run(&["fetch", "--quiet"]));
    assert_eq!((code, stderr.as_str()), (0, ""));
    let folder = PathBuf::from(stdout.trim_end());
    assert!(folder.starts_with(workplace.path("home")) && folder.join(UNET).is_file(), "{stdout}");
    // What was made up for the test is as it was fetched, but no network.
    let (code, _, stderr) = said(&workplace.run(&["check"]));
    assert!(code == 2 && stderr.contains("model_index.json"), "{stderr}");
    let other = ["fetch", "--quiet", "--precision", "f32", "--controlnet", "v1.0"];
    let (code, other, _) = said(&workplace.run(&other));
    assert!(code == 0 && other != stdout && other.contains("v1.0-f32"), "{other}");
}

#[test]
fn a_refusal_is_one_line_and_code_2() {
    let workplace = Workplace::new();
    workplace.server.fail("v11f1p", Fault::Locked);
    let (code, stdout, stderr) = said(&workplace.run(&["fetch", "w", "--quiet"]));
    assert_eq!((code, stdout.as_str(), stderr.lines().count()), (2, "", 1), "{stderr}");
    assert!(stderr.starts_with("error: ") && stderr.contains("HF_TOKEN"), "{stderr}");
    let mut command = workplace.command(env!("CARGO_BIN_EXE_rare"));
    let command = command.args(["weights", "fetch", "w"]).env("HF_TOKEN", "hf_good");
    assert_eq!(said(&command.output().unwrap()).0, 0);
    let elsewhere = workplace.run(&["fetch", "x", "--endpoint", "ftp://example.org"]);
    assert!(said(&elsewhere).2.contains("https://HOST"));
    let mut command = workplace.command(env!("CARGO_BIN_EXE_rare"));
    let command = command.args(["weights", "fetch", "x"]).env("HF_HUB_OFFLINE", "1");
    let (code, _, stderr) = said(&command.output().unwrap());
    assert!(code == 2 && stderr.contains("unset HF_HUB_OFFLINE"), "{stderr}");
    let (code, _, stderr) = said(&workplace.run(&["check", "nowhere"]));
    assert!(code == 2 && stderr.contains("nowhere"), "{stderr}");
}

/// A limit on the length of files makes writing fail in the way a full disk does.
#[cfg(unix)]
#[test]
fn no_room_for_a_file_leaves_a_part_that_is_continued() {
    let workplace = Workplace::new();
    let limited = "ulimit -f 64; trap '' XFSZ; exec \"$0\" weights fetch w --quiet";
    let output = workplace.command("sh").args(["-c", limited, env!("CARGO_BIN_EXE_rare")]).output();
    let (code, stdout, stderr) = said(&output.unwrap());
    assert_eq!((code, stdout.as_str(), stderr.lines().count()), (2, "", 1), "{stderr}");
    for word in ["model.fp16.safetensors", "300000 bytes", "make room"] {
        assert!(stderr.contains(word), "{word} is missing in {stderr}");
    }
    assert!(!workplace.path("w/text_encoder/model.fp16.safetensors").exists());
    assert_eq!(said(&workplace.run(&["check", "w"])).0, 2);
    workplace.server.requests();
    assert_eq!(said(&workplace.run(&["fetch", "w", "--quiet"])).0, 0);
    let continued = |request: &crate::weights_server::Request| request.range.is_some();
    assert!(workplace.server.requests().iter().any(continued));
}

/// Ended by a signal in the middle of a file: as by Ctrl-C, whose signal shells let their background jobs ignore.
#[cfg(unix)]
#[test]
fn an_interrupted_download_is_no_file() {
    let workplace = Workplace::new();
    workplace.server.fail("unet/", Fault::Stall { after: 100_000 });
    let mut command = workplace.command(env!("CARGO_BIN_EXE_rare"));
    let command = command.args(["weights", "fetch", "w"]).stderr(Stdio::null());
    let mut child = command.stdout(Stdio::null()).spawn().unwrap();
    let length = || Some(workplace.parts().first()?.metadata().ok()?.len());
    while length() != Some(100_000) {
        assert!(child.try_wait().unwrap().is_none(), "the program has ended");
        thread::sleep(Duration::from_millis(10));
    }
    let interrupted = Command::new("kill").args(["-TERM", &child.id().to_string()]).status();
    assert!(interrupted.unwrap().success());
    assert!(!child.wait().unwrap().success());
    assert!(!workplace.path("w").join(UNET).exists());
    assert_eq!(said(&workplace.run(&["check", "w"])).0, 2);
    workplace.server.recover();
    assert_eq!(said(&workplace.run(&["fetch", "w", "--quiet"])).0, 0);
    assert!(workplace.path("w").join(UNET).exists() && workplace.parts().is_empty());
}
