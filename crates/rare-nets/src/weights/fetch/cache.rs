//! The files of the hub that other programs have downloaded on this machine.
//!
//! The hub's programs keep every repository in a folder of its own: contents in `blobs`, named by their hash, a folder
//! of links to them for each commit in `snapshots`, and the commit of each branch in `refs`. Where links are not to be
//! had, the contents stand in `snapshots` themselves.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use rare::{Error, Result};

use super::super::digest::{Fingerprint, is_hexadecimal};
use super::super::hub::Hub;
use super::super::lock::place_in;
use super::client::{Announced, Listing, Remote};
use super::content::{ContentHash, Expected};
use super::download::{Unfit, partial_path, publish};

/// The longest commit that is read from a file, bytes.
const LONGEST_REFERENCE: u64 = 1 << 10;

/// Those of `paths` that are there, at a branch or commit.
///
/// # Errors
/// `InvalidInput` if nothing of the repository is there.
pub(super) fn list(
    hub: &Hub,
    repository: &str,
    revision: &str,
    paths: BTreeSet<String>,
) -> Result<Listing> {
    let folder = repository_folder(hub, repository);
    let commit = if is_hexadecimal(revision, 40) {
        revision.to_owned()
    } else {
        read_commit(&folder.join("refs").join(revision)).ok_or_else(|| {
            Error::in_file(
                &folder,
                format!("{repository} is not in the cache, and there is to be no network: unset HF_HUB_OFFLINE"),
            )
        })?
    };
    let snapshot = folder.join("snapshots").join(&commit);
    let paths = paths.into_iter().filter(|path| place_in(&snapshot, path).is_file()).collect();
    Ok(Listing { commit, paths })
}

/// What a file in the cache is: its content has the name of its hash.
///
/// # Errors
/// `InvalidInput` if it has another name, `Io` if it is not there.
pub(super) fn describe(hub: &Hub, remote: Remote<'_>) -> Result<Announced> {
    let path = snapshot_path(hub, remote);
    let failed = |error| Error::io(&path, error);
    let content = fs::canonicalize(&path).map_err(failed)?;
    let bytes = content.metadata().map_err(failed)?.len();
    let hash = content.file_name().and_then(|name| ContentHash::parse(name.to_str()?));
    let unknown = "the cache does not tell its hash: unset HF_HUB_OFFLINE, so that the server can";
    Ok(Announced { bytes, hash: hash.ok_or_else(|| Error::in_file(&path, unknown))? })
}

/// Takes a file from the cache: as a second name for the same content where the disk allows it, else as a copy.
/// `None` if it is not there or is something else.
///
/// # Errors
/// `Io` if it can be neither linked nor copied.
pub(super) fn take(
    hub: &Hub,
    remote: Remote<'_>,
    expected: &Expected,
    target: &Path,
) -> Result<Option<Fingerprint>> {
    let blobs = repository_folder(hub, remote.repository).join("blobs");
    let places = [blobs.join(expected.hash.digits()), snapshot_path(hub, remote)];
    for place in places {
        let Ok(content) = fs::canonicalize(place) else { continue };
        if !content.is_file() {
            continue;
        }
        if let Some(fingerprint) = take_content(&content, expected, target)? {
            return Ok(Some(fingerprint));
        }
    }
    Ok(None)
}

fn take_content(content: &Path, expected: &Expected, target: &Path) -> Result<Option<Fingerprint>> {
    let Ok(fingerprint) = expected.compare(content)? else { return Ok(None) };
    if fs::hard_link(content, target).is_ok() {
        return Ok(Some(fingerprint));
    }
    let partial = partial_path(target, expected);
    if let Err(error) = fs::copy(content, &partial) {
        // What is half copied could not be continued as a download that broke off.
        let _ = fs::remove_file(&partial);
        return Err(Error::io(&partial, error));
    }
    match publish(&partial, target, expected) {
        Ok(fingerprint) => Ok(Some(fingerprint)),
        Err(Unfit::Other(_)) => Ok(None),
        Err(Unfit::Failed(error)) => Err(error),
    }
}

/// The folder of a repository.
pub(super) fn repository_folder(hub: &Hub, repository: &str) -> PathBuf {
    hub.cache.join(format!("models--{}", repository.replace('/', "--")))
}

fn snapshot_path(hub: &Hub, remote: Remote<'_>) -> PathBuf {
    let snapshots = repository_folder(hub, remote.repository).join("snapshots");
    place_in(&snapshots.join(remote.commit), remote.path)
}

fn read_commit(path: &Path) -> Option<String> {
    let short = fs::metadata(path).is_ok_and(|metadata| metadata.len() <= LONGEST_REFERENCE);
    let text = short.then(|| fs::read_to_string(path).ok())??;
    let commit = text.trim();
    is_hexadecimal(commit, 40).then(|| commit.to_owned())
}
