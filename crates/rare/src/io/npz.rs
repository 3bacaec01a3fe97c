//! NPZ: several NPY arrays in a ZIP archive, stored or deflated.

use std::io::{self, Cursor, Read, Write};
use std::path::{Path, PathBuf};

use nalgebra::Point3;
use zip::ZipArchive;

use super::contain_panics::contain_panics;
use super::npy::{Array, Header};
use super::{name_file, whole_file};
use crate::error::{Error, Result};

/// What every ZIP archive with content begins with.
pub(super) const MAGIC: &[u8] = b"PK\x03\x04";

/// Deflate never packs tighter than this, so an entry that claims more is a lie.
const LARGEST_RATIO: u64 = 1032;

/// An `.npz` archive of named arrays, read into memory.
pub struct NpzFile {
    path: PathBuf,
    archive: ZipArchive<Cursor<Vec<u8>>>,
    /// Length of the file, bytes.
    length: u64,
}

impl std::fmt::Debug for NpzFile {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter
            .debug_struct("NpzFile")
            .field("path", &self.path)
            .field("names", &self.names())
            .finish()
    }
}

impl NpzFile {
    /// Reads the archive and its directory, not yet the arrays.
    ///
    /// # Errors
    /// `Io` if the file cannot be read, `InvalidInput` if it is not an archive of arrays.
    pub fn open(path: impl AsRef<Path>) -> Result<NpzFile> {
        let path = path.as_ref();
        NpzFile::from_bytes(path, whole_file::read_whole(path)?)
            .map_err(|error| name_file(path, error))
    }

    pub(super) fn from_bytes(path: &Path, bytes: Vec<u8>) -> Result<NpzFile> {
        let length = bytes.len() as u64;
        check_directory(&bytes)?;
        let archive = contain_panics(|| {
            ZipArchive::new(Cursor::new(bytes)).map_err(|error| {
                Error::invalid(format!("the archive is damaged ({error}): save it again"))
            })
        })?;
        Ok(NpzFile { path: path.to_path_buf(), archive, length })
    }

    /// The names of the arrays, sorted.
    #[must_use]
    pub fn names(&self) -> Vec<String> {
        let entries = self.archive.file_names().flatten();
        let array = |name: std::borrow::Cow<'_, str>| Some(name.strip_suffix(".npy")?.to_owned());
        let mut names: Vec<String> = entries.filter_map(array).collect();
        names.sort();
        names
    }

    /// The array `name` as 32-bit floats, whatever its number type.
    ///
    /// # Errors
    /// `InvalidInput` if there is no such array or it is damaged, `Unsupported` if it does not hold plain numbers.
    pub fn array_f32(&mut self, name: &str) -> Result<Array<f32>> {
        self.with_array(name, |header, data| header.array(data, |value| value as f32))
    }

    /// The array `name` as 64-bit floats, whatever its number type.
    ///
    /// # Errors
    /// `InvalidInput` if there is no such array or it is damaged, `Unsupported` if it does not hold plain numbers.
    pub fn array_f64(&mut self, name: &str) -> Result<Array<f64>> {
        self.with_array(name, |header, data| header.array(data, |value| value))
    }

    /// The first three columns of the array `name` as points.
    pub(super) fn points(&mut self, name: &str) -> Result<Vec<Point3<f64>>> {
        self.with_array(name, |header, data| header.points(data))
    }

    fn with_array<T>(
        &mut self,
        name: &str,
        read: impl FnOnce(&Header, &[u8]) -> Result<T>,
    ) -> Result<T> {
        let result = self.entry(name, true).and_then(|(header, data)| read(&header, &data));
        result.map_err(|error| name_file(&self.path, name_file(Path::new(name), error)))
    }

    /// The header of an entry and, if asked for, its data. Nothing is unpacked before the header's shape, the entry's
    /// size and the file's length agree.
    fn entry(&mut self, name: &str, with_data: bool) -> Result<(Header, Vec<u8>)> {
        let names = self.names();
        if !names.iter().any(|known| known == name) {
            return Err(Error::invalid(format!(
                "there is no such array, the file has [{}]",
                names.join(", ")
            )));
        }
        let (archive, length) = (&mut self.archive, self.length);
        contain_panics(|| {
            let mut entry =
                archive.by_name(&format!("{name}.npy")).map_err(|error| damaged(&error))?;
            check_packing(&entry.compression().to_string())?;
            let size = entry.size();
            check_size(size, entry.compressed_size(), length)?;
            let header = Header::read(&mut entry)?;
            let expected = header.data_length()?;
            if header.length.checked_add(expected).is_none_or(|total| total as u64 != size) {
                return Err(damaged(&format!(
                    "the shape {:?} does not fit {size} bytes",
                    header.shape
                )));
            }
            let data = if with_data { unpack(&mut entry, expected)? } else { Vec::new() };
            Ok((header, data))
        })
    }

    /// The array that holds the cloud: `points`, otherwise the only `N x 3` array of floats, otherwise the only wider
    /// one.
    pub(super) fn cloud_name(&mut self) -> Result<String> {
        let names = self.names();
        if names.iter().any(|name| name == "points") {
            return Ok("points".to_owned());
        }
        // An array that cannot be read is no candidate, but it is listed.
        let mut headers = Vec::new();
        for name in names {
            let header = self.entry(&name, false).ok().map(|(header, _)| header);
            headers.push((name, header));
        }
        let exact = float_arrays(&headers, |columns| columns == 3);
        let candidates =
            if exact.is_empty() { float_arrays(&headers, |columns| columns > 3) } else { exact };
        match candidates.as_slice() {
            [only] => Ok((*only).to_owned()),
            [] => Err(Error::invalid(format!(
                "no array is a cloud (N x 3 floats), the file has {}: save the points as `points`",
                listed(&headers)
            ))),
            [first, ..] => Err(Error::invalid(format!(
                "the arrays {} could all be the cloud: name one, for example {}:{first}",
                candidates.join(", "),
                self.path.display()
            ))),
        }
    }
}

fn damaged(error: &dyn std::fmt::Display) -> Error {
    Error::invalid(format!("the entry is damaged ({error}): save it again"))
}

fn check_packing(method: &str) -> Result<()> {
    if matches!(method, "Stored" | "Deflated") {
        return Ok(());
    }
    Err(Error::Unsupported(format!(
        "it is packed with {method}: save it with numpy.savez or numpy.savez_compressed"
    )))
}

fn check_size(size: u64, packed: u64, file_length: u64) -> Result<()> {
    if packed > file_length || size > packed.saturating_mul(LARGEST_RATIO) {
        return Err(damaged(&format!("{packed} packed bytes cannot hold {size}")));
    }
    Ok(())
}

fn unpack(entry: &mut dyn Read, length: usize) -> Result<Vec<u8>> {
    let mut data = Vec::new();
    data.try_reserve_exact(length).map_err(|error| damaged(&error))?;
    entry.take(length as u64).read_to_end(&mut data).map_err(|error| damaged(&error))?;
    Ok(data)
}

/// The names of the two-dimensional arrays of floats with a `wanted` number of columns.
fn float_arrays(headers: &[(String, Option<Header>)], wanted: fn(usize) -> bool) -> Vec<&str> {
    let fits = |header: &Header| {
        header.scalar.is_float()
            && matches!(*header.shape.as_slice(), [_, columns] if wanted(columns))
    };
    headers
        .iter()
        .filter(|(_, header)| header.as_ref().is_some_and(fits))
        .map(|(name, _)| name.as_str())
        .collect()
}

fn listed(headers: &[(String, Option<Header>)]) -> String {
    if headers.is_empty() {
        return "no arrays at all".to_owned();
    }
    let shown = headers.iter().map(|(name, header)| match header {
        Some(header) => format!("{name} {:?}", header.shape),
        None => format!("{name} (unreadable)"),
    });
    shown.collect::<Vec<_>>().join(", ")
}

/// Compares the number of entries that the end of the archive claims with the file's length: room for that many
/// would be allocated at once.
fn check_directory(bytes: &[u8]) -> Result<()> {
    const SMALLEST_ENTRY: u64 = 46;
    const END_OF_DIRECTORY_64: &[u8] = b"PK\x06\x06";
    let length = bytes.len() as u64;
    // Records of the 64-bit kind stand behind the directory, so search the last part only: its end records and a
    // comment of at most 64 KiB.
    let tail = &bytes[bytes.len().saturating_sub(1 << 17)..];
    let claims = tail.windows(40).filter(|window| window.starts_with(END_OF_DIRECTORY_64));
    for claim in claims {
        let entries = claim[32..].first_chunk().map_or(0, |count| u64::from_le_bytes(*count));
        if entries.saturating_mul(SMALLEST_ENTRY) > length {
            return Err(Error::invalid(format!(
                "the archive claims {entries} entries: it is damaged, save it again"
            )));
        }
    }
    Ok(())
}

/// One array to be written: its name, `NumPy`'s type string without the byte order, its shape and its bytes.
pub(super) struct Entry {
    name: String,
    kind: &'static str,
    shape: Vec<usize>,
    data: Vec<u8>,
}

impl Entry {
    /// An array of 64-bit floats in C order.
    pub(super) fn f64<'a>(
        name: impl Into<String>,
        shape: &[usize],
        values: impl IntoIterator<Item = &'a f64>,
    ) -> Entry {
        let data = values.into_iter().flat_map(|value| value.to_le_bytes()).collect();
        Entry { name: name.into(), kind: "f8", shape: shape.to_vec(), data }
    }

    /// An array of 32-bit floats in C order.
    pub(super) fn f32(name: impl Into<String>, shape: &[usize], values: &[f32]) -> Entry {
        let data = values.iter().flat_map(|value| value.to_le_bytes()).collect();
        Entry { name: name.into(), kind: "f4", shape: shape.to_vec(), data }
    }

    /// Bytes one after the other.
    pub(super) fn bytes(name: &str, bytes: &[u8]) -> Entry {
        Entry { name: name.to_owned(), kind: "u1", shape: vec![bytes.len()], data: bytes.to_vec() }
    }
}

/// Writes an archive of stored arrays. The same arrays give the same bytes: no time of writing is in them, and floats
/// hardly compress.
pub(super) fn write(writer: &mut dyn Write, entries: &[Entry]) -> io::Result<()> {
    let mut directory = Vec::new();
    let mut at = 0;
    for entry in entries {
        let mut content = Vec::with_capacity(entry.data.len() + 128);
        super::npy::write_header(&mut content, entry.kind, &entry.shape)?;
        content.extend_from_slice(&entry.data);
        let name = format!("{}.npy", entry.name);
        let described = describe(&name, &content)?;
        writer.write_all(b"PK\x03\x04")?;
        writer.write_all(&described)?;
        writer.write_all(name.as_bytes())?;
        writer.write_all(&content)?;
        // Version made by, the same description, then comment length, disk, attributes and offset.
        directory.extend_from_slice(b"PK\x01\x02\x14\0");
        directory.extend_from_slice(&described);
        directory.extend_from_slice(&[0; 10]);
        directory.extend_from_slice(&small(at)?.to_le_bytes());
        directory.extend_from_slice(name.as_bytes());
        at += 4 + described.len() + name.len() + content.len();
    }
    let count = u16::try_from(entries.len()).map_err(io::Error::other)?;
    writer.write_all(&directory)?;
    writer.write_all(b"PK\x05\x06\0\0\0\0")?;
    writer.write_all(&[count.to_le_bytes(), count.to_le_bytes()].concat())?;
    writer.write_all(&small(directory.len())?.to_le_bytes())?;
    writer.write_all(&small(at)?.to_le_bytes())?;
    writer.write_all(&[0; 2])
}

/// What the local header and the directory say alike about a stored entry: version 2.0, no flags, no compression,
/// midnight of 1 January 1980, checksum, sizes, length of the name, no extra field.
fn describe(name: &str, content: &[u8]) -> io::Result<Vec<u8>> {
    let mut described = vec![20, 0, 0, 0, 0, 0, 0, 0, 0x21, 0];
    described.extend_from_slice(&checksum(content).to_le_bytes());
    let size = small(content.len())?.to_le_bytes();
    described.extend_from_slice(&size);
    described.extend_from_slice(&size);
    described
        .extend_from_slice(&u16::try_from(name.len()).map_err(io::Error::other)?.to_le_bytes());
    described.extend_from_slice(&[0, 0]);
    Ok(described)
}

fn small(size: usize) -> io::Result<u32> {
    u32::try_from(size).map_err(|_| io::Error::other("an archive of 4 GiB or more is not written"))
}

/// CRC-32 (ISO 3309), the checksum of ZIP.
fn checksum(content: &[u8]) -> u32 {
    const TABLE: [u32; 256] = {
        let mut table = [0; 256];
        let mut index = 0;
        while index < 256 {
            let mut value = index as u32;
            let mut bit = 0;
            while bit < 8 {
                value = (value >> 1) ^ (0xedb8_8320 * (value & 1));
                bit += 1;
            }
            table[index] = value;
            index += 1;
        }
        table
    };
    !content.iter().fold(!0, |sum, &byte| (sum >> 8) ^ TABLE[usize::from(sum as u8 ^ byte)])
}
