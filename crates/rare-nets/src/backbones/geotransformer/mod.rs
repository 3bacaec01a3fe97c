//! `GeoTransformer` (Qin et al., "Geometric Transformer for Fast and Robust Point Cloud Registration", CVPR 2022).

mod backbone;
mod config;
mod layout;

pub use backbone::Watch;
pub use config::{FineMatchingConfig, GeoTransformerConfig, TransformerConfig};
pub use layout::layout;

use rare::{Error, Result};

use self::backbone::Backbone;
use super::kpconv::Pyramid;
use crate::checkpoint::Parameters;
use crate::engine::{CpuBackend, Precision};
use crate::layers::Weights;

/// The network, ready to run.
pub struct GeoTransformer {
    config: GeoTransformerConfig,
    cpu: CpuBackend,
    backbone: Backbone,
}

impl GeoTransformer {
    /// Takes the weights of a network of these sizes, named as in the released checkpoints.
    ///
    /// # Errors
    /// `InvalidInput` if they are those of another network or damaged; `Io` if a file cannot be read.
    pub fn load(parameters: &Parameters, config: GeoTransformerConfig) -> Result<GeoTransformer> {
        if config.pyramid.stages < 3 {
            return Err(Error::invalid("a `GeoTransformer` has at least three stages".to_owned()));
        }
        let layout = layout(&config);
        let network = format!("GeoTransformer for {}", config.name);
        let weights = Weights::new(parameters, &layout, &network)?;
        let cpu = CpuBackend::new(Precision::F32)?;
        let backbone = Backbone::load(&cpu, &weights, &config)?;
        Ok(GeoTransformer { config, cpu, backbone })
    }

    /// Runs.
    pub fn run(&self, pyramid: &Pyramid, watch: &mut Watch<'_>) -> Result<()> {
        self.backbone.apply(&self.cpu, pyramid, watch)?;
        let _ = &self.config;
        Ok(())
    }
}
