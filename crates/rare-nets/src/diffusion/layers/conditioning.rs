//! What steers a network beside its input: the time and the prompts.

use std::slice::Iter;

use rare::{Error, Result};

/// A time of diffusion, as the residual blocks of one network take it.
pub struct Timestep<T> {
    /// For each residual block in the order of computation, the summand of its channels.
    pub(crate) offsets: Vec<T>,
}

/// A prompt, as the transformers of one network take it.
pub struct Contexts<T> {
    /// For each transformer in the order of computation, the keys and values of the prompt's tokens.
    pub(crate) keys_values: Vec<T>,
}

/// Hands each block of a network its part of the conditions, in the order of computation.
pub(crate) struct Conditioning<'a, T> {
    offsets: Iter<'a, T>,
    contexts: Vec<Iter<'a, T>>,
}

impl<'a, T> Conditioning<'a, T> {
    /// Takes the time and the prompts, each of which serves an equal share of the images.
    pub(crate) fn new(timestep: &'a Timestep<T>, contexts: &[&'a Contexts<T>]) -> Self {
        Conditioning {
            offsets: timestep.offsets.iter(),
            contexts: contexts.iter().map(|context| context.keys_values.iter()).collect(),
        }
    }

    /// For the next residual block.
    pub(crate) fn next_offset(&mut self) -> Result<&'a T> {
        self.offsets.next().ok_or_else(exhausted)
    }

    /// For the next transformer.
    pub(crate) fn next_contexts(&mut self) -> Result<Vec<&'a T>> {
        self.contexts.iter_mut().map(|context| context.next().ok_or_else(exhausted)).collect()
    }
}

fn exhausted() -> Error {
    Error::Internal("the time or the prompt was prepared by a smaller network".to_owned())
}
