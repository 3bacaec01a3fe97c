//! A part of a file, read from its beginning to its end.

use rare::{Error, Result};

use super::super::weight_file::WeightFile;

/// Bytes that are read ahead.
const BUFFER: usize = 1 << 16;

/// The bytes of a pickle.
pub(super) struct Input<'a> {
    file: &'a WeightFile,
    /// Place in the file of the first byte that is not in `buffer`.
    next: u64,
    end: u64,
    buffer: Vec<u8>,
    /// Bytes of `buffer` that are used up.
    used: usize,
}

impl<'a> Input<'a> {
    /// The bytes from `start` to `end`, which is inside the file.
    pub(super) fn new(file: &'a WeightFile, start: u64, end: u64) -> Input<'a> {
        Input { file, next: start, end, buffer: Vec::new(), used: 0 }
    }

    /// Where in the file the next byte is.
    pub(super) fn position(&self) -> u64 {
        self.next - (self.buffer.len() - self.used) as u64
    }

    /// Bytes that are left.
    pub(super) fn left(&self) -> u64 {
        self.end - self.position()
    }

    /// The file is malformed.
    pub(super) fn fault(&self, what: impl std::fmt::Display) -> Error {
        Error::in_file(self.file.path(), format!("{what} (before byte {})", self.position()))
    }

    /// The file has something that is not read.
    pub(super) fn unsupported(&self, what: impl std::fmt::Display) -> Error {
        Error::Unsupported(format!(
            "{}: {what} (before byte {})",
            self.file.path().display(),
            self.position()
        ))
    }

    /// The next byte.
    pub(super) fn byte(&mut self) -> Result<u8> {
        self.array().map(|[byte]| byte)
    }

    /// The next bytes.
    pub(super) fn array<const COUNT: usize>(&mut self) -> Result<[u8; COUNT]> {
        self.check(COUNT as u64)?;
        let mut bytes = [0; COUNT];
        self.copy(&mut bytes)?;
        Ok(bytes)
    }

    /// The next `count` bytes, which are allocated only if they are there.
    pub(super) fn take(&mut self, count: u64) -> Result<Vec<u8>> {
        self.check(count)?;
        let mut bytes = vec![0; usize::try_from(count).unwrap_or(0)];
        self.copy(&mut bytes)?;
        Ok(bytes)
    }

    /// Leaves out the next `count` bytes.
    pub(super) fn skip(&mut self, count: u64) -> Result<()> {
        self.check(count)?;
        self.next = self.position() + count;
        self.buffer.clear();
        self.used = 0;
        Ok(())
    }

    /// The text up to the end of the line, which is left out.
    pub(super) fn line(&mut self) -> Result<String> {
        const LONGEST: usize = 1000;
        let mut line = Vec::new();
        loop {
            match self.byte()? {
                b'\n' => break,
                _ if line.len() == LONGEST => return Err(self.fault("a name without an end")),
                byte => line.push(byte),
            }
        }
        String::from_utf8(line).map_err(|_| self.fault("a name that is not UTF-8"))
    }

    fn check(&self, count: u64) -> Result<()> {
        if count > self.left() {
            return Err(self.fault(format!(
                "the pickle needs {count} more bytes, {} are there: the file is truncated",
                self.left()
            )));
        }
        Ok(())
    }

    /// Fills `target`, which is known to be there.
    fn copy(&mut self, mut target: &mut [u8]) -> Result<()> {
        while !target.is_empty() {
            if self.used == self.buffer.len() {
                self.refill()?;
            }
            let ready = self.buffer.get(self.used..).unwrap_or_default();
            let count = ready.len().min(target.len());
            let (now, later) = target.split_at_mut(count);
            now.copy_from_slice(ready.split_at(count).0);
            self.used += count;
            target = later;
        }
        Ok(())
    }

    fn refill(&mut self) -> Result<()> {
        let left = usize::try_from(self.end - self.next).unwrap_or(usize::MAX);
        self.buffer.resize(left.min(BUFFER), 0);
        self.used = 0;
        if self.buffer.is_empty() {
            return Err(self.fault("the file is truncated"));
        }
        self.file.read_at(&mut self.buffer, self.next)?;
        self.next += self.buffer.len() as u64;
        Ok(())
    }
}
