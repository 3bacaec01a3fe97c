//! The content of a file, by its hash.

use std::fs::File;
use std::io::{self, Read};
use std::path::Path;

use sha2::{Digest, Sha256};

/// How much is read at once.
const CHUNK: usize = 1 << 20;

/// The length of a file and its SHA-256 in hexadecimal digits.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Fingerprint {
    pub(super) bytes: u64,
    pub(super) sha256: String,
}

/// Reads a file to its end.
pub(super) fn fingerprint(path: &Path) -> io::Result<Fingerprint> {
    let mut hasher = Sha256::new();
    let bytes = feed(path, |chunk| hasher.update(chunk))?;
    Ok(Fingerprint { bytes, sha256: hexadecimal(&hasher.finalize()) })
}

/// Hands a file over piece by piece; gives its length.
pub(super) fn feed(path: &Path, mut take: impl FnMut(&[u8])) -> io::Result<u64> {
    let mut file = File::open(path)?;
    let mut chunk = vec![0; CHUNK];
    let mut bytes = 0;
    loop {
        let count = file.read(&mut chunk)?;
        let Some(read) = chunk.get(..count).filter(|read| !read.is_empty()) else {
            return Ok(bytes);
        };
        take(read);
        bytes += count as u64;
    }
}

/// Two lower-case digits for every byte.
pub(super) fn hexadecimal(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Whether this is a number of `digits` hexadecimal digits in lower case.
pub(super) fn is_hexadecimal(text: &str, digits: usize) -> bool {
    text.len() == digits && text.bytes().all(|byte| matches!(byte, b'0'..=b'9' | b'a'..=b'f'))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_hash_is_the_one_of_the_standard() {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), "abc").unwrap();
        // FIPS 180-4, example of one block.
        let sha256 = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad".to_owned();
        assert_eq!(fingerprint(file.path()).unwrap(), Fingerprint { bytes: 3, sha256 });
    }

    #[test]
    fn only_lower_case_digits_of_the_right_number_are_a_hash() {
        assert!(is_hexadecimal("0f", 2));
        for text in ["0F", "0", "0ff", "..", "é"] {
            assert!(!is_hexadecimal(text, 2), "{text}");
        }
    }
}
