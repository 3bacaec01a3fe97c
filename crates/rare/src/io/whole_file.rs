//! Whole files: read into memory at once, written completely or not at all.

use std::fs::{self, File};
use std::io::{self, BufWriter, ErrorKind, Write};
use std::path::{Path, PathBuf};

use crate::error::{Error, Result};

/// Size of the buffer between a writer and its file, bytes.
const BUFFER: usize = 1 << 16;

/// The content of a regular file that is not empty.
///
/// # Errors
/// `Io` if the file cannot be opened or read, `InvalidInput` if it is a folder, a device or empty.
pub(super) fn read_whole(path: &Path) -> Result<Vec<u8>> {
    let metadata = fs::metadata(path).map_err(|error| explain_missing(path, error))?;
    if metadata.is_dir() {
        return Err(Error::in_file(path, "this is a folder: name a file in it"));
    }
    // A device or a pipe has no length to check the counts of a header against, and may never end.
    if !metadata.is_file() {
        return Err(Error::in_file(path, "this is not a regular file: copy its content into one"));
    }
    let bytes = fs::read(path).map_err(|error| Error::io(path, error))?;
    if bytes.is_empty() {
        return Err(Error::in_file(path, "the file is empty: write it again"));
    }
    Ok(bytes)
}

fn explain_missing(path: &Path, error: io::Error) -> Error {
    match error.kind() {
        ErrorKind::NotFound => {
            Error::io(path, io::Error::new(ErrorKind::NotFound, "no such file: check the path"))
        }
        _ => Error::io(path, error),
    }
}

/// Writes a file whole or not at all: `write` fills a temporary file in the same folder, which then takes the name
/// `path` in one step. If `write` or the disk fails, what stood at `path` stays as it was and nothing else is left.
///
/// A link is followed, an existing file keeps its permissions, and something that is not a regular file (`/dev/stdout`)
/// is written to directly.
///
/// # Errors
/// `InvalidInput` if `path` is a folder or its folder does not exist, `Io` if writing fails.
pub fn write_whole(
    path: impl AsRef<Path>,
    write: impl FnOnce(&mut dyn Write) -> io::Result<()>,
) -> Result<()> {
    let path = path.as_ref();
    let existing = fs::metadata(path).ok();
    match &existing {
        Some(metadata) if metadata.is_dir() => {
            Err(Error::in_file(path, "this is a folder: name a file to write in it"))
        }
        Some(metadata) if !metadata.is_file() => {
            write_through(path, write).map_err(|error| Error::io(path, error))
        }
        _ => write_beside(path, existing.map(|metadata| metadata.permissions()), write),
    }
}

fn write_through(
    path: &Path,
    write: impl FnOnce(&mut dyn Write) -> io::Result<()>,
) -> io::Result<()> {
    let mut writer = BufWriter::with_capacity(BUFFER, File::options().write(true).open(path)?);
    write(&mut writer)?;
    writer.flush()
}

fn write_beside(
    path: &Path,
    permissions: Option<fs::Permissions>,
    write: impl FnOnce(&mut dyn Write) -> io::Result<()>,
) -> Result<()> {
    // Renaming onto a link would replace the link instead of what it points to.
    let target = fs::canonicalize(path).unwrap_or_else(|_| path.to_path_buf());
    let folder = folder_of(&target);
    if !folder.is_dir() {
        let missing = format!("the folder {} does not exist: create it first", folder.display());
        return Err(Error::in_file(path, missing));
    }
    replace(&target, &folder, permissions, write).map_err(|error| Error::io(path, error))
}

fn replace(
    target: &Path,
    folder: &Path,
    permissions: Option<fs::Permissions>,
    write: impl FnOnce(&mut dyn Write) -> io::Result<()>,
) -> io::Result<()> {
    let mut file = temporary_file(folder)?;
    let mut writer = BufWriter::with_capacity(BUFFER, file.as_file_mut());
    write(&mut writer)?;
    writer.flush()?;
    drop(writer);
    if let Some(permissions) = permissions {
        file.as_file().set_permissions(permissions)?;
    }
    file.persist(target).map(drop).map_err(|error| error.error)
}

/// A temporary file with the permissions of an ordinary new one (0666 less the umask) instead of 0600.
#[cfg(unix)]
fn temporary_file(folder: &Path) -> io::Result<tempfile::NamedTempFile> {
    use std::os::unix::fs::PermissionsExt;
    let ordinary = fs::Permissions::from_mode(0o666);
    tempfile::Builder::new().prefix(".rare-").permissions(ordinary).tempfile_in(folder)
}

#[cfg(not(unix))]
fn temporary_file(folder: &Path) -> io::Result<tempfile::NamedTempFile> {
    tempfile::Builder::new().prefix(".rare-").tempfile_in(folder)
}

fn folder_of(path: &Path) -> PathBuf {
    match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent.to_path_buf(),
        _ => PathBuf::from("."),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(folder: &Path) -> Vec<String> {
        let mut names: Vec<String> = fs::read_dir(folder)
            .unwrap()
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .collect();
        names.sort();
        names
    }

    #[test]
    fn a_file_is_written_whole() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.txt");
        write_whole(&path, |writer| writer.write_all(b"one")).unwrap();
        write_whole(&path, |writer| writer.write_all(b"two")).unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"two");
        assert_eq!(names(folder.path()), ["a.txt"]);
    }

    #[test]
    fn a_failure_leaves_what_was_there_and_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.txt");
        write_whole(&path, |writer| writer.write_all(b"one")).unwrap();
        let failing = |writer: &mut dyn Write| {
            writer.write_all(b"half")?;
            Err(io::Error::other("the disk is full"))
        };
        let message = write_whole(&path, failing).unwrap_err().to_string();
        assert!(message.contains("a.txt") && message.contains("the disk is full"), "{message}");
        assert_eq!(fs::read(&path).unwrap(), b"one");
        assert_eq!(names(folder.path()), ["a.txt"]);
    }

    #[test]
    fn a_missing_folder_and_a_folder_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let missing = folder.path().join("nowhere/a.txt");
        let message = write_whole(&missing, |_| Ok(())).unwrap_err().to_string();
        assert!(message.contains("nowhere does not exist: create it"), "{message}");
        let message = write_whole(folder.path(), |_| Ok(())).unwrap_err().to_string();
        assert!(message.contains("this is a folder"), "{message}");
    }

    #[cfg(unix)]
    #[test]
    fn permissions_are_ordinary_and_links_are_followed() {
        use std::os::unix::fs::{PermissionsExt, symlink};
        let mode = |path: &Path| fs::metadata(path).unwrap().permissions().mode() & 0o777;
        let folder = tempfile::tempdir().unwrap();
        let (plain, ours) = (folder.path().join("plain"), folder.path().join("ours"));
        File::create(&plain).unwrap();
        write_whole(&ours, |writer| writer.write_all(b"x")).unwrap();
        assert_eq!(mode(&ours), mode(&plain));
        fs::set_permissions(&ours, fs::Permissions::from_mode(0o640)).unwrap();
        let link = folder.path().join("link");
        symlink(&ours, &link).unwrap();
        write_whole(&link, |writer| writer.write_all(b"y")).unwrap();
        assert_eq!((mode(&ours), fs::read(&ours).unwrap()), (0o640, b"y".to_vec()));
        assert!(fs::symlink_metadata(&link).unwrap().is_symlink());
    }
}
