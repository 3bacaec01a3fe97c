//! One error type, its variants by who must act.

use std::fmt::Display;
use std::io;
use std::path::{Path, PathBuf};

/// The result of everything in this crate that can fail.
pub type Result<T> = std::result::Result<T, Error>;

/// What went wrong, by who must act. Every message carries the offending value and, where a file is the cause, its path.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The input is wrong: the caller mends the file or the value named in the message.
    #[error("{0}")]
    InvalidInput(String),
    /// The operating system refused: the caller mends the path or its permissions.
    #[error("{}: {cause}", path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What the operating system said. It is part of the message, so it is not a source to be printed once more.
        cause: io::Error,
    },
    /// The input is well-formed, but uses something that this version does not read.
    #[error("{0}")]
    Unsupported(String),
    /// The data do not determine a pose.
    #[error("no pose: {why}")]
    NoPose {
        /// What is missing.
        why: String,
    },
    /// A defect of this library: please report it.
    #[error("internal error (please report it): {0}")]
    Internal(String),
}

impl Error {
    /// Invalid input that is not tied to a file.
    pub fn invalid(what: impl Into<String>) -> Error {
        Error::InvalidInput(what.into())
    }

    /// Invalid content of the file `path`.
    pub fn in_file(path: impl AsRef<Path>, what: impl Display) -> Error {
        Error::InvalidInput(format!("{}: {what}", path.as_ref().display()))
    }

    /// An operating-system error about `path`.
    pub fn io(path: impl Into<PathBuf>, cause: io::Error) -> Error {
        Error::Io { path: path.into(), cause }
    }

    /// The data do not determine a pose because of `why`.
    pub fn no_pose(why: impl Into<String>) -> Error {
        Error::NoPose { why: why.into() }
    }
}
