//! The one place where panics are caught.

use std::panic::{AssertUnwindSafe, catch_unwind};

use crate::error::{Error, Result};

/// Runs code of another crate on a file's content and turns a panic in it into an error.
///
/// The readers of LAZ, E57 and ZIP are not our own, and damaged files make them index out of bounds or overflow. Their
/// state is dropped with the error, so nothing half-changed is seen again. The panic hook still reports the place.
pub(super) fn contain_panics<T>(read: impl FnOnce() -> Result<T>) -> Result<T> {
    catch_unwind(AssertUnwindSafe(read)).unwrap_or_else(|_| {
        Err(Error::invalid("the file is so damaged that its reader gave up: write the file again"))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_panic_becomes_an_error() {
        let message = contain_panics::<()>(|| panic!("index out of bounds")).unwrap_err();
        assert!(message.to_string().contains("its reader gave up"));
        assert_eq!(contain_panics(|| Ok(7)).unwrap(), 7);
    }
}
