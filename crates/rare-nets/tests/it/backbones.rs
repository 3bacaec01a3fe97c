//! Networks on points against what their released code computes.

mod geotransformer;
mod kpconv;
