//! Where the weights of the networks come from, and whether what lies in a folder is what was published.
//!
//! [`PUBLISHED`] names the checkpoints of the networks on points, which a person downloads.
//!
//! [`SOURCES`] names the repositories and files. `fetch` (cargo feature `fetch`) makes a pipeline folder of them and
//! writes beside them a [`Lock`]: what each file is, by content. [`check`] compares a folder with its lock later, without
//! the internet, and [`open`] its tensors with what the networks need.
//!
//! The lengths and hashes of the table are those that somebody has verified; where there is none, a download can only be
//! compared with what the server announces, and the lock records what that was.

mod check;
mod digest;
#[cfg(feature = "fetch")]
pub mod fetch;
mod hub;
mod lock;
mod published;
mod sources;

pub use check::{Checked, check, open};
pub use hub::{Hub, Token};
pub use lock::{LOCK_FILE, Lock, LockedFile};
pub use published::{PUBLISHED, Published};
pub use sources::{Choice, ControlNetVersion, Precision, SOURCES, Source, SourceFile};
