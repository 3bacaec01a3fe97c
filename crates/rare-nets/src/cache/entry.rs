//! One entry of the cache as a file: what it is, its key, its layers, and a digest of all that.

use std::fs;
use std::io::ErrorKind;
use std::path::Path;

use rare::data::LayeredFeatures;
use rare::{Error, FeatureMap, Result};
use sha2::{Digest as _, Sha256};

use super::Digest;

/// What every entry begins with. It is part of the key as well, so that another version does not even look.
pub(super) const FORMAT: &[u8; 16] = b"rare features 1\n";

/// Writes an entry whole.
pub(super) fn write(path: &Path, key: &Digest, features: &LayeredFeatures) -> Result<()> {
    let mut content = [FORMAT, key.as_slice()].concat();
    content.extend((features.len() as u64).to_le_bytes());
    for layer in features {
        for size in [layer.channels(), layer.height(), layer.width()] {
            content.extend((size as u64).to_le_bytes());
        }
        content.extend(layer.values().iter().flat_map(|value| value.to_le_bytes()));
    }
    let digest = Sha256::digest(&content);
    rare::io::write_whole(path, |writer| {
        writer.write_all(&content)?;
        writer.write_all(&digest)
    })
}

/// Reads the entry of a key; none if there is no file.
///
/// # Errors
/// `Io` if the file cannot be read, `InvalidInput` if it is damaged or another one.
pub(super) fn read(path: &Path, key: &Digest) -> Result<Option<LayeredFeatures>> {
    match fs::read(path) {
        Ok(bytes) => parse(&bytes, key).map(Some).ok_or_else(|| {
            Error::in_file(path, "the cached features are damaged and were computed anew")
        }),
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
        Err(error) => Err(Error::io(path, error)),
    }
}

fn parse(bytes: &[u8], key: &Digest) -> Option<LayeredFeatures> {
    let (content, digest) = bytes.split_last_chunk::<32>()?;
    if Digest::from(Sha256::digest(content)) != *digest {
        return None;
    }
    let mut rest = content.strip_prefix(FORMAT)?.strip_prefix(key.as_slice())?;
    let count = take_size(&mut rest)?;
    // No room is made for the number that is claimed: the layers have to be there.
    let mut layers = LayeredFeatures::new();
    for _ in 0..count {
        layers.push(take_layer(&mut rest)?);
    }
    rest.is_empty().then_some(layers)
}

fn take_layer(rest: &mut &[u8]) -> Option<FeatureMap> {
    let [channels, height, width] = [take_size(rest)?, take_size(rest)?, take_size(rest)?];
    let count = channels.checked_mul(height)?.checked_mul(width)?;
    let (values, after) = rest.split_at_checked(count.checked_mul(4)?)?;
    *rest = after;
    let values = values.as_chunks().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect();
    FeatureMap::new(channels, height, width, values).ok()
}

fn take_size(rest: &mut &[u8]) -> Option<usize> {
    let (size, after) = rest.split_first_chunk()?;
    *rest = after;
    usize::try_from(u64::from_le_bytes(*size)).ok()
}
