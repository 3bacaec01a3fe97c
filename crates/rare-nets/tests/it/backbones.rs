//! Networks on points against what their released code computes.

mod case;
mod clouds;
mod comparison;
mod formula;
mod geotransformer;
mod kpconv;
