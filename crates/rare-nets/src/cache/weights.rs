//! Which weights these are, without reading gigabytes.

use std::fs::{self, File};
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::time::UNIX_EPOCH;

use rare::{Error, Result};
use sha2::{Digest as _, Sha256};

use super::hexadecimal;

/// Bytes at the beginning of a file that are looked at: the header of most.
const BEGINNING: u64 = 1 << 16;
/// Places in the rest of a file that are looked at, and bytes at each.
const SAMPLES: u64 = 64;
const SAMPLE: u64 = 1 << 12;

/// Tells weights from others, by samples of their files.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct WeightsIdentity {
    /// SHA-256 in hexadecimal of names, lengths and samples (the first 64 KiB and 64 places) of the files: the same for
    /// the same weights on any machine, and different for others unless they differ in few places.
    pub fingerprint: String,
    /// The same with the times of the last changes, which see any change on one machine.
    pub on_this_machine: String,
}

impl WeightsIdentity {
    /// Looks at the files of a network, in their order.
    ///
    /// # Errors
    /// `Io` if a file cannot be read.
    pub fn of(files: &[PathBuf]) -> Result<WeightsIdentity> {
        let (mut fingerprint, mut changes) = (Sha256::new(), Sha256::new());
        for path in files {
            let io = |error| Error::io(path, error);
            let metadata = fs::metadata(path).map_err(io)?;
            // A pipeline in the cache of a hub is a folder of links: the name counts, not what it links to.
            let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            fingerprint.update((name.len() as u64).to_le_bytes());
            fingerprint.update(name);
            fingerprint.update(metadata.len().to_le_bytes());
            sample(path, metadata.len(), &mut fingerprint).map_err(io)?;
            let changed =
                metadata.modified().ok().and_then(|at| at.duration_since(UNIX_EPOCH).ok());
            changes.update(changed.unwrap_or_default().as_nanos().to_le_bytes());
        }
        let fingerprint = fingerprint.finalize();
        changes.update(fingerprint);
        Ok(WeightsIdentity {
            fingerprint: hexadecimal(&fingerprint.into()),
            on_this_machine: hexadecimal(&changes.finalize().into()),
        })
    }
}

fn sample(path: &Path, length: u64, hash: &mut Sha256) -> std::io::Result<()> {
    let mut file = File::open(path)?;
    let mut bytes = Vec::new();
    let places = (1..=SAMPLES).map(|place| (length / SAMPLES * place).saturating_sub(SAMPLE));
    let rest = places.filter(|&start| start >= BEGINNING).map(|start| (start, SAMPLE));
    for (start, count) in std::iter::once((0, BEGINNING)).chain(rest) {
        bytes.clear();
        file.seek(SeekFrom::Start(start))?;
        (&mut file).take(count).read_to_end(&mut bytes)?;
        hash.update(&bytes);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn identity(path: &Path) -> WeightsIdentity {
        WeightsIdentity::of(&[path.to_path_buf()]).unwrap()
    }

    #[test]
    fn samples_names_and_times_tell_weights_apart() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.safetensors");
        let mut content = vec![7_u8; 1 << 20];
        fs::write(&path, &content).unwrap();
        let first = identity(&path);
        assert_eq!(first, identity(&path));
        assert_eq!(first.fingerprint.len(), 64);
        // The same bytes elsewhere, later.
        let copy = folder.path().join("copy");
        fs::create_dir(&copy).unwrap();
        let later = copy.join("a.safetensors");
        fs::copy(&path, &later).unwrap();
        let file = File::options().write(true).open(&later).unwrap();
        file.set_modified(UNIX_EPOCH).unwrap();
        assert_eq!(identity(&later).fingerprint, first.fingerprint);
        assert_ne!(identity(&later).on_this_machine, first.on_this_machine);
        let renamed = folder.path().join("b.safetensors");
        fs::copy(&path, &renamed).unwrap();
        assert_ne!(identity(&renamed).fingerprint, first.fingerprint);
        // The header, and the very end.
        for place in [100, content.len() - 1] {
            content[place] = 8;
            fs::write(&path, &content).unwrap();
            assert_ne!(identity(&path).fingerprint, first.fingerprint, "{place}");
            content[place] = 7;
        }
        let error = WeightsIdentity::of(&[folder.path().join("none")]).unwrap_err();
        assert!(error.to_string().contains("none"));
    }
}
