//! What the network believes of each correspondence, from layer to layer.
//!
//! Queries, keys and values of the attention each come from a branch of their own: a belief, updated by a gated recurrent
//! unit from the features and the state before, gives the distribution of a state (section 3.2 of the paper), of which
//! inference takes the mean or a sample.

use rare::Result;
use rare::random::Random;

use super::super::encoder::{CHANNELS, linear};
use crate::Matrix;
use crate::checkpoint::Layout;
use crate::engine::CpuBackend;
use crate::layers::{Activation, Linear, Weights};

/// Numbers of a belief, and of what its layers hold inside.
const BELIEF: usize = 256;
/// Numbers of an embedded label, which only training uses.
const LABEL: usize = 64;
/// Added to the deviation of a state.
const LEAST_DEVIATION: f32 = 0.1;

/// The layers of one branch, which all layers of attention share.
pub(super) struct Branch {
    /// From state and features.
    action: Linear,
    input: Linear,
    hidden: Linear,
    prior: Linear,
    mean: Linear,
    /// What the deviation is a function of.
    spread: Linear,
    /// From belief and state.
    embedding: Linear,
}

/// Belief and state of some correspondences, a row for each.
#[derive(Debug, Clone)]
pub(super) struct Belief {
    belief: Matrix,
    state: Matrix,
}

impl Belief {
    pub(super) fn nothing(rows: usize) -> Belief {
        Belief {
            belief: Matrix::filled(rows, BELIEF, 0.0),
            state: Matrix::filled(rows, CHANNELS, 0.0),
        }
    }
}

impl Branch {
    /// The branch `which` (Q, K or V) of the tensors below `prefix`.
    pub(super) fn load(
        weights: &Weights<'_>,
        cpu: &CpuBackend,
        prefix: &str,
        which: &str,
    ) -> Result<Branch> {
        let of = |name: &str| weights.linear(cpu, &format!("{prefix}{name}_{which}"));
        let gates = |part: &str| {
            let name = |kind: &str| format!("{prefix}rnn_{which}.{kind}_{part}");
            Linear::new(
                cpu,
                weights.matrix(&name("weight"))?,
                Some(&weights.values(&name("bias"))?),
            )
        };
        let name = format!("{prefix}fc_state_prior_{which}");
        let prior = weights.matrix(&format!("{name}.weight"))?;
        let bias = weights.values(&format!("{name}.bias"))?;
        let (mean, spread) = bias.split_at(CHANNELS.min(bias.len()));
        let half = |first: usize, bias| Linear::new(cpu, prior.part(first, CHANNELS), Some(bias));
        Ok(Branch {
            action: of("fc_embed_state_action")?,
            input: gates("ih")?,
            hidden: gates("hh")?,
            prior: of("fc_embed_belief_prior")?,
            mean: half(0, mean)?,
            spread: half(CHANNELS, spread)?,
            embedding: of("fc_embed_belief_sto")?,
        })
    }

    /// Updates the belief by the features and gives its embedding. With `noise` the state is a sample, else its mean.
    pub(super) fn step(
        &self,
        cpu: &CpuBackend,
        features: &Matrix,
        belief: &mut Belief,
        noise: Option<Random>,
    ) -> Result<Matrix> {
        let action = rectified(&self.action, cpu, &belief.state.beside(features)?)?;
        let input = self.input.apply(cpu, &action)?;
        let hidden = self.hidden.apply(cpu, &belief.belief)?;
        cpu.gated_update(&input, &hidden, &mut belief.belief)?;
        let prior = rectified(&self.prior, cpu, &belief.belief)?;
        belief.state = self.mean.apply(cpu, &prior)?;
        if let Some(mut random) = noise {
            let spread = self.spread.apply(cpu, &prior)?;
            for (value, &spread) in belief.state.values_mut().iter_mut().zip(spread.values()) {
                *value += deviation(spread) * random.normal() as f32;
            }
        }
        rectified(&self.embedding, cpu, &belief.belief.beside(&belief.state)?)
    }
}

/// `log(1 + e^x)`, which is never negative, and a little more.
fn deviation(x: f32) -> f32 {
    x.max(0.0) + (-x.abs()).exp().ln_1p() + LEAST_DEVIATION
}

fn rectified(layer: &Linear, cpu: &CpuBackend, input: &Matrix) -> Result<Matrix> {
    let mut output = layer.apply(cpu, input)?;
    Activation::Relu.apply_to(output.values_mut());
    Ok(output)
}

/// The tensors of the branch `which`, with those that only training uses.
pub(super) fn layout(layout: &mut Layout, prefix: &str, which: &str) {
    for (part, inputs) in [("ih", BELIEF), ("hh", BELIEF)] {
        let name = |kind: &str| format!("{prefix}rnn_{which}.{kind}_{part}");
        layout.insert(name("weight"), vec![3 * BELIEF, inputs]);
        layout.insert(name("bias"), vec![3 * BELIEF]);
    }
    for (name, outputs, inputs) in [
        ("fc_embed_state_action", BELIEF, 2 * CHANNELS),
        ("fc_embed_belief_prior", BELIEF, BELIEF),
        ("fc_state_prior", 2 * CHANNELS, BELIEF),
        ("fc_embed_belief_posterior", BELIEF, BELIEF + LABEL),
        ("fc_state_posterior", 2 * CHANNELS, BELIEF),
        ("fc_embed_belief_sto", CHANNELS, BELIEF + CHANNELS),
        ("fc_label", LABEL, 2),
    ] {
        linear(layout, &format!("{prefix}{name}_{which}"), &[outputs, inputs, 1]);
    }
}
