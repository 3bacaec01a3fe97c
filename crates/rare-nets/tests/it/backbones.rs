//! Networks on points against recorded stages of other implementations.

mod cofinet;
mod fcgf;
mod formula;
mod full_width;
mod recorded;
