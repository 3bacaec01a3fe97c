//! What Predator and `CoFiNet` have in common: kernel point convolutions from fine to coarse, attention between the
//! coarse points of both clouds, and layers back to fine.
//!
//! | module | what it holds |
//! |---|---|
//! | `preparation` | clouds at the density of a network |
//! | `encoder` | convolutions of the stages of both clouds, from fine to coarse |
//! | `message_passing` | attention, and what it changes |
//! | `decoder` | features of coarse points brought to fine ones |

mod decoder;
mod encoder;
mod message_passing;
mod preparation;

use crate::Matrix;

pub(super) use decoder::{Decoder, DecoderSizes};
pub(super) use encoder::{Encoder, EncoderSizes};
pub(super) use message_passing::{MessagePassing, Turns, pointwise};
pub(super) use preparation::Prepared;

/// The rows of either cloud.
pub(super) fn halves(stacked: &Matrix, [first, second]: [usize; 2]) -> [Matrix; 2] {
    [stacked.part(0, first), stacked.part(first, second)]
}
