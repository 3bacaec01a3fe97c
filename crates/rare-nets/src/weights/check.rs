//! Whether a folder still holds what was put into it, and whether the networks can use that.

use std::fs;
use std::io::ErrorKind;
use std::path::Path;

use rare::{Error, Result};

use super::digest::fingerprint;
use super::lock::{LOCK_FILE, Lock, LockedFile};
use crate::diffusion::{Pipeline, controlnet_layout, require, text_encoder_layout, unet_layout};

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

/// Opens the pipeline in a folder, wherever it is from, and compares the names and shapes of all tensors with those of
/// the networks; no value is read.
///
/// # Errors
/// Those of [`Pipeline::open`], and `InvalidInput` with the first tensors that are missing, unknown or of another shape.
pub fn open(folder: &Path) -> Result<Pipeline> {
    let pipeline = Pipeline::open(folder)?;
    require(&unet_layout(&pipeline.unet_config), &pipeline.unet, "U-Net")?;
    let controlnet = controlnet_layout(&pipeline.controlnet_config);
    require(&controlnet, &pipeline.controlnet, "ControlNet")?;
    let text_encoder = text_encoder_layout(&pipeline.text_config);
    require(&text_encoder, &pipeline.text_encoder, "text encoder")?;
    Ok(pipeline)
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
