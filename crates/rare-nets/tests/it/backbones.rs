//! Networks on points against what their released code computes.

mod cofinet;
mod fcgf;
mod formula;
mod full_width;
mod geotransformer;
mod kpconv;
mod predator;
mod recorded;
