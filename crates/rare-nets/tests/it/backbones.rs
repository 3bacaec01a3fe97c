//! Networks on points against recorded stages of other implementations.

mod cofinet;
mod fcgf;
mod formula;
mod full_width;
mod geotransformer;
mod kpconv;
mod predator;
mod recorded;
