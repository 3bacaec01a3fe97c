//! The folders in which a part of a pipeline may be: the given one, or the snapshots in a cache of the hub.

use std::fs;
use std::path::{Path, PathBuf};

use rare::{Error, Result};

/// The folders to look into, in the order of precedence.
#[derive(Debug)]
pub(super) struct Places {
    /// What the caller gave.
    pub(super) given: PathBuf,
    /// At least one.
    pub(super) folders: Vec<PathBuf>,
}

impl Places {
    /// Takes `folder` itself and the snapshot of every repository that is cached in it.
    pub(super) fn open(folder: &Path) -> Result<Places> {
        let mut folders = vec![folder.to_owned()];
        if folder.join("snapshots").is_dir() {
            folders.push(snapshot(folder)?);
        }
        for name in entries(folder)? {
            let path = folder.join(&name);
            if name.starts_with("models--") && path.join("snapshots").is_dir() && is_wanted(&name) {
                folders.push(snapshot(&path)?);
            }
        }
        Ok(Places { given: folder.to_owned(), folders })
    }

    /// The first place where `relative` is a file.
    pub(super) fn file(&self, relative: &str) -> Option<PathBuf> {
        self.folders.iter().map(|folder| folder.join(relative)).find(|path| path.is_file())
    }

    /// The first place where `relative` is a folder.
    pub(super) fn folder(&self, relative: &str) -> Option<PathBuf> {
        self.folders.iter().map(|folder| folder.join(relative)).find(|path| path.is_dir())
    }

    /// A part is missing: says what was looked for and what is there.
    pub(super) fn missing(&self, part: &str, looked_for: &str) -> Error {
        let mut found: Vec<String> =
            self.folders.iter().flat_map(|folder| entries(folder).unwrap_or_default()).collect();
        found.sort();
        found.dedup();
        let count = found.len();
        found.truncate(20);
        let found = match count {
            0 => "nothing".to_owned(),
            1..=20 => found.join(", "),
            _ => format!("{}, ... ({count} entries)", found.join(", ")),
        };
        Error::in_file(
            &self.given,
            format!("there is no {part}: looked for {looked_for}; found {found}"),
        )
    }
}

/// A cache of the hub may hold a hundred repositories; only those of the right models are looked into, whoever owns them.
fn is_wanted(name: &str) -> bool {
    let repository = name.rsplit("--").next().unwrap_or_default();
    ["stable-diffusion-v1-5", "control_v11f1p_sd15_depth", "sd-controlnet-depth"]
        .contains(&repository)
}

/// The snapshot of a cached repository that its branch `main` means, or the only one.
fn snapshot(repository: &Path) -> Result<PathBuf> {
    let snapshots = repository.join("snapshots");
    let named = fs::read_to_string(repository.join("refs").join("main")).unwrap_or_default();
    let all = entries(&snapshots)?;
    if all.iter().any(|name| name == named.trim()) {
        return Ok(snapshots.join(named.trim()));
    }
    match all.as_slice() {
        [only] => Ok(snapshots.join(only)),
        _ => Err(Error::in_file(
            &snapshots,
            format!(
                "holds {} snapshots and refs/main names none of them: give the folder of one of them instead",
                all.len()
            ),
        )),
    }
}

/// The names in a folder, sorted.
pub(super) fn entries(folder: &Path) -> Result<Vec<String>> {
    let io = |cause| Error::io(folder, cause);
    let mut names = fs::read_dir(folder)
        .map_err(io)?
        .map(|entry| Ok(entry.map_err(io)?.file_name().to_string_lossy().into_owned()))
        .collect::<Result<Vec<String>>>()?;
    names.sort();
    Ok(names)
}
