//! A server, a folder and a cache for one test.

use std::fs;
use std::path::PathBuf;
use std::time::Duration;

use rare_nets::weights::fetch::{Event, fetch};
use rare_nets::weights::{Choice, Hub, Lock, check};

use crate::weights_server::{COMMIT, Request, Server, tag};

pub(crate) const UNET: &str = "unet/diffusion_pytorch_model.fp16.safetensors";
pub(crate) const STABLE_DIFFUSION: &str = "stable-diffusion-v1-5/stable-diffusion-v1-5";
pub(crate) const CONTROLNET: &str = "lllyasviel/control_v11f1p_sd15_depth";

/// A server, an empty folder for the weights and an empty cache.
pub(crate) struct Workplace {
    pub(crate) server: Server,
    root: tempfile::TempDir,
    pub(crate) hub: Hub,
}

/// What came of a run: the outcome and what was told.
pub(crate) struct Run {
    pub(crate) outcome: rare::Result<Lock>,
    pub(crate) told: Vec<String>,
}

impl Workplace {
    pub(crate) fn new() -> Workplace {
        Workplace::with(Server::start())
    }

    pub(crate) fn with(server: Server) -> Workplace {
        let root = tempfile::tempdir().unwrap();
        let hub = Hub {
            endpoint: server.endpoint(),
            token: None,
            cache: root.path().join("hub"),
            offline: false,
            pause: Duration::from_millis(1),
        };
        Workplace { server, root, hub }
    }

    pub(crate) fn folder(&self) -> PathBuf {
        self.root.path().join("weights")
    }

    pub(crate) fn path(&self, file: &str) -> PathBuf {
        self.folder().join(file)
    }

    pub(crate) fn run(&self, choice: Choice) -> Run {
        let mut told = Vec::new();
        let mut tell = |event: Event<'_>| match event {
            Event::Licence { name, .. } => told.push(format!("licence {name}")),
            Event::Start { file, done, .. } => told.push(format!("start {file} at {done}")),
            Event::Bytes { .. } => {}
            Event::Retry { file, .. } => told.push(format!("retry {file}")),
            Event::End { file, origin, .. } => told.push(format!("end {file} {origin:?}")),
            Event::SinglePrecision { file } => told.push(format!("single {file}")),
        };
        Run { outcome: fetch(&self.folder(), choice, &self.hub, &mut tell), told }
    }

    pub(crate) fn fetch(&self) -> Run {
        self.run(Choice::default())
    }

    /// Fetches in vain: the message has these words, and no file of that name is there.
    #[track_caller]
    pub(crate) fn refuse(&self, file: &str, words: &[&str]) -> Run {
        let run = self.fetch();
        let message = run.outcome.as_ref().unwrap_err().to_string();
        for word in words {
            assert!(message.contains(word), "{word} is missing in: {message}");
        }
        assert!(!self.path(file).exists(), "{file} is there after: {message}");
        assert!(check(&self.folder()).is_err());
        run
    }

    /// The parts of downloads that are in the folder.
    pub(crate) fn parts(&self) -> Vec<PathBuf> {
        let entries = fs::read_dir(self.folder().join("unet")).unwrap();
        let mut parts: Vec<PathBuf> = entries.map(|entry| entry.unwrap().path()).collect();
        parts.retain(|path| path.extension().is_some_and(|extension| extension == "part"));
        parts
    }

    /// Lays a file into the cache as the hub's own programs do.
    pub(crate) fn cache(&self, repository: &str, path: &str, content: &[u8]) {
        let folder = self.hub.cache.join(format!("models--{}", repository.replace('/', "--")));
        let blob = folder.join("blobs").join(tag(path, content));
        let link = folder.join("snapshots").join(COMMIT).join(path);
        for file in [&blob, &link, &folder.join("refs/main")] {
            fs::create_dir_all(file.parent().unwrap()).unwrap();
        }
        fs::write(folder.join("refs/main"), COMMIT).unwrap();
        fs::write(&blob, content).unwrap();
        #[cfg(unix)]
        std::os::unix::fs::symlink(&blob, &link).unwrap();
        #[cfg(not(unix))]
        fs::copy(&blob, &link).unwrap();
    }
}

impl Run {
    #[track_caller]
    pub(crate) fn lock(&self) -> &Lock {
        self.outcome.as_ref().unwrap()
    }

    pub(crate) fn count(&self, word: &str) -> usize {
        self.told.iter().filter(|line| line.contains(word)).count()
    }
}

/// The requests for the content of large files.
pub(crate) fn bodies(requests: &[Request]) -> Vec<&Request> {
    requests.iter().filter(|request| request.path.starts_with("/hosted/")).collect()
}
