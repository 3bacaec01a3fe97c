//! Where the golden inputs and outputs lie.
//!
//! They stand beside a development checkout, never in it: a test that does not find them says so and passes,
//! unless `RARE_REQUIRE_SHARED=1` makes the absence a failure.

use std::path::{Path, PathBuf};

/// The file or folder `relative` of the shared data, or `None` (with a printed line) where there is none.
pub(crate) fn path(relative: &str) -> Option<PathBuf> {
    let root = std::env::var_os("RARE_SHARED")
        .map(PathBuf::from)
        .unwrap_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared"));
    let path = root.join(relative);
    if path.exists() {
        return Some(path);
    }
    assert!(
        std::env::var("RARE_REQUIRE_SHARED").as_deref() != Ok("1"),
        "RARE_REQUIRE_SHARED=1, but there is no {}",
        path.display()
    );
    println!("skipped: no {}", path.display());
    None
}
