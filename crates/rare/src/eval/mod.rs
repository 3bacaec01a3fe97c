//! Benchmarks: true transforms and estimates in, the numbers of the literature out.
//!
//! | module | what it does |
//! |---|---|
//! | [`trajectory`] | reads and writes the files of the benchmarks |
//! | [`metrics`] | the error of one estimate |
//! | [`scored`] | a pair, its truth and its errors |
//! | [`protocol`] | what counts as success, which pairs count |
//! | [`summary`] | many pairs in a few numbers |
//! | [`comparison`], [`table`] | methods side by side |
//! | [`results`] | the folder of an evaluation, which can be interrupted |
//! | [`dataset`] | benchmarks as they lie on disk |
//! | [`log_folders`] | a folder of true and a folder of estimated transforms |
//!
//! Published numbers contain traps (a pair left out by accident, a truth that is no rotation). [`protocol::Protocol`]
//! repeats them by default and has the exact value beside.

mod bootstrap;
pub mod comparison;
pub mod dataset;
pub mod log_folders;
pub mod metrics;
pub mod protocol;
pub mod results;
pub mod scored;
pub mod summary;
pub mod table;
pub mod trajectory;

pub use bootstrap::Interval;
pub use comparison::{Comparison, MethodResult, MethodSummary};
pub use protocol::{Protocol, Rules, Success};
pub use scored::{Errors, ScoredPair, TruePair};
pub use summary::Summary;
pub use table::Table;
