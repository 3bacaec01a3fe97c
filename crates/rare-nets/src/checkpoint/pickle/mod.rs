//! Files that `torch.save` or Python's `pickle` wrote, read as data.
//!
//! A pickle is a program for a stack machine; Python runs it and calls whatever it names. Here nothing is ever
//! called: a name and its arguments become an [`Instance`], and the few callables that stand for plain data (tensors,
//! numpy arrays, ordered dictionaries) are replaced by that data. The machine ([`machine`]) builds a graph of nodes in
//! one pass; [`finish`] turns it into an [`Object`], whose tensors know their places in the file. The number of
//! operations, the nesting and every length are limited before anything is allocated for them.
//!
//! Containers: the zip archive of torch 1.6 and later ([`archive`]), the stream of older versions ([`stream`]), and
//! pickles alone. See <https://docs.python.org/3/library/pickletools.html> for the operations.

mod archive;
mod build;
mod finish;
mod harm;
mod input;
mod machine;
mod node;
mod object;
mod stream;

use std::path::Path;
use std::sync::Arc;

use rare::{Error, Result};

pub use object::{Instance, Object};

use super::weight_file::WeightFile;

/// Opens what `torch.save` or Python's `pickle` wrote: `.pth`, `.pt`, `.ckpt`, `.bin`, `.pkl`. The tensors of the object
/// are read later; arrays of numpy are in memory.
///
/// # Errors
/// `InvalidInput` if the file is malformed or truncated, `Unsupported` if it uses something that is not read (text
/// pickles of protocol 0, compressed archives, the tar files of torch before 0.2), `Io` if it cannot be read.
pub fn open_pickle(path: &Path) -> Result<Object> {
    let file = Arc::new(WeightFile::open(path)?);
    let mut start = [0; 265];
    let length = usize::try_from(file.length()).unwrap_or(usize::MAX).min(start.len());
    let (start, _) = start.split_at_mut(length);
    file.read_at(start, 0)?;
    if start.starts_with(b"PK\x03\x04") {
        return archive::open(&file);
    }
    if start.get(257..262) == Some(b"ustar") {
        return Err(Error::Unsupported(format!(
            "{}: a tar file of torch before 0.2: load it with torch and save it again",
            path.display()
        )));
    }
    if start.first() == Some(&machine::PROTOCOL) {
        return stream::open(&file);
    }
    Err(Error::in_file(path, "neither a file of torch.save nor a pickle of protocol 2 or later"))
}
