//! Whether a folder still holds what was put into it.

use std::fs;
use std::io::ErrorKind;
use std::path::Path;

use rare::{Error, Result};

use super::digest::fingerprint;
use super::lock::{LOCK_FILE, Lock, LockedFile};

/// A folder that holds what its record says, and all of it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Checked {
    /// The record.
    pub lock: Lock,
    /// How long all files are together, bytes.
    pub bytes: u64,
}

/// Reads all files of a folder and compares their lengths and hashes with the record beside them.
///
/// # Errors
/// `InvalidInput` if there is no record, if it lacks a file that the pipeline needs, or if a file is missing or differs
/// from it; `Io` if one cannot be read.
pub fn check(folder: &Path) -> Result<Checked> {
    let Some(lock) = Lock::read(folder)? else {
        return Err(Error::in_file(
            folder.join(LOCK_FILE),
            "no such file: only folders that were made by `rare weights fetch` have a record to check them against",
        ));
    };
    let missing = missing_files(&lock);
    if !missing.is_empty() {
        return Err(Error::in_file(
            folder,
            format!("not fetched yet: {}: fetch the weights again", missing.join(", ")),
        ));
    }
    lock.files().iter().try_for_each(|file| check_file(folder, file))?;
    let bytes = lock.files().iter().map(|file| file.bytes).sum();
    Ok(Checked { lock, bytes })
}

/// The files of the pipeline that the record does not have.
pub(super) fn missing_files(lock: &Lock) -> Vec<String> {
    let choice = lock.choice();
    let files = choice.sources().flat_map(|source| {
        source.files_in(choice.precision).map(|file| {
            file.candidates().into_iter().map(|path| source.place(&path)).collect::<Vec<String>>()
        })
    });
    files
        .filter(|places| !places.iter().any(|place| lock.find(place).is_some()))
        .filter_map(|places| places.into_iter().next())
        .collect()
}

/// Compares one file with its record: first the length, which costs nothing.
pub(super) fn check_file(folder: &Path, file: &LockedFile) -> Result<()> {
    let path = file.path(folder);
    let remedy = "remove it and fetch the weights again";
    let metadata = match fs::metadata(&path) {
        Ok(metadata) => metadata,
        Err(error) if error.kind() == ErrorKind::NotFound => {
            return Err(Error::in_file(path, "no such file: fetch the weights again"));
        }
        Err(error) => return Err(Error::io(path, error)),
    };
    if !metadata.is_file() {
        return Err(Error::in_file(path, format!("this is not a regular file: {remedy}")));
    }
    if metadata.len() != file.bytes {
        let found = metadata.len();
        let message = format!("{found} bytes, recorded were {}: {remedy}", file.bytes);
        return Err(Error::in_file(path, message));
    }
    let found = fingerprint(&path).map_err(|error| Error::io(&path, error))?;
    if found.sha256 != file.sha256 {
        let message = format!("SHA-256 {}, recorded was {}: {remedy}", found.sha256, file.sha256);
        return Err(Error::in_file(path, message));
    }
    Ok(())
}
