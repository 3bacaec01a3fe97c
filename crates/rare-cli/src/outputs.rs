//! Which files a command may write, decided before any work is done.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Result, bail};

/// A file to be written, and the option that named it.
pub(crate) struct Output<'a> {
    pub(crate) option: &'static str,
    pub(crate) path: &'a Path,
}

/// Makes sure that every output can be written, and is neither an input nor another output.
///
/// # Errors
/// If an output is a folder, its folder does not exist, or it is the same file as an input or another output, however
/// either is spelled.
pub(crate) fn check(inputs: &[&Path], outputs: &[Output<'_>]) -> Result<()> {
    for (index, output) in outputs.iter().enumerate() {
        check_place(output)?;
        let Some(file) = identity(output.path) else { continue };
        if let Some(input) = inputs.iter().find(|input| read_file(input).as_ref() == Some(&file)) {
            bail!(
                "{} {} is the input {}: choose another name, inputs are never overwritten",
                output.option,
                output.path.display(),
                input.display()
            );
        }
        let others = outputs.iter().take(index);
        if let Some(other) = others.into_iter().find(|o| identity(o.path).as_ref() == Some(&file)) {
            bail!(
                "{} and {} are the same file {}: give each its own",
                other.option,
                output.option,
                output.path.display()
            );
        }
    }
    Ok(())
}

/// Makes sure that files can be written into a folder, which may have to be made.
///
/// # Errors
/// If there is a file of this name, or the folder that would hold it does not exist.
pub(crate) fn check_folder(option: &'static str, folder: &Path) -> Result<()> {
    if folder.is_file() {
        bail!("{option} {}: this is a file: name a folder", folder.display());
    }
    if folder.is_dir() { Ok(()) } else { check_place(&Output { option, path: folder }) }
}

fn check_place(output: &Output<'_>) -> Result<()> {
    let Output { option, path } = output;
    if path.is_dir() {
        bail!("{option} {}: this is a folder: name a file to write in it", path.display());
    }
    let folder = folder_of(path);
    if !folder.is_dir() {
        bail!(
            "{option} {}: the folder {} does not exist: create it first",
            path.display(),
            folder.display()
        );
    }
    Ok(())
}

/// The file that an input's name means: `file.npz:points` selects a part of `file.npz`.
fn read_file(input: &Path) -> Option<PathBuf> {
    let whole = || input.to_str()?.rsplit_once(':').map(|(file, _)| PathBuf::from(file));
    if input.exists() { identity(input) } else { identity(&whole()?) }
}

/// One spelling for every name of a file; `None` for what is not a file (`/dev/null`), which cannot be overwritten.
fn identity(path: &Path) -> Option<PathBuf> {
    match fs::canonicalize(path) {
        Ok(file) => Some(file).filter(|file| file.is_file()),
        Err(_) => Some(fs::canonicalize(folder_of(path)).ok()?.join(path.file_name()?)),
    }
}

fn folder_of(path: &Path) -> &Path {
    match path.parent() {
        Some(folder) if folder != Path::new("") => folder,
        _ => Path::new("."),
    }
}
