//! Features that were computed before: an encoder around another one, which asks it once for every depth map.
//!
//! A network takes seconds to minutes for a map, and the same maps come back: the views of a cloud by itself are the
//! same in every round and under every initial transform. What decides the features is hashed: the weights, the
//! settings, the map's position (which decides its noise) and its bits. Entries are kept for one run in memory, or in a
//! folder, where each is a file that is written whole; one that is damaged is computed anew and replaced.

mod entry;
mod weights;

use std::collections::BTreeMap;
use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};

use rare::data::LayeredFeatures;
use rare::encode::DepthEncoder;
use rare::{DepthMap, Error, Result};
use sha2::{Digest as _, Sha256};
pub use weights::WeightsIdentity;

/// A SHA-256 digest.
pub type Digest = [u8; 32];

/// A digest in hexadecimal digits.
#[must_use]
pub fn hexadecimal(digest: &Digest) -> String {
    digest.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// An encoder that asks another one only for what it does not know yet.
pub struct CachedEncoder<E> {
    encoder: E,
    /// Of everything but the map that decides the features.
    identity: Digest,
    place: Place,
    computed: AtomicUsize,
    found: AtomicUsize,
    /// The first trouble with the folder, which costs time but no result.
    trouble: Mutex<Option<Error>>,
}

/// Where entries are kept.
enum Place {
    Memory(Mutex<BTreeMap<Digest, LayeredFeatures>>),
    Folder(PathBuf),
}

impl<E: DepthEncoder> CachedEncoder<E> {
    /// Keeps features in `folder`, which is made if it does not exist, or without one in memory. `identity` is a text
    /// that says everything but the depth map and its position that decides the features: weights and settings.
    ///
    /// # Errors
    /// `Io` if the folder cannot be made, `InvalidInput` if it is a file.
    pub fn new(encoder: E, identity: &str, folder: Option<&Path>) -> Result<CachedEncoder<E>> {
        let place = match folder {
            Some(folder) => Place::Folder(made(folder)?),
            None => Place::Memory(Mutex::default()),
        };
        Ok(CachedEncoder {
            encoder,
            identity: Sha256::digest(identity.as_bytes()).into(),
            place,
            computed: AtomicUsize::new(0),
            found: AtomicUsize::new(0),
            trouble: Mutex::new(None),
        })
    }

    /// The encoder inside.
    #[must_use]
    pub fn encoder(&self) -> &E {
        &self.encoder
    }

    /// How many maps the encoder inside has encoded.
    #[must_use]
    pub fn computed(&self) -> usize {
        self.computed.load(Ordering::Relaxed)
    }

    /// How many maps were known.
    #[must_use]
    pub fn found(&self) -> usize {
        self.found.load(Ordering::Relaxed)
    }

    /// What went wrong first in the folder (a full disk, a damaged file), if anything did: it costs time, no result.
    #[must_use]
    pub fn trouble(&self) -> Option<String> {
        lock(&self.trouble).as_ref().map(Error::to_string)
    }

    fn load(&self, key: &Digest) -> Option<LayeredFeatures> {
        match &self.place {
            Place::Memory(entries) => lock(entries).get(key).cloned(),
            Place::Folder(folder) => {
                let result = entry::read(&file_of(folder, key), key);
                result.unwrap_or_else(|error| self.note(error))
            }
        }
    }

    fn store(&self, key: &Digest, features: &LayeredFeatures) {
        match &self.place {
            Place::Memory(entries) => {
                lock(entries).insert(*key, features.clone());
            }
            Place::Folder(folder) => {
                let result = entry::write(&file_of(folder, key), key, features);
                result.map(Some).unwrap_or_else(|error| self.note(error));
            }
        }
    }

    /// Keeps the first trouble.
    fn note<T>(&self, error: Error) -> Option<T> {
        lock(&self.trouble).get_or_insert(error);
        None
    }

    /// The digest of everything that decides the features of a map.
    fn key(&self, index: usize, map: &DepthMap) -> Digest {
        let camera = map.intrinsics();
        let mut hash = Sha256::new_with_prefix(entry::FORMAT);
        hash.update(self.identity);
        for size in [index, camera.width, camera.height] {
            hash.update((size as u64).to_le_bytes());
        }
        for length in [camera.fx, camera.fy, camera.cx, camera.cy] {
            hash.update(length.to_bits().to_le_bytes());
        }
        let bytes: Vec<u8> = map.depth().iter().flat_map(|depth| depth.to_le_bytes()).collect();
        hash.update(&bytes);
        hash.finalize().into()
    }
}

impl<E: DepthEncoder> DepthEncoder for CachedEncoder<E> {
    fn encode_at(&self, maps: &[(usize, &DepthMap)]) -> Result<Vec<LayeredFeatures>> {
        let keys: Vec<Digest> = maps.iter().map(|&(index, map)| self.key(index, map)).collect();
        let known: Vec<Option<LayeredFeatures>> = keys.iter().map(|key| self.load(key)).collect();
        let unknown = maps.iter().zip(&known).filter(|(_, known)| known.is_none());
        let unknown: Vec<(usize, &DepthMap)> = unknown.map(|(&map, _)| map).collect();
        self.found.fetch_add(maps.len() - unknown.len(), Ordering::Relaxed);
        let computed =
            if unknown.is_empty() { Vec::new() } else { self.encoder.encode_at(&unknown)? };
        self.computed.fetch_add(computed.len(), Ordering::Relaxed);
        let mut computed = computed.into_iter();
        let complete = |(key, known): (&Digest, Option<LayeredFeatures>)| match known {
            Some(features) => Ok(features),
            None => {
                let features = computed.next().ok_or_else(|| {
                    Error::Internal(format!("an encoder left out some of {} maps", maps.len()))
                })?;
                self.store(key, &features);
                Ok(features)
            }
        };
        keys.iter().zip(known).map(complete).collect()
    }
}

fn made(folder: &Path) -> Result<PathBuf> {
    match fs::create_dir_all(folder) {
        Ok(()) => Ok(folder.to_path_buf()),
        Err(error)
            if matches!(error.kind(), ErrorKind::AlreadyExists | ErrorKind::NotADirectory) =>
        {
            Err(Error::in_file(folder, "a file is in the way of the cache: name another folder"))
        }
        Err(error) => Err(Error::io(folder, error)),
    }
}

fn file_of(folder: &Path, key: &Digest) -> PathBuf {
    folder.join(format!("{}.features", hexadecimal(key)))
}

/// What is inside, even if a thread has panicked with it: entries are whole or absent.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use rare::{FeatureMap, Intrinsics};

    use super::*;

    /// Gives the position and the first depth back, in two layers.
    struct Echo;

    impl DepthEncoder for Echo {
        fn encode_at(&self, maps: &[(usize, &DepthMap)]) -> Result<Vec<LayeredFeatures>> {
            let of_map = |&(index, map): &(usize, &DepthMap)| {
                let layer = |value: f32| FeatureMap::new(2, 1, 1, vec![value, map.at(0, 0)]);
                Ok(vec![layer(index as f32)?, layer(-0.0)?])
            };
            maps.iter().map(of_map).collect()
        }
    }

    fn map(depth: f32) -> DepthMap {
        let intrinsics = Intrinsics { width: 2, height: 1, ..Intrinsics::indoor() };
        DepthMap::new(intrinsics, vec![depth, 2.0]).unwrap()
    }

    fn in_folder(folder: &Path, identity: &str) -> CachedEncoder<Echo> {
        CachedEncoder::new(Echo, identity, Some(folder)).unwrap()
    }

    /// Encodes some maps twice, some once, one at two positions.
    fn assert_remembers(encoder: &CachedEncoder<Echo>, known: usize) {
        let maps = [map(1.0), map(3.0), map(1.0)];
        let first = encoder.encode(&maps).unwrap();
        assert_eq!((encoder.computed(), encoder.found()), (3 - known, known));
        let second = encoder.encode(&maps).unwrap();
        assert_eq!((encoder.computed(), encoder.found()), (3 - known, 3 + known));
        assert_eq!(first, second);
        assert_eq!(second, Echo.encode(&maps).unwrap());
        assert_eq!(encoder.trouble(), None);
    }

    #[test]
    fn a_map_is_encoded_once_per_position() {
        assert_remembers(&CachedEncoder::new(Echo, "a", None).unwrap(), 0);
        let folder = tempfile::tempdir().unwrap();
        let cache = folder.path().join("new/cache");
        assert_remembers(&in_folder(&cache, "a"), 0);
        // A later run finds everything, one with other settings nothing.
        assert_remembers(&in_folder(&cache, "a"), 3);
        assert_remembers(&in_folder(&cache, "b"), 0);
        assert_eq!(fs::read_dir(&cache).unwrap().count(), 6);
    }

    #[test]
    fn a_map_of_another_camera_is_another_map() {
        let encoder = CachedEncoder::new(Echo, "a", None).unwrap();
        let closer = Intrinsics { fx: 586.0, ..*map(1.0).intrinsics() };
        let closer = DepthMap::new(closer, map(1.0).depth().to_vec()).unwrap();
        for map in [map(1.0), closer, map(1.0 + f32::EPSILON)] {
            encoder.encode_at(&[(0, &map)]).unwrap();
        }
        assert_eq!(encoder.computed(), 3);
    }

    #[test]
    fn damaged_entries_are_computed_anew_and_replaced() {
        let folder = tempfile::tempdir().unwrap();
        in_folder(folder.path(), "a").encode_at(&[(0, &map(1.0))]).unwrap();
        let file = fs::read_dir(folder.path()).unwrap().next().unwrap().unwrap().path();
        let whole = fs::read(&file).unwrap();
        let mut flipped = whole.clone();
        flipped[whole.len() / 2] ^= 1;
        let longer = [whole.clone(), vec![0]].concat();
        for damaged in [Vec::new(), whole[..whole.len() - 1].to_vec(), longer, flipped] {
            fs::write(&file, damaged).unwrap();
            let encoder = in_folder(folder.path(), "a");
            assert_eq!(
                encoder.encode_at(&[(0, &map(1.0))]).unwrap(),
                Echo.encode_at(&[(0, &map(1.0))]).unwrap()
            );
            assert_eq!((encoder.computed(), encoder.found()), (1, 0));
            let trouble = encoder.trouble().unwrap();
            assert!(trouble.contains(".features") && trouble.contains("damaged"), "{trouble}");
            assert_eq!(fs::read(&file).unwrap(), whole);
        }
    }

    #[test]
    fn a_folder_that_cannot_be_used_costs_no_result() {
        let folder = tempfile::tempdir().unwrap();
        let cache = folder.path().join("cache");
        let encoder = in_folder(&cache, "a");
        fs::remove_dir(&cache).unwrap();
        assert!(encoder.encode_at(&[(0, &map(1.0))]).is_ok());
        assert!(encoder.trouble().unwrap().contains("cache"));
        fs::write(&cache, "a file").unwrap();
        for place in [cache.clone(), cache.join("below")] {
            let Err(error) = CachedEncoder::new(Echo, "a", Some(&place)) else { unreachable!() };
            assert!(error.to_string().contains("name another folder"), "{error}");
        }
    }
}
