//! The LZF compression that PCD files use (M. Lehmann, LibLZF): literal runs and references to what was unpacked.

use crate::error::{Error, Result};

/// Three bytes unpack to at most 264, so nothing can unpack to more than this many times its length.
const LARGEST_RATIO: usize = 88;

/// The `length` bytes that `packed` unpacks to.
///
/// # Errors
/// `InvalidInput` if the data are damaged or `length` is not what they unpack to; never allocates more than 88 times
/// the length of `packed`.
pub(super) fn decompress(packed: &[u8], length: usize) -> Result<Vec<u8>> {
    if length > packed.len().saturating_mul(LARGEST_RATIO) {
        return Err(damaged());
    }
    let mut unpacked = Vec::with_capacity(length);
    let mut rest = packed;
    while let Some((&control, after)) = rest.split_first() {
        rest = if control < 32 {
            let (literal, after) =
                after.split_at_checked(usize::from(control) + 1).ok_or_else(damaged)?;
            unpacked.extend_from_slice(literal);
            after
        } else {
            copy_back(control, after, &mut unpacked).ok_or_else(damaged)?
        };
        if unpacked.len() > length {
            return Err(damaged());
        }
    }
    if unpacked.len() == length { Ok(unpacked) } else { Err(damaged()) }
}

/// Repeats what was unpacked some distance ago; returns the input after the reference.
fn copy_back<'a>(control: u8, input: &'a [u8], unpacked: &mut Vec<u8>) -> Option<&'a [u8]> {
    const LONG: usize = 7;
    let (mut length, mut rest) = (usize::from(control >> 5), input);
    if length == LONG {
        let (&more, after) = rest.split_first()?;
        length += usize::from(more);
        rest = after;
    }
    let (&low, rest) = rest.split_first()?;
    let distance = (usize::from(control & 0x1f) << 8 | usize::from(low)) + 1;
    let from = unpacked.len().checked_sub(distance)?;
    // Byte by byte: the copied stretch may reach into what this very reference writes.
    for at in from..from + length + 2 {
        unpacked.push(*unpacked.get(at)?);
    }
    Some(rest)
}

fn damaged() -> Error {
    Error::invalid("the compressed data are damaged: write the file again")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn literals_and_references_unpack() {
        // "abc", then 6 bytes from 3 ago, then "d", then 2 + 7 + 1 bytes from 1 ago.
        let packed = [2, b'a', b'b', b'c', 4 << 5, 2, 0, b'd', 7 << 5, 1, 0];
        assert_eq!(decompress(&packed, 20).unwrap(), b"abcabcabcddddddddddd");
    }

    #[test]
    fn damage_is_an_error() {
        for (packed, length) in [
            (&[2, b'a'][..], 3),        // a literal beyond the end
            (&[0, b'a', 1 << 5, 9], 4), // a reference before the start
            (&[0, b'a', 7 << 5], 4),    // a reference cut off
            (&[0, b'a'], 2),            // too short
            (&[1, b'a', b'a'], 1),      // too long
            (&[0, b'a'], usize::MAX),   // an absurd length
        ] {
            assert!(decompress(packed, length).is_err());
        }
    }
}
