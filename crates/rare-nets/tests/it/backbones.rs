//! Networks on points against what their released code computes.

mod formula;
mod geotransformer;
mod kpconv;
