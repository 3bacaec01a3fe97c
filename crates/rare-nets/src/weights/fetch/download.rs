//! One file, from the hub or its cache to its place: in parts, if need be, and under its name only when it is whole and
//! verified. A program that is stopped in between leaves `NAME.HASH.part`, which the next run continues.

use std::fs::{self, File, TryLockError};
use std::io::{self, ErrorKind, Read, Write};
use std::path::{Path, PathBuf};
use std::thread;
use std::time::Duration;

use rare::{Error, Result};

use super::super::digest::Fingerprint;
use super::Event;
use super::client::{Client, Failure, Remote, broken};
use super::content::Expected;

/// How much is read at once.
const CHUNK: usize = 1 << 17;
/// After so many attempts in a row without a byte, it is given up.
const ATTEMPTS: u32 = 6;
/// So many digits of the hash tell one version of a file from another.
const DIGITS: usize = 16;

/// A file that is on its way.
pub(super) struct Download<'a> {
    pub(super) client: &'a Client,
    pub(super) remote: Remote<'a>,
    pub(super) expected: &'a Expected,
    /// Where it is going.
    pub(super) target: &'a Path,
    /// Its name in what is told.
    pub(super) name: &'a str,
    pub(super) pause: Duration,
}

impl Download<'_> {
    /// Fetches the file.
    ///
    /// # Errors
    /// `InvalidInput` if the server does not have it, sends something else or breaks off for good, `Io` if it cannot be
    /// written. No file has taken the name of the target then.
    pub(super) fn run(&self, tell: &mut dyn FnMut(Event<'_>)) -> Result<Fingerprint> {
        let partial = partial_path(self.target, self.expected);
        let mut file = open_partial(&partial)?;
        let received = self.receive(&partial, &mut file, tell);
        if received.is_err() && file.metadata().is_ok_and(|metadata| metadata.len() == 0) {
            // Nothing to continue. If it stays, it is in nobody's way.
            let _ = fs::remove_file(&partial);
        }
        received?;
        file.sync_all().map_err(|error| self.disk_failure(&partial, error))?;
        publish(&partial, self.target, self.expected).map_err(|why| match why {
            Unfit::Failed(error) => error,
            Unfit::Other(why) => Error::invalid(format!(
                "{}: what arrived has {why}: it was removed; fetch again, or ask another server with HF_ENDPOINT",
                self.client.url(self.remote)
            )),
        })
    }

    /// Appends until the file is long enough, with a new attempt after every break.
    fn receive(
        &self,
        partial: &Path,
        file: &mut File,
        tell: &mut dyn FnMut(Event<'_>),
    ) -> Result<()> {
        let mut attempts = 0;
        loop {
            let before = length(partial, file)?;
            if before > self.expected.bytes {
                file.set_len(0).map_err(|error| Error::io(partial, error))?;
                continue;
            }
            tell(Event::Start { file: self.name, bytes: self.expected.bytes, done: before });
            let why = match self.attempt(partial, file, before, tell) {
                Ok(()) => return Ok(()),
                Err(Failure::Final(error)) => return Err(error),
                Err(Failure::Passing(why)) => why,
            };
            let after = length(partial, file)?;
            attempts = if after > before { 1 } else { attempts + 1 };
            if attempts >= ATTEMPTS {
                return Err(given_up(&why, after, self.expected.bytes));
            }
            tell(Event::Retry { file: self.name, why: &why });
            thread::sleep(pause_before(attempts, self.pause));
        }
    }

    fn attempt(
        &self,
        partial: &Path,
        file: &mut File,
        done: u64,
        tell: &mut dyn FnMut(Event<'_>),
    ) -> std::result::Result<(), Failure> {
        if done == self.expected.bytes {
            return Ok(());
        }
        let opened = self.client.open(self.remote, done, self.expected.bytes)?;
        if opened.start != done {
            // The server sends the whole file.
            file.set_len(opened.start).map_err(|error| self.disk_failure(partial, error))?;
        }
        self.append(partial, file, opened.start, opened.reader, tell)
    }

    fn append(
        &self,
        partial: &Path,
        file: &mut File,
        mut done: u64,
        mut reader: impl Read,
        tell: &mut dyn FnMut(Event<'_>),
    ) -> std::result::Result<(), Failure> {
        let url = self.client.url(self.remote);
        let mut chunk = vec![0; CHUNK];
        loop {
            let count = reader.read(&mut chunk).map_err(|error| broken(&url, &error))?;
            let Some(read) = chunk.get(..count).filter(|read| !read.is_empty()) else { break };
            file.write_all(read).map_err(|error| self.disk_failure(partial, error))?;
            done += count as u64;
            tell(Event::Bytes { done });
        }
        if done < self.expected.bytes {
            return Err(broken(&url, &io::Error::from(ErrorKind::UnexpectedEof)));
        }
        // A file that is too long is found out by its length when it is published.
        Ok(())
    }

    fn disk_failure(&self, partial: &Path, error: io::Error) -> Error {
        let full = [ErrorKind::StorageFull, ErrorKind::QuotaExceeded, ErrorKind::FileTooLarge];
        if !full.contains(&error.kind()) {
            return Error::io(partial, error);
        }
        let bytes = self.expected.bytes;
        let message = format!(
            "{error}: the file takes {bytes} bytes: make room, or name a folder on another disk, and fetch again (what has arrived is kept)"
        );
        Error::io(partial, io::Error::new(error.kind(), message))
    }
}

/// Why a file does not take its name.
pub(super) enum Unfit {
    /// It is something else; it was removed.
    Other(String),
    /// It cannot be read or renamed.
    Failed(Error),
}

/// Gives a verified file its name; removes one that is not what is expected.
pub(super) fn publish(
    partial: &Path,
    target: &Path,
    expected: &Expected,
) -> std::result::Result<Fingerprint, Unfit> {
    match expected.compare(partial).map_err(Unfit::Failed)? {
        Ok(fingerprint) => {
            let renamed = fs::rename(partial, target);
            renamed.map_err(|error| Unfit::Failed(Error::io(target, error)))?;
            Ok(fingerprint)
        }
        Err(why) => {
            let removed = fs::remove_file(partial);
            removed.map_err(|error| Unfit::Failed(Error::io(partial, error)))?;
            Err(Unfit::Other(why))
        }
    }
}

/// Where a file grows: named after its content, so that a newer version does not continue an older one.
pub(super) fn partial_path(target: &Path, expected: &Expected) -> PathBuf {
    let digits: String = expected.hash.digits().chars().take(DIGITS).collect();
    let mut name = target.file_name().unwrap_or_default().to_owned();
    name.push(format!(".{digits}.part"));
    target.with_file_name(name)
}

/// Waits twice as long before each further attempt.
pub(super) fn pause_before(attempt: u32, pause: Duration) -> Duration {
    pause.saturating_mul(1 << attempt.saturating_sub(1).min(10))
}

/// Opens the file for appending, for this program alone.
fn open_partial(partial: &Path) -> Result<File> {
    let file = File::options().create(true).append(true).open(partial);
    let file = file.map_err(|error| Error::io(partial, error))?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => Err(Error::in_file(
            partial,
            "another program is fetching this file: wait until it has finished",
        )),
        // Some network file systems have no locks: then there is no more than the hash to find out about others.
        Err(TryLockError::Error(error)) if error.kind() == ErrorKind::Unsupported => Ok(file),
        Err(TryLockError::Error(error)) => Err(Error::io(partial, error)),
    }
}

fn length(partial: &Path, file: &File) -> Result<u64> {
    Ok(file.metadata().map_err(|error| Error::io(partial, error))?.len())
}

fn given_up(why: &str, done: u64, bytes: u64) -> Error {
    Error::invalid(format!(
        "{why}: {done} of {bytes} bytes have arrived and are kept: check the network and fetch again"
    ))
}
