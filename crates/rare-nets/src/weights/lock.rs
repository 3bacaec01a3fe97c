//! The record of what was put into a pipeline folder.

use std::fs;
use std::io::ErrorKind;
use std::path::{Component, Path, PathBuf};

use rare::{Error, Result};
use serde::{Deserialize, Serialize};

use super::digest::is_hexadecimal;
use super::{Choice, ControlNetVersion, Precision};

/// The name of the record in its folder.
pub const LOCK_FILE: &str = "rare-weights.json";

/// The version of the format.
const VERSION: u32 = 1;
/// A record names a dozen files; one that is longer than this is none.
const MAX_BYTES: u64 = 1 << 20;

/// What was put into a folder: by content, and where it came from.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Lock {
    version: u32,
    controlnet: ControlNetVersion,
    precision: Precision,
    files: Vec<LockedFile>,
}

/// A file of the folder.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LockedFile {
    /// Its path in the folder, with `/` between the parts.
    pub file: String,
    /// Its length.
    pub bytes: u64,
    /// Its SHA-256 in hexadecimal digits.
    pub sha256: String,
    /// The repository that it is from, `owner/name`.
    pub repository: String,
    /// The commit of that repository.
    pub commit: String,
    /// The address of the file in that commit, without credentials.
    pub url: String,
    /// The terms of use.
    pub licence: String,
}

impl Lock {
    /// The record of a folder that is to hold `choice` and has nothing yet.
    #[must_use]
    pub fn new(choice: Choice) -> Lock {
        let Choice { controlnet, precision } = choice;
        Lock { version: VERSION, controlnet, precision, files: Vec::new() }
    }

    /// Reads the record of a folder; `None` if there is none.
    ///
    /// # Errors
    /// `Io` if it cannot be read, `InvalidInput` if it is no such record or names a file outside of its folder.
    pub fn read(folder: &Path) -> Result<Option<Lock>> {
        let path = folder.join(LOCK_FILE);
        let metadata = match fs::metadata(&path) {
            Ok(metadata) => metadata,
            Err(error) if error.kind() == ErrorKind::NotFound => return Ok(None),
            Err(error) => return Err(Error::io(path, error)),
        };
        if !metadata.is_file() || metadata.len() > MAX_BYTES {
            return Err(broken(&path, "this is no record of weights"));
        }
        let text = fs::read_to_string(&path).map_err(|error| Error::io(&path, error))?;
        let lock: Lock =
            serde_json::from_str(&text).map_err(|error| broken(&path, &error.to_string()))?;
        lock.check_entries(&path)?;
        Ok(Some(lock))
    }

    /// Writes the record, whole or not at all.
    ///
    /// # Errors
    /// `Io` if that fails.
    pub fn write(&self, folder: &Path) -> Result<()> {
        let text = serde_json::to_string_pretty(self)
            .map_err(|error| Error::Internal(format!("the record of weights: {error}")))?;
        rare::io::write_whole(folder.join(LOCK_FILE), |writer| {
            writer.write_all(text.as_bytes())?;
            writer.write_all(b"\n")
        })
    }

    /// What the folder is to hold.
    #[must_use]
    pub fn choice(&self) -> Choice {
        Choice { controlnet: self.controlnet, precision: self.precision }
    }

    /// The files, sorted by path.
    #[must_use]
    pub fn files(&self) -> &[LockedFile] {
        &self.files
    }

    /// The record of the file `file`.
    #[must_use]
    pub fn find(&self, file: &str) -> Option<&LockedFile> {
        self.files.iter().find(|locked| locked.file == file)
    }

    /// Adds a file, in the place of the one of the same name.
    pub fn put(&mut self, file: LockedFile) {
        self.files.retain(|locked| locked.file != file.file);
        self.files.push(file);
        self.files.sort_by(|a, b| a.file.cmp(&b.file));
    }

    /// The commit from which the files of `repository` are.
    #[must_use]
    pub fn commit_of(&self, repository: &str) -> Option<&str> {
        let of_it = |file: &&LockedFile| file.repository == repository;
        self.files.iter().find(of_it).map(|file| file.commit.as_str())
    }

    fn check_entries(&self, path: &Path) -> Result<()> {
        if self.version != VERSION {
            let version = self.version;
            return Err(Error::Unsupported(format!(
                "{}: version {version} of the record, this program knows {VERSION}: fetch the weights into another folder",
                path.display()
            )));
        }
        let foul = |file: &&LockedFile| {
            !stays_inside(&file.file)
                || !is_hexadecimal(&file.sha256, 64)
                || !is_hexadecimal(&file.commit, 40)
        };
        match self.files.iter().find(foul) {
            Some(file) => Err(broken(path, &format!("the entry of {:?} is damaged", file.file))),
            None => Ok(()),
        }
    }
}

impl LockedFile {
    /// Where it lies.
    #[must_use]
    pub fn path(&self, folder: &Path) -> PathBuf {
        place_in(folder, &self.file)
    }
}

/// The path of `file` (with `/` between the parts) in `folder`.
pub(super) fn place_in(folder: &Path, file: &str) -> PathBuf {
    folder.join(file.split('/').collect::<PathBuf>())
}

/// A record is a file that others may have written: it must not lead out of its folder.
fn stays_inside(file: &str) -> bool {
    let mut components = Path::new(file).components();
    !file.is_empty() && components.all(|part| matches!(part, Component::Normal(_)))
}

fn broken(path: &Path, what: &str) -> Error {
    Error::in_file(path, format!("{what}: remove it and fetch the weights again"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn entry(file: &str) -> LockedFile {
        LockedFile {
            file: file.to_owned(),
            bytes: 3,
            sha256: "0".repeat(64),
            repository: "owner/name".to_owned(),
            commit: "1".repeat(40),
            url: "https://example.org/owner/name/resolve/1/a".to_owned(),
            licence: "none".to_owned(),
        }
    }

    #[test]
    fn what_is_written_is_read_and_sorted() {
        let folder = tempfile::tempdir().unwrap();
        assert_eq!(Lock::read(folder.path()).unwrap(), None);
        let mut lock = Lock::new(Choice::default());
        lock.put(entry("unet/config.json"));
        lock.put(entry("controlnet/config.json"));
        lock.put(LockedFile { bytes: 4, ..entry("unet/config.json") });
        lock.write(folder.path()).unwrap();
        let read = Lock::read(folder.path()).unwrap().unwrap();
        assert_eq!(read, lock);
        let files: Vec<_> = read.files().iter().map(|file| (&*file.file, file.bytes)).collect();
        assert_eq!(files, [("controlnet/config.json", 3), ("unet/config.json", 4)]);
    }

    #[test]
    fn a_record_that_leads_out_of_its_folder_or_is_damaged_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let refuse = |change: fn(&mut LockedFile), word: &str| {
            let mut lock = Lock::new(Choice::default());
            let mut file = entry("unet/config.json");
            change(&mut file);
            lock.put(file);
            lock.write(folder.path()).unwrap();
            let message = Lock::read(folder.path()).unwrap_err().to_string();
            assert!(message.contains(word) && message.contains(LOCK_FILE), "{message}");
        };
        refuse(|file| file.file = "../secret".to_owned(), "../secret");
        refuse(|file| file.file = "/etc/passwd".to_owned(), "/etc/passwd");
        refuse(|file| file.file = String::new(), "damaged");
        refuse(|file| file.sha256 = "x".repeat(64), "unet/config.json");
        refuse(|file| file.commit = "../../..".to_owned(), "unet/config.json");
        fs::write(folder.path().join(LOCK_FILE), "{}").unwrap();
        assert!(Lock::read(folder.path()).unwrap_err().to_string().contains("fetch"));
    }
}
