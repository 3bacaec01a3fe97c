//! An open file that any number of threads read at any place.

use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};

use rare::{Error, Result};

/// A file that stays open: what is read later is what was opened, even if another file takes its name meanwhile.
#[derive(Debug)]
pub(super) struct WeightFile {
    path: PathBuf,
    file: File,
    length: u64,
}

impl WeightFile {
    /// Opens a file.
    pub(super) fn open(path: &Path) -> Result<WeightFile> {
        let file = File::open(path).map_err(|cause| Error::io(path, cause))?;
        let metadata = file.metadata().map_err(|cause| Error::io(path, cause))?;
        if !metadata.is_file() {
            return Err(Error::in_file(path, "is not a regular file"));
        }
        let opened = WeightFile { path: path.to_owned(), file, length: metadata.len() };
        opened.refuse_pointer()?;
        Ok(opened)
    }

    /// A clone of a repository without Git LFS has small texts in place of the weights.
    fn refuse_pointer(&self) -> Result<()> {
        const POINTER: &[u8] = b"version https://git-lfs";
        let mut start = [0; POINTER.len()];
        if self.length < POINTER.len() as u64 {
            return Ok(());
        }
        self.read_at(&mut start, 0)?;
        if start == POINTER {
            let what = "is a pointer of Git LFS, not the file itself: fetch that with git lfs pull";
            return Err(Error::in_file(&self.path, what));
        }
        Ok(())
    }

    /// Where it was opened.
    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// Bytes at the time of opening.
    pub(super) fn length(&self) -> u64 {
        self.length
    }

    /// The open file, for a reader of its own.
    pub(super) fn file(&self) -> &File {
        &self.file
    }

    /// Fills `buffer` with the bytes from `offset` on. A file that became shorter since it was opened is refused.
    pub(super) fn read_at(&self, buffer: &mut [u8], offset: u64) -> Result<()> {
        read_exact_at(&self.file, buffer, offset).map_err(|cause| match cause.kind() {
            io::ErrorKind::UnexpectedEof => Error::in_file(
                &self.path,
                format!("ends before byte {}: the file is truncated", offset + buffer.len() as u64),
            ),
            _ => Error::io(&self.path, cause),
        })
    }
}

#[cfg(unix)]
fn read_exact_at(file: &File, buffer: &mut [u8], offset: u64) -> io::Result<()> {
    std::os::unix::fs::FileExt::read_exact_at(file, buffer, offset)
}

#[cfg(windows)]
fn read_exact_at(file: &File, mut buffer: &mut [u8], mut offset: u64) -> io::Result<()> {
    while !buffer.is_empty() {
        match std::os::windows::fs::FileExt::seek_read(file, buffer, offset) {
            Ok(0) => return Err(io::ErrorKind::UnexpectedEof.into()),
            Ok(count) => {
                buffer = buffer.split_at_mut(count).1;
                offset += count as u64;
            }
            Err(cause) if cause.kind() == io::ErrorKind::Interrupted => {}
            Err(cause) => return Err(cause),
        }
    }
    Ok(())
}
