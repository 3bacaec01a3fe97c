//! Makes a pipeline folder: of files that are there, files in the cache of the hub, and downloads.
//!
//! The hub is asked which files a commit has and what they are (length and hash); what is in the cache of the hub is
//! linked, the rest is downloaded, continued where it broke off, compared with what was announced and only then given
//! its name. The record beside the files (`Lock`) is written after each of them, so that a run that was stopped goes on
//! with the same commit, and a folder that is complete needs no network at all.
//!
//! The requests are made here and not by the crate `hf-hub`. Its version 0.5 renames a download to its final name
//! without looking at length or hash, appends to a part even where the server starts anew, passes the token on to
//! whatever host the hub redirects to, makes paths of unchecked headers, panics on a redirect without an address, never
//! times out, and knows neither `HF_TOKEN` nor offline mode; its version 1 brings an asynchronous runtime and a TLS
//! library in C.

mod cache;
mod client;
mod content;
mod download;

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;
use std::thread;

use rare::{Error, Result};

use self::client::{Announced, Client, Failure, Listing, Remote};
use self::content::Expected;
use self::download::{Download, pause_before};
use super::check::check_file;
use super::digest::Fingerprint;
use super::hub::Hub;
use super::lock::{LOCK_FILE, Lock, LockedFile, place_in};
use super::sources::{Choice, Source, SourceFile};

/// The branch that is taken where no commit is known.
const BRANCH: &str = "main";
/// How often a question is asked that gets no answer.
const QUESTIONS: u32 = 3;

/// What happens while weights are fetched.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Event<'a> {
    /// The first download of this run is about to begin: these are the terms of what is downloaded.
    Licence {
        /// Their name.
        name: &'a str,
        /// Where they can be read.
        url: &'a str,
    },
    /// A file is being downloaded.
    Start {
        /// Its path in the folder.
        file: &'a str,
        /// Its length.
        bytes: u64,
        /// How much of it is there already.
        done: u64,
    },
    /// More of that file has arrived.
    Bytes {
        /// How much of it is there now.
        done: u64,
    },
    /// It broke off and is tried again.
    Retry {
        /// The path of the file in the folder.
        file: &'a str,
        /// What happened.
        why: &'a str,
    },
    /// A file is in its place, whole and verified.
    End {
        /// Its path in the folder.
        file: &'a str,
        /// Its length.
        bytes: u64,
        /// Where it was.
        origin: Origin,
    },
    /// The repository has no weights in half precision: those in single precision are taken.
    SinglePrecision {
        /// The path of the file in the folder.
        file: &'a str,
    },
}

/// Where a file was found.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Origin {
    /// In the folder itself.
    Folder,
    /// In the cache of the hub.
    Cache,
    /// On the server.
    Server,
}

/// Makes `folder` a pipeline folder of this choice, with a [`Lock`] beside the files; `tell` hears what happens.
///
/// A file that is there already must be what was published; nothing is overwritten.
///
/// # Errors
/// `InvalidInput` if the folder holds another choice or other content, if the server refuses, does not answer or sends
/// something else than it announced, or if something is missing in offline mode; `Io` if a file cannot be written.
/// What is complete and verified by then stays.
pub fn fetch(
    folder: &Path,
    choice: Choice,
    hub: &Hub,
    tell: &mut dyn FnMut(Event<'_>),
) -> Result<Lock> {
    fs::create_dir_all(folder).map_err(|error| Error::io(folder, error))?;
    let lock = Lock::read(folder)?.unwrap_or_else(|| Lock::new(choice));
    if lock.choice() != choice {
        let found = lock.choice().name();
        return Err(Error::in_file(
            folder.join(LOCK_FILE),
            format!("this folder is for {found}, not {}: name another folder", choice.name()),
        ));
    }
    let client = (!hub.offline).then(|| Client::new(hub));
    let mut work = Work { folder, hub, client, lock, told_licence: false, tell };
    choice.sources().try_for_each(|source| work.fetch_source(source, choice))?;
    Ok(work.lock)
}

/// A run of [`fetch`].
struct Work<'a> {
    folder: &'a Path,
    hub: &'a Hub,
    /// Absent in offline mode.
    client: Option<Client>,
    lock: Lock,
    told_licence: bool,
    tell: &'a mut dyn FnMut(Event<'_>),
}

impl Work<'_> {
    fn fetch_source(&mut self, source: &Source, choice: Choice) -> Result<()> {
        let mut wanted: Vec<&SourceFile> = source.files_in(choice.precision).collect();
        wanted.retain(|file| !self.keep_intact(source, file));
        if wanted.is_empty() {
            return Ok(());
        }
        let locked = self.lock.commit_of(source.repository).map(str::to_owned);
        let revision = locked.as_deref().or(source.revision).unwrap_or(BRANCH);
        let listing = self.list(source.repository, revision, &wanted)?;
        for file in wanted {
            self.fetch_file(source, file, &listing)?;
        }
        Ok(())
    }

    /// Whether a file is recorded and still what the record says.
    fn keep_intact(&mut self, source: &Source, file: &SourceFile) -> bool {
        let places = file.candidates().into_iter().map(|path| source.place(&path));
        let locked = places.filter_map(|place| self.lock.find(&place)).next();
        let intact = locked.filter(|locked| check_file(self.folder, locked).is_ok());
        if let Some(LockedFile { file, bytes, .. }) = intact {
            (self.tell)(Event::End { file, bytes: *bytes, origin: Origin::Folder });
        }
        intact.is_some()
    }

    fn list(&self, repository: &str, revision: &str, wanted: &[&SourceFile]) -> Result<Listing> {
        match &self.client {
            Some(client) => self.ask(|| client.list(repository, revision)),
            None => {
                let paths: BTreeSet<String> =
                    wanted.iter().flat_map(|file| file.candidates()).collect();
                cache::list(self.hub, repository, revision, paths)
            }
        }
    }

    fn describe(&self, remote: Remote<'_>) -> Result<Announced> {
        match &self.client {
            Some(client) => self.ask(|| client.describe(remote)),
            None => cache::describe(self.hub, remote),
        }
    }

    fn ask<T>(&self, question: impl Fn() -> std::result::Result<T, Failure>) -> Result<T> {
        let mut attempt = 1;
        loop {
            match question() {
                Ok(answer) => return Ok(answer),
                Err(Failure::Final(error)) => return Err(error),
                Err(Failure::Passing(why)) if attempt >= QUESTIONS => {
                    return Err(Error::invalid(format!(
                        "{why}: check the network, or ask another server with HF_ENDPOINT"
                    )));
                }
                Err(Failure::Passing(_)) => thread::sleep(pause_before(attempt, self.hub.pause)),
            }
            attempt += 1;
        }
    }

    fn fetch_file(&mut self, source: &Source, file: &SourceFile, listing: &Listing) -> Result<()> {
        let candidates = file.candidates();
        let Some(path) = candidates.iter().find(|path| listing.paths.contains(*path)) else {
            return Err(self.absent(source, file, &listing.commit));
        };
        let place = source.place(path);
        if path != file.path {
            (self.tell)(Event::SinglePrecision { file: &place });
        }
        let remote =
            Remote { repository: source.repository, commit: &listing.commit, path: path.as_str() };
        let announced = self.describe(remote)?;
        // The table speaks of its own file, not of the one that is taken in its place.
        let verified = (path == file.path).then_some(file.sha256).flatten();
        let Announced { bytes, hash } = announced;
        let expected = Expected { bytes, hash, verified };
        let (fingerprint, origin) = self.obtain(source, &place, remote, &expected)?;
        let Fingerprint { bytes, sha256 } = fingerprint;
        (self.tell)(Event::End { file: &place, bytes, origin });
        self.lock.put(LockedFile {
            file: place,
            bytes,
            sha256,
            repository: source.repository.to_owned(),
            commit: listing.commit.clone(),
            url: remote.url(&self.hub.endpoint),
            licence: source.licence.to_owned(),
        });
        self.lock.write(self.folder)
    }

    /// Brings a file to its place: from where it is nearest.
    fn obtain(
        &mut self,
        source: &Source,
        place: &str,
        remote: Remote<'_>,
        expected: &Expected,
    ) -> Result<(Fingerprint, Origin)> {
        let target = place_in(self.folder, place);
        if target.exists() {
            return match expected.compare(&target)? {
                Ok(fingerprint) => Ok((fingerprint, Origin::Folder)),
                Err(why) => Err(Error::in_file(
                    &target,
                    format!(
                        "this file is not the published one ({why}): move it away, or name another folder"
                    ),
                )),
            };
        }
        if let Some(parent) = target.parent() {
            fs::create_dir_all(parent).map_err(|error| Error::io(parent, error))?;
        }
        if let Some(fingerprint) = cache::take(self.hub, remote, expected, &target)? {
            return Ok((fingerprint, Origin::Cache));
        }
        let Some(client) = &self.client else {
            return Err(self.damaged(remote));
        };
        if !self.told_licence {
            (self.tell)(Event::Licence { name: source.licence, url: source.licence_url });
            self.told_licence = true;
        }
        let pause = self.hub.pause;
        let download = Download { client, remote, expected, target: &target, name: place, pause };
        Ok((download.run(self.tell)?, Origin::Server))
    }

    fn absent(&self, source: &Source, file: &SourceFile, commit: &str) -> Error {
        let (path, repository) = (file.path, source.repository);
        Error::invalid(match self.client {
            Some(_) => format!(
                "{path}: {repository} has no such file at {commit}: ask another server with HF_ENDPOINT, or name a folder of your own"
            ),
            None => format!(
                "{path}: not in the cache of the hub ({repository} at {commit}), and there is to be no network: unset HF_HUB_OFFLINE"
            ),
        })
    }

    fn damaged(&self, remote: Remote<'_>) -> Error {
        let Remote { repository, path, .. } = remote;
        Error::in_file(
            cache::repository_folder(self.hub, repository),
            format!(
                "{path} in the cache is damaged, and there is to be no network: unset HF_HUB_OFFLINE"
            ),
        )
    }
}
