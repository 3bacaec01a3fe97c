//! What a file is to be, as the hub announces it, and whether it is that.

use std::path::Path;

use rare::{Error, Result};
use sha1::{Digest, Sha1};

use super::super::digest::{Fingerprint, feed, fingerprint, hexadecimal, is_hexadecimal};

/// The hash by which the hub names a content.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum ContentHash {
    /// Large files: SHA-256.
    Sha256(String),
    /// Small files: the SHA-1 that git gives them. It guards against accidents, not against forgery: for these files
    /// there is nothing better than the encrypted connection.
    GitBlob(String),
}

/// What a file is to be.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Expected {
    pub(super) bytes: u64,
    pub(super) hash: ContentHash,
    /// The SHA-256 of the table of sources, where it has one.
    pub(super) verified: Option<&'static str>,
}

impl ContentHash {
    /// The hash in an `ETag`, with its quotes; `None` if there is none that is known.
    pub(super) fn parse(tag: &str) -> Option<ContentHash> {
        let digits = tag.trim().trim_start_matches("W/").trim_matches('"');
        if is_hexadecimal(digits, 64) {
            Some(ContentHash::Sha256(digits.to_owned()))
        } else if is_hexadecimal(digits, 40) {
            Some(ContentHash::GitBlob(digits.to_owned()))
        } else {
            None
        }
    }

    pub(super) fn digits(&self) -> &str {
        match self {
            ContentHash::Sha256(digits) | ContentHash::GitBlob(digits) => digits,
        }
    }
}

impl Expected {
    /// What the file at `path` is, or in which way it is not what is expected.
    ///
    /// # Errors
    /// `Io` if it cannot be read.
    pub(super) fn compare(&self, path: &Path) -> Result<std::result::Result<Fingerprint, String>> {
        let failed = |error| Error::io(path, error);
        let bytes = path.metadata().map_err(failed)?.len();
        if bytes != self.bytes {
            return Ok(Err(format!("{bytes} bytes instead of {}", self.bytes)));
        }
        let found = fingerprint(path).map_err(failed)?;
        let (name, digits, own) = match &self.hash {
            ContentHash::Sha256(digits) => ("SHA-256", digits, found.sha256.clone()),
            ContentHash::GitBlob(digits) => ("git hash", digits, git_blob(path, bytes)?),
        };
        if own != *digits {
            return Ok(Err(format!("{name} {own} instead of {digits}")));
        }
        match self.verified.filter(|verified| *verified != found.sha256) {
            Some(verified) => Ok(Err(format!("SHA-256 {} instead of {verified}", found.sha256))),
            None => Ok(Ok(found)),
        }
    }
}

/// The name that git gives a content: the hash of `blob`, its length, a zero and itself.
fn git_blob(path: &Path, bytes: u64) -> Result<String> {
    let mut hasher = Sha1::new();
    hasher.update(format!("blob {bytes}\0"));
    feed(path, |chunk| hasher.update(chunk)).map_err(|error| Error::io(path, error))?;
    Ok(hexadecimal(&hasher.finalize()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tags_are_told_by_their_length() {
        let (long, short) = ("a".repeat(64), "b".repeat(40));
        for tag in [format!("\"{long}\""), long.clone(), format!("W/\"{long}\"")] {
            assert_eq!(ContentHash::parse(&tag), Some(ContentHash::Sha256(long.clone())));
        }
        assert_eq!(ContentHash::parse(&short), Some(ContentHash::GitBlob(short)));
        for tag in ["", "\"5f3-8\"", "../../../etc/passwd", &"A".repeat(64)] {
            assert_eq!(ContentHash::parse(tag), None, "{tag}");
        }
    }

    #[test]
    fn every_deviation_is_named() {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), "what is up, doc?").unwrap();
        // The example in the book "Pro Git", chapter "Git Objects".
        let hash = ContentHash::GitBlob("bd9dbf5aae1a3862dd1526723246b20206e5fc37".to_owned());
        let right = Expected { bytes: 16, hash, verified: None };
        let found = right.compare(file.path()).unwrap().unwrap();
        let as_large = ContentHash::Sha256(found.sha256.clone());
        let large = Expected { hash: as_large, ..right.clone() };
        assert_eq!(large.compare(file.path()).unwrap().unwrap(), found);
        let why = |expected: Expected| expected.compare(file.path()).unwrap().unwrap_err();
        assert!(why(Expected { bytes: 17, ..right.clone() }).contains("16 bytes instead of 17"));
        let other = ContentHash::GitBlob("0".repeat(40));
        assert!(why(Expected { hash: other, ..right.clone() }).contains("git hash bd9dbf"));
        let other = ContentHash::Sha256("0".repeat(64));
        assert!(why(Expected { hash: other, ..right.clone() }).contains(&found.sha256));
        assert!(why(Expected { verified: Some("0"), ..right }).contains("instead of 0"));
    }
}
