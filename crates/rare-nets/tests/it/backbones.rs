//! Networks on points against recorded stages of other implementations.

mod fcgf;
mod formula;
mod full_width;
mod geotransformer;
mod kpconv;
