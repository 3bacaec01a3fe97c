//! The tensors of `CoFiNet`.

use super::CoFiNetConfig;
use crate::backbones::hourglass::{MessagePassing, pointwise};
use crate::checkpoint::Layout;

/// The attentions between coarse points, in order.
pub(super) const COARSE: [&str; 3] = ["sattn1", "cattn", "sattn2"];
/// The attentions between the fine points of patches, in order.
pub(super) const FINE: [&str; 3] = ["l_sattn1", "l_cattn", "l_sattn2"];

/// The shape of every tensor of a model. `l_bin_score` and `encoder.epsilon` are there, but nothing uses them.
#[must_use]
pub fn layout(config: &CoFiNetConfig) -> Layout {
    let mut layout = Layout::new();
    for scalar in ["bin_score", "l_bin_score", "encoder.epsilon"] {
        layout.insert(scalar.to_owned(), Vec::new());
    }
    let (coarse, fine) = (config.coarse_channels, config.features);
    config.encoder().add_to(&mut layout, "encoder.encoder_blocks");
    pointwise(&mut layout, "encoder.bottle", [config.encoder().coarsest(), coarse]);
    config.decoder().add_to(&mut layout, "decoder.decoder_blocks");
    for name in COARSE {
        MessagePassing::add_to(&mut layout, name, coarse);
    }
    pointwise(&mut layout, "final_proj", [coarse, coarse]);
    for name in FINE {
        MessagePassing::add_to(&mut layout, name, fine);
    }
    pointwise(&mut layout, "l_final_proj", [fine, fine]);
    layout
}
