//! The safetensors format: a header of JSON that says where each tensor lies, then the bytes.
//!
//! `u64` length of the header; the header, a map from names to `dtype`, `shape` and `data_offsets` (and
//! `__metadata__`, a map of texts); then the values, row-major, little-endian, without a gap. Everything that the
//! header claims is checked against the length of the file before anything is allocated for it.

use std::collections::BTreeMap;
use std::fmt;
use std::path::Path;
use std::sync::Arc;

use rare::{Error, Result};
use serde::Deserialize;
use serde::de::{self, MapAccess, Visitor};

use super::weight_file::WeightFile;
use super::{ElementType, Tensor};

/// The longest header that is read, the limit of the format's own library; those of real files have under 1 MB.
const LONGEST_HEADER: u64 = 100_000_000;

/// What a safetensors file holds.
#[derive(Debug)]
pub(super) struct Safetensors {
    /// Names and tensors, by name.
    pub(super) tensors: BTreeMap<String, Tensor>,
    /// The texts of `__metadata__`.
    pub(super) metadata: BTreeMap<String, String>,
}

/// Opens a file and checks its header.
pub(super) fn open(path: &Path) -> Result<Safetensors> {
    let file = Arc::new(WeightFile::open(path)?);
    let (header, data_start) = read_header(&file)?;
    let data_length = file.length() - data_start;
    check_layout(&header.entries, data_length).map_err(|what| Error::in_file(path, what))?;
    let tensors = header
        .entries
        .into_iter()
        .map(|entry| {
            let start = data_start + entry.begin;
            (entry.name, Tensor::in_file(Arc::clone(&file), start, entry.element, entry.shape))
        })
        .collect();
    Ok(Safetensors { tensors, metadata: header.metadata })
}

/// The header of a file, and where the values begin.
fn read_header(file: &WeightFile) -> Result<(Header, u64)> {
    let bad = |what: String| Error::in_file(file.path(), what);
    let mut length = [0; 8];
    if file.length() < 8 {
        return Err(bad(format!("has {} bytes: not a safetensors file", file.length())));
    }
    file.read_at(&mut length, 0)?;
    let length = u64::from_le_bytes(length);
    if length > LONGEST_HEADER {
        return Err(bad(format!("claims a header of {length} bytes: not a safetensors file")));
    }
    if length > file.length() - 8 {
        return Err(bad(format!(
            "claims a header of {length} bytes, but ends after {}: the file is truncated; fetch it again",
            file.length()
        )));
    }
    let mut bytes = vec![0; usize::try_from(length).unwrap_or(0)];
    file.read_at(&mut bytes, 8)?;
    let header = serde_json::from_slice(&bytes)
        .map_err(|cause| bad(format!("the safetensors header does not parse: {cause}")))?;
    Ok((header, 8 + length))
}

/// The tensors must fill the data without a gap, each as long as its shape says.
fn check_layout(entries: &[Entry], data_length: u64) -> std::result::Result<(), String> {
    let mut order: Vec<&Entry> = entries.iter().collect();
    order.sort_by_key(|entry| (entry.begin, entry.end));
    let mut position = 0;
    for entry in order {
        entry.check_length()?;
        if entry.begin != position {
            return Err(format!(
                "tensor {} begins at byte {} of the data, the one before it ends at {position}",
                entry.name, entry.begin
            ));
        }
        position = entry.end;
    }
    match position.cmp(&data_length) {
        std::cmp::Ordering::Equal => Ok(()),
        std::cmp::Ordering::Greater => Err(format!(
            "the tensors take {position} bytes, but {data_length} are there: the file is truncated; fetch it again"
        )),
        std::cmp::Ordering::Less => {
            Err(format!("the tensors take {position} bytes, but {data_length} are there"))
        }
    }
}

/// A tensor as the header describes it.
#[derive(Debug)]
struct Entry {
    name: String,
    element: ElementType,
    shape: Vec<usize>,
    begin: u64,
    end: u64,
}

impl Entry {
    fn check_length(&self) -> std::result::Result<(), String> {
        let length = self.shape.iter().try_fold(self.element.bytes() as u64, |product, &size| {
            product.checked_mul(size as u64)
        });
        if length.is_some() && length == self.end.checked_sub(self.begin) {
            return Ok(());
        }
        Err(format!(
            "tensor {} of type {} and shape {:?} lies from byte {} to {}, which does not fit",
            self.name, self.element, self.shape, self.begin, self.end
        ))
    }
}

/// The parsed header.
#[derive(Debug, Default)]
struct Header {
    entries: Vec<Entry>,
    metadata: BTreeMap<String, String>,
}

#[derive(Deserialize)]
struct Description {
    dtype: String,
    shape: Vec<usize>,
    data_offsets: (u64, u64),
}

impl<'de> Deserialize<'de> for Header {
    fn deserialize<D: de::Deserializer<'de>>(
        deserializer: D,
    ) -> std::result::Result<Self, D::Error> {
        deserializer.deserialize_map(HeaderVisitor)
    }
}

/// Reads the map entry by entry, because a ready-made map would keep one of two entries of the same name silently.
struct HeaderVisitor;

impl<'de> Visitor<'de> for HeaderVisitor {
    type Value = Header;

    fn expecting(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("a map from names to tensors")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> std::result::Result<Header, A::Error> {
        let mut header = Header::default();
        let mut seen = std::collections::BTreeSet::new();
        while let Some(name) = map.next_key::<String>()? {
            if !seen.insert(name.clone()) {
                return Err(de::Error::custom(format!("the name {name} occurs twice")));
            }
            if name == "__metadata__" {
                header.metadata = map.next_value()?;
                continue;
            }
            let Description { dtype, shape, data_offsets: (begin, end) } = map.next_value()?;
            let element = ElementType::from_safetensors(&dtype).ok_or_else(|| {
                de::Error::custom(format!("tensor {name} has the unknown type {dtype}"))
            })?;
            header.entries.push(Entry { name, element, shape, begin, end });
        }
        Ok(header)
    }
}
