//! Networks on points against what their released code computes.

mod case;
mod clouds;
mod cofinet;
mod comparison;
mod fcgf;
mod formula;
mod full_width;
mod geotransformer;
mod kpconv;
mod predator;
mod recorded;
