//! From named tensors to packed weights.

use rare::{Error, Result};

use super::{GroupNormalization, LayerNormalization};
use crate::Parameter;
use crate::checkpoint::Layout;
use crate::checkpoint::Parameters;
use crate::diffusion::layout::require;
use crate::engine::{Arrangement, Backend, Kernel};

/// Reads the tensors of one network and packs them for one backend, each when it is asked for: no more than the parts of
/// one convolution are in memory unpacked.
pub(crate) struct Loader<'a, B> {
    pub(crate) backend: &'a B,
    layout: &'a Layout,
    parameters: &'a Parameters,
}

impl<'a, B: Backend> Loader<'a, B> {
    /// Makes sure that the files hold the tensors of `layout`. `network` is its name for messages.
    ///
    /// # Errors
    /// `InvalidInput` with the first differences.
    pub(crate) fn new(
        backend: &'a B,
        layout: &'a Layout,
        parameters: &'a Parameters,
        network: &str,
    ) -> Result<Loader<'a, B>> {
        require(layout, parameters, network)?;
        Ok(Loader { backend, layout, parameters })
    }

    /// Whether the network has the part `name`, which has weights.
    pub(crate) fn has(&self, name: &str) -> bool {
        self.layout.contains_key(&format!("{name}.weight"))
    }

    /// The tensor `name`, of the shape that the layout says.
    pub(crate) fn parameter(&self, name: &str) -> Result<Parameter> {
        let shape = self
            .layout
            .get(name)
            .ok_or_else(|| Error::Internal(format!("the layout has no tensor {name}")))?;
        self.parameters.read(name, shape)
    }

    /// The values of the tensor `name`.
    pub(crate) fn values(&self, name: &str) -> Result<Vec<f32>> {
        Ok(self.parameter(name)?.to_f32())
    }

    /// The convolution or linear layer `name`.
    pub(crate) fn kernel(&self, name: &str) -> Result<B::Weight> {
        self.pack(&[name.to_owned()], Arrangement::Plain)
    }

    /// The linear layer `name`, whose outputs are values and gates.
    pub(crate) fn gated_kernel(&self, name: &str) -> Result<B::Weight> {
        self.pack(&[name.to_owned()], Arrangement::Gated)
    }

    /// Linear layers of the same input as one, their outputs one after the other. `names` are those after `prefix`.
    pub(crate) fn joint_kernel(&self, prefix: &str, names: &[&str]) -> Result<B::Weight> {
        let names: Vec<String> = names.iter().map(|name| format!("{prefix}.{name}")).collect();
        self.pack(&names, Arrangement::Plain)
    }

    fn pack(&self, names: &[String], arrangement: Arrangement) -> Result<B::Weight> {
        let parts = names
            .iter()
            .map(|name| self.parameter(&format!("{name}.weight")))
            .collect::<Result<Vec<Parameter>>>()?;
        let mut bias = Vec::new();
        for name in names.iter().map(|name| format!("{name}.bias")) {
            if self.layout.contains_key(&name) {
                bias.extend(self.values(&name)?);
            }
        }
        let bias = (!bias.is_empty()).then_some(&bias[..]);
        self.backend.pack(&Kernel { parts: &parts, bias, arrangement })
    }

    /// The group normalisation `name`.
    pub(crate) fn group_normalization(
        &self,
        name: &str,
        groups: usize,
        epsilon: f32,
    ) -> Result<GroupNormalization> {
        let scale = self.values(&format!("{name}.weight"))?;
        let shift = self.values(&format!("{name}.bias"))?;
        Ok(GroupNormalization { groups, epsilon, scale, shift })
    }

    /// The layer normalisation `name`.
    pub(crate) fn layer_normalization(
        &self,
        name: &str,
        epsilon: f32,
    ) -> Result<LayerNormalization> {
        let scale = self.values(&format!("{name}.weight"))?;
        let shift = self.values(&format!("{name}.bias"))?;
        Ok(LayerNormalization { epsilon, scale, shift })
    }
}
