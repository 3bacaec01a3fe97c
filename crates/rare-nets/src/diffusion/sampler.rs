//! From noise to features: the steps of a [`Plan`] with both branches as one batch.

mod plan;

pub use plan::Plan;
